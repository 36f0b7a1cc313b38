"""What every benchmark here shares: timing, memory, errors, tables, pictures, and where results go.

Timings are taken after compilation, block until the result is there, and are interleaved: one run of every case, then the next round,
so that a ratio compares moments close in time. The median and the spread (10 to 90 %) are kept.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxspring.progress import Stopwatch

RESULTS = Path(__file__).parent / "results"


@dataclass
class Case:
    """One thing to time: a jitted function and its arguments."""

    name: str
    function: Any
    arguments: tuple[Any, ...]


@dataclass
class Row:
    """What was measured of a case.

    Attributes:
        name: of the case.
        compile_s: seconds to trace, lower and compile.
        first_s: the same with the first run; of a gradient, the seconds until the first one is there.
        run_s, low_s, high_s: seconds of a run, median and 10 and 90 %.
        temporary_mib: temporary memory.
        error: against a reference.
    """

    name: str
    compile_s: float
    first_s: float
    run_s: float
    low_s: float
    high_s: float
    temporary_mib: float
    error: float | None = None


def measure(cases: list[Case], rounds: int = 9) -> dict[str, Row]:
    """Compile each case, then time them in interleaved rounds."""
    compiled, rows, times = {}, {}, {case.name: [] for case in cases}
    for case in cases:
        clock = Stopwatch()
        program = case.function.lower(*case.arguments).compile()
        seconds = clock.seconds
        memory = program.memory_analysis()
        compiled[case.name] = program
        clock = Stopwatch()
        jax.block_until_ready(program(*case.arguments))
        rows[case.name] = Row(case.name, seconds, seconds + clock.seconds, 0.0, 0.0, 0.0, memory.temp_size_in_bytes / 2**20)
    for _ in range(rounds):
        for case in cases:
            times[case.name].append(_seconds(partial(compiled[case.name], *case.arguments)))
    for name, taken in times.items():
        rows[name].run_s = float(np.median(taken))
        rows[name].low_s, rows[name].high_s = (float(q) for q in np.quantile(taken, [0.1, 0.9]))
    return rows


def ratio_of_pairs(case: Callable[[], Any], base: Callable[[], Any], pairs: int = 9) -> tuple[float, float, float]:
    """Median, lowest and highest ratio of times over interleaved pairs (case right after base)."""
    ratios = []
    jax.block_until_ready((case(), base()))
    for _ in range(pairs):
        of_base = _seconds(base)
        ratios.append(_seconds(case) / of_base)
    return float(np.median(ratios)), float(min(ratios)), float(max(ratios))


def _seconds(run: Callable[[], Any]) -> float:
    clock = Stopwatch()
    jax.block_until_ready(run())
    return clock.seconds


def versions() -> dict[str, str]:
    """What the numbers were measured with."""
    names = ("jax", "jaxlib", "equinox", "numpy", "jaxspring")
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a package run from its folder has no metadata
            found[name] = "not installed"
    device = jax.devices()[0]
    return {
        **found,
        "python": platform.python_version(),
        "device": f"{device.platform}: {device.device_kind}",
        "machine": platform.machine(),
    }


def write(name: str, settings: dict[str, Any], tables: dict[str, Any]) -> Path:
    """Write results/NAME.json and return its path."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    plain = json.loads(json.dumps({"versions": versions(), "settings": settings, **tables}, default=_plain))
    path.write_text(json.dumps(plain, indent=1) + "\n")
    return path


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a table."""
    print(f"\n{title}")
    if not rows:
        return
    columns = list(rows[0])
    cells = [[_short(row[c]) for c in columns] for row in rows]
    widths = [max(len(c), *(len(line[i]) for line in cells)) for i, c in enumerate(columns)]
    print("  " + "  ".join(c.rjust(w) for c, w in zip(columns, widths, strict=True)))
    for line in cells:
        print("  " + "  ".join(value.rjust(w) for value, w in zip(line, widths, strict=True)))


@dataclass
class Panel:
    """One diagram of a picture: curves over the number of nodes, or of what `xlabel` says.

    Attributes:
        title, ylabel: what it shows.
        curves: label and style -> (nodes, values).
        log: whether values have a logarithmic axis; else it starts at zero.
        bound: a value to be stayed below, drawn as a line.
        xlabel: what the curves run over.
    """

    title: str
    ylabel: str
    curves: dict[tuple[str, str], tuple[list[float], list[float]]]
    log: bool = False
    bound: float | None = None
    xlabel: str = "nodes"


def draw(panels: list[Panel], path: Path) -> None:
    """Draw panels side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5 * len(panels), 3.6), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for (label, style), (nodes, values) in panel.curves.items():
            axes.plot(nodes, values, style, label=label)
        if panel.bound is not None:
            axes.axhline(panel.bound, color="0.6", linestyle="--", label=f"bound: {panel.bound:g}")
        axes.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel, xscale="log")
        axes.set(yscale="log") if panel.log else axes.set(ylim=(0, None))
        # Below the diagram, where it hides no curve.
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def arguments(doc: str | None) -> argparse.Namespace:
    """--quick runs small sizes only, for a look; published numbers use the whole run."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes and few rounds")
    return parser.parse_args()


def _short(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Row):
        return asdict(value)
    return float(value) if isinstance(value, (np.generic, jax.Array)) else str(value)
