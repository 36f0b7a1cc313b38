"""What the pictures of every scene need of matplotlib."""

from __future__ import annotations

from typing import Any


def canvas_and_figure() -> tuple[Any, Any]:
    """The classes that draw without a window. Called before the work as well: else it would be done in vain.

    Raises:
        ImportError: matplotlib or Pillow is not installed.
    """
    try:
        import PIL.Image  # noqa: F401 (matplotlib writes its files by it)

        # Not pyplot: it would choose a window system, and keep every figure.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Pictures need matplotlib and Pillow: pip install jaxspring[viz]") from error
    return FigureCanvasAgg, Figure


def new_figure(width: float, height: float, dpi: int, layout: str | None = "constrained") -> Any:
    """An empty figure of this size [inches], drawn without a window.

    Raises:
        ImportError: matplotlib or Pillow is not installed.
    """
    canvas, figure_of = canvas_and_figure()
    figure = figure_of((width, height), dpi, layout=layout)
    canvas(figure)
    return figure
