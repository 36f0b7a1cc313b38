"""Pictures of a net: `plot` draws one state, `animate` writes a run as a GIF. Needs the extra `viz`."""

from __future__ import annotations

import pathlib
import tempfile
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ._arrays import Numbers
from ._checks import has_shape
from .archive import atomic_file
from .state import State
from .system import System
from .topology.base import Topology
from .topology.edge_field import EdgeField

if TYPE_CHECKING:
    from .ode import OdeResult
    from .rollouts import Result

COORDINATES = "xyz"


def plot(
    net: Topology,
    state: State,
    color: Numbers | EdgeField | None = None,
    color_label: str = "tension (N)",
    length_unit: str = "m",
    axes: Any = None,
    limits: Any = None,
    system: System | None = None,
) -> Any:
    """Draw the springs of a net; positions of 3 coordinates in perspective.

    Broken springs (`state.alive`) are not drawn, and nodes that no spring holds are dots.

    Args:
        net: the topology.
        state: where its nodes are.
        color: one value per spring, as an `EdgeField` or (E,) in the user's order, e.g. `springs.tension(state)`; None draws all alike.
        color_label: what the colour means, with its unit, for the colour bar.
        length_unit: unit of the coordinates, for the labels.
        axes: matplotlib axes to draw on; None makes a new figure.
        limits: (D, 2) lowest and highest coordinate to show; None fits the picture.
        system: draws the nodes that it holds in some coordinate as squares; None marks none.

    Returns:
        The matplotlib axes.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: a `color` that is not one number per spring; a state of several frames.
    """
    pyplot = _pyplot()
    segments, alive = _segments(net, state), _alive(net, state)
    nodes = _flat(state)
    box = _limits(np.concatenate([segments.reshape(-1, segments.shape[-1]), nodes])) if limits is None else np.asarray(limits)
    if axes is None:
        figure = pyplot.figure(layout="constrained" if state.dim == 3 else "compressed")
        axes = figure.add_subplot(projection="3d") if state.dim == 3 else figure.add_subplot()
    lines = _lines(segments, alive, net, color)
    if state.dim == 3:
        axes.add_collection3d(lines)
    else:
        axes.add_collection(lines)
    loose = np.bincount(net.edges[alive].ravel(), minlength=net.n_nodes) == 0
    for chosen, marker in ((loose, "o"), (_held(net, state, system), "s")):
        if chosen.any():
            axes.scatter(*nodes[chosen].T, s=12, marker=marker, color="black" if marker == "s" else "tab:gray")
    for i, name in enumerate(COORDINATES[: segments.shape[-1]]):
        getattr(axes, f"set_{name}lim")(*box[i])
        getattr(axes, f"set_{name}label")(f"{name} ({length_unit})")
    if state.dim == 1:
        axes.set_yticks([])
        axes.set_ylabel("")
    else:
        axes.set_aspect("equal")
    if color is not None:
        axes.figure.colorbar(lines, ax=axes, label=color_label)
    return axes


def animate(
    result: Result | OdeResult,
    net: Topology,
    path: str | pathlib.Path,
    frames_per_second: float = 20.0,
    length_unit: str = "m",
    system: System | None = None,
) -> pathlib.Path:
    """Write the saved frames of a run as an animated GIF; all frames share one scale.

    Args:
        result: of `rollout` with `save_every` (and no `observe`), or of `diffeqsolve` with `saveat`.
        net: the topology.
        path: the file to write, `.gif`; it is replaced at the end, whole.
        frames_per_second: speed of the film [1/s].
        length_unit: unit of the coordinates, for the labels.
        system: as in `plot`.

    Returns:
        The path.

    Raises:
        ImportError: matplotlib or Pillow is not installed.
        ValueError: a result without saved states, a state that is not finite, or a path that is no `.gif`.
        OSError: the folder is missing or cannot be written; said before anything is drawn.
    """
    pyplot = _pyplot()
    try:
        import PIL  # noqa: F401 (the writer below needs it, and its own error does not say so)
    except ImportError as error:
        raise ImportError("animate writes GIF files with Pillow, which is not installed. Run: pip install 'jaxspring[viz]'") from error
    from matplotlib.animation import PillowWriter

    saved = result.saved
    if not isinstance(saved, State) or saved.position[0].ndim == len(net.node_shape):
        raise ValueError("animate needs the saved states of a run: call rollout(..., save_every=...) without `observe`.")
    path = pathlib.Path(path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"path = {str(path)!r}, but the film is a GIF: let the name end in .gif.")
    frames = [jax.tree.map(lambda a, i=i: a[i], saved) for i in range(saved.position[0].shape[0])]
    box = _limits(np.concatenate([_flat(frame) for frame in frames]))
    figure = pyplot.figure(layout="constrained")
    axes = figure.add_subplot(projection="3d") if saved.dim == 3 else figure.add_subplot()
    writer = PillowWriter(fps=max(round(frames_per_second), 1))
    try:
        # The writer takes a name that ends in .gif, and writes there whatever happens: so elsewhere first.
        with atomic_file(path) as stream, tempfile.TemporaryDirectory() as folder:
            film = pathlib.Path(folder) / "film.gif"
            writer.setup(figure, film, dpi=100)
            for frame in frames:
                axes.clear()
                plot(net, frame, length_unit=length_unit, axes=axes, limits=box, system=system)
                axes.set_title(f"t = {float(frame.time):.3g} s")
                writer.grab_frame()
            writer.finish()
            stream.write(film.read_bytes())
    finally:
        pyplot.close(figure)
    return path


def _pyplot() -> Any:
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError("plots need matplotlib, which is not installed. Run: pip install 'jaxspring[viz]'") from error
    return pyplot


def _lines(segments: np.ndarray, alive: np.ndarray, net: Topology, color: Any) -> Any:
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    kind: Any = Line3DCollection if segments.shape[-1] == 3 else LineCollection
    if color is None:
        return kind(segments[alive], linewidths=1.0)
    flat = np.asarray(net.flatten(color) if isinstance(color, EdgeField) else color)
    has_shape("color", flat, {"one per spring": (net.n_springs,)})
    return kind(segments[alive], array=flat[alive], linewidths=1.0)


def _alive(net: Topology, state: State) -> np.ndarray:
    """(E,) which springs are whole. A state that tells of the springs of another net says nothing of this one's."""
    return np.asarray(net.flatten(state.alive_of(net)))


def _held(net: Topology, state: State, system: System | None) -> np.ndarray:
    """(N,) which nodes are held in some coordinate."""
    masks = () if system is None else tuple(mask for mask in system.free_masks(state.dim) if mask is not None)
    return np.any([~np.asarray(net.flatten_nodes(mask)) for mask in masks], axis=0) if masks else np.zeros(net.n_nodes, bool)


def _segments(net: Topology, state: State) -> np.ndarray:
    """(E, 2, D) ends of each spring; where the net is periodic, the head's image that is nearest to the tail. A chain gets y = 0."""
    if state.position.shape != net.node_shape:
        raise ValueError(f"the state's arrays have shape {state.position.shape}, the net's {net.node_shape}; pass one state of this net.")
    tails = _flat(state)[net.edges[:, 0]]
    d = net.difference(state.position)
    across = np.zeros_like(tails)
    for i in range(state.dim):
        across[:, i] = np.asarray(net.flatten(d.map(lambda v, i=i: v[i])))
    return np.stack([tails, tails + across], axis=1)


def _flat(state: State) -> np.ndarray:
    points = np.asarray(state.points)
    return np.pad(points, ((0, 0), (0, 1))) if points.shape[1] == 1 else points


def _limits(points: np.ndarray) -> np.ndarray:
    """(D, 2) range of each coordinate with a margin, never empty."""
    if not np.isfinite(points).all():
        raise ValueError("a position is NaN or infinite, so it cannot be drawn. raise_for_status(result) says where it began.")
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-6)
    return np.stack([low - margin, high + margin], axis=-1)
