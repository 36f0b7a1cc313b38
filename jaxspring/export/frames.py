"""What every viewer's file is made of: states and fields, looked at once, as host arrays in the user's order.

Everything is refused here, by name, before a file is begun.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import numpy as np

from .._arrays import Numbers, given
from .._checks import triangle_indices
from ..numerics import is_traced
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, fields_of
from ..topology.periods import box_of
from ..vector import Vector

if TYPE_CHECKING:
    from ..ode import OdeResult
    from ..rollouts import Result

# One state, a state with a leading axis of frames, or a run that kept whole states.
States: TypeAlias = "State | Result | OdeResult"
NodeFields: TypeAlias = "Mapping[str, Numbers | Vector] | None"
SpringFields: TypeAlias = "Mapping[str, Numbers | EdgeField] | None"

# Names that a file gives to what the state holds, or that its readers take for something else.
RESERVED = {"alive", "numbers", "pos", "positions", "species", "symbols", "temperature", "velo", "velocity", "vertex1", "vertex2", "wraps"}
RESERVED |= {"Z", "x", "y", "z"}


@dataclass(frozen=True)
class Frames:
    """F states with their fields. What has no third coordinate has zero there.

    Attributes:
        is_series: whether the states had an axis of frames; else F = 1.
        time: (F,) [s].
        points: (F, N, 3) [m].
        node_fields: name -> (F, N) or (F, N, 3); velocity [m/s] and, where there is one, temperature [K] first.
        spring_fields: name -> (F, E).
        edges: (E, 2) node numbers.
        alive: (F, E) which springs are whole; None where springs of this net do not break.
        triangles: (T, 3) node numbers.
        box: (3,) periods [m], 0 where space does not repeat.
    """

    is_series: bool
    time: np.ndarray
    points: np.ndarray
    node_fields: dict[str, np.ndarray]
    spring_fields: dict[str, np.ndarray]
    edges: np.ndarray
    alive: np.ndarray | None
    triangles: np.ndarray
    box: np.ndarray

    def __len__(self) -> int:
        return len(self.time)


def frames_of(
    states: States, net: Topology, node_fields: NodeFields = None, spring_fields: SpringFields = None, triangles: Numbers | None = None
) -> Frames:
    """The states of a run, or one state, and the user's fields.

    Raises:
        TypeError: no state; something traced; a field that holds no real numbers.
        ValueError: no frames, or all of one time; states of another net; a NaN; a field of another shape, or under a name that cannot be
            one.
    """
    if not isinstance(net, Topology):
        raise TypeError(f"net is a {type(net).__name__}; expected the topology of the states, such as js.lattice(4) gives.")
    state = _states(states)
    if is_traced(state, net):
        raise TypeError("the states are traced (made inside jit, grad or vmap), so there are no numbers to write. Write them outside.")
    n_axes = state.position[0].ndim - len(state.layout.shape)
    if state.layout.shape != net.node_shape or n_axes not in (0, 1):
        raise ValueError(
            f"the states' arrays have shape {state.position[0].shape}, the net's nodes {net.node_shape}; expected one state of this net, "
            f"or one more axis, of frames. Of a batch of runs take one: jax.tree.map(lambda a: a[0], states)."
        )
    is_series = n_axes == 1
    points = _framed(_numbers("points", state.points), is_series)
    if not len(points):
        raise ValueError("the states have an axis of 0 frames, so there is nothing to write.")
    time = np.broadcast_to(_numbers("time", state.time), (len(points),))
    if len(time) > 1 and (time == time[0]).all():
        raise ValueError(
            f"all {len(time)} frames are of the time {time[0]} s, by which viewers tell them apart. Of a batch write one each: "
            f"jax.tree.map(lambda a: a[0], states). To steps of a load give times: "
            f"dataclasses.replace(states, time=jnp.arange({len(time)}.0))."
        )
    fields = {"velocity": _padded(_framed(_numbers("velocities", state.velocities), is_series))}
    if state.temperature is not None:
        fields["temperature"] = _framed(_numbers("temperatures", state.temperatures), is_series)
    reader = _Reader(net, len(points), state.dim, is_series)
    box = np.zeros(3) if box_of(net) is None else np.pad(np.asarray(box_of(net), float), (0, 3 - state.dim))
    return Frames(
        is_series=is_series,
        time=time,
        points=_padded(points),
        node_fields=fields | reader.all("node_fields", node_fields, reader.node_field),
        spring_fields=reader.all("spring_fields", spring_fields, reader.spring_field),
        edges=np.asarray(net.edges).reshape(-1, 2),
        alive=_alive(net, state, len(points), is_series),
        triangles=np.zeros((0, 3), np.int32) if triangles is None else triangle_indices("triangles", triangles, net.n_nodes),
        box=box,
    )


def _states(states: Any) -> State:
    if isinstance(states, State):
        return states
    if not hasattr(states, "saved"):
        raise TypeError(f"states is a {type(states).__name__}; expected a State, or what rollout returned with save_every.")
    if not isinstance(states.saved, State):
        raise ValueError(
            f"the run kept no whole states (saved is a {type(states.saved).__name__}). Run rollout with save_every and without observe, or "
            f"pass result.state for its end."
        )
    return states.saved


@dataclass(frozen=True)
class _Reader:
    """Reads the user's fields for F frames of a net in D coordinates."""

    net: Topology
    n_frames: int
    dim: int
    is_series: bool

    def all(self, argument: str, fields: Mapping[str, Any] | None, read: Callable[[str, Any], np.ndarray]) -> dict[str, np.ndarray]:
        """Every field under its name."""
        if fields is None:
            return {}
        if not isinstance(fields, Mapping):
            raise TypeError(f"{argument} is a {type(fields).__name__}; expected names and arrays, e.g. {{'tension': array}}.")
        for name in fields:
            if not (isinstance(name, str) and name.isascii() and name.isidentifier()):
                raise ValueError(f"{argument} has the name {name!r}; expected a word of letters, digits and '_', which every reader takes.")
            if name in RESERVED:
                raise ValueError(f"{argument} has the name {name!r}, which the file or its readers use themselves. Choose another.")
        return {name: read(f"{argument}[{name!r}]", value) for name, value in fields.items()}

    def node_field(self, name: str, value: Any) -> np.ndarray:
        """(F, N), or (F, N, 3) of a vector."""
        array, n = _numbers(name, self._stacked(name, value)), self.net.n_nodes
        lead, of_frame = ((self.n_frames,), "frame and ") if self.is_series else ((), "")
        allowed = {"one per node": (n,), f"one per {of_frame}node": (*lead, n), "a vector of each": (*lead, n, self.dim)}
        _check_shape(name, array, allowed | {"node shape": (*lead, *self.net.node_shape)})
        if array.shape == (n,):
            return np.broadcast_to(array, (self.n_frames, n))
        framed = array if self.is_series else array[None]
        return _padded(framed) if framed.shape[1:] == (n, self.dim) else framed.reshape(self.n_frames, n)

    def spring_field(self, name: str, value: Any) -> np.ndarray:
        """(F, E)."""
        array, n = _numbers(name, self._flat(name, value)), self.net.n_springs
        allowed = {"one per spring": (n,)} | ({"one per frame and spring": (self.n_frames, n)} if self.is_series else {})
        _check_shape(name, array, allowed)
        return np.broadcast_to(array, (self.n_frames, n))

    def _stacked(self, name: str, value: Any) -> Any:
        """The coordinates of a `Vector`, which is in the net's own order, in the user's; anything else as it is."""
        if not isinstance(value, Vector):
            return value
        _refuse_traced(name, value)
        if value.shape[-len(self.net.node_shape) :] != self.net.node_shape:
            raise ValueError(f"{name} is a Vector of arrays of shape {value.shape}; the net's nodes have {self.net.node_shape}.")
        return np.stack([np.asarray(self.net.flatten_nodes(a)) for a in value], axis=-1)

    def _flat(self, name: str, value: Any) -> Any:
        """An edge field, of one state or of all frames, in the user's order; anything else as it is."""
        if not isinstance(value, EdgeField):
            return value
        _refuse_traced(name, value)
        has_frames = self.is_series and [np.shape(a)[1:] for a in value.families] == list(self.net.family_shapes)
        if not has_frames or not value.families:
            return self.net.flatten(self.net.edge_field(value, name))
        self.net.edge_field(jax.tree.map(lambda a: a[0], value), name)  # whose springs they are
        return jax.vmap(self.net.flatten)(value)


def _check_shape(name: str, array: np.ndarray, allowed: dict[str, tuple[int, ...]]) -> None:
    if array.shape not in allowed.values():
        listed = ", or ".join(f"{shape} ({meaning})" for meaning, shape in allowed.items())
        raise ValueError(f"{name} has shape {array.shape}; expected {listed}.")


def _refuse_traced(name: str, value: Any) -> None:
    if is_traced(value):
        raise TypeError(f"{name} is traced (made inside jit, grad or vmap), so it has no numbers to write. Write it outside.")


def _numbers(name: str, value: Any) -> np.ndarray:
    """A host array of float32, float64, int32 or booleans, all finite."""
    array = given(name, value)
    _refuse_traced(name, array)
    array = np.asarray(array)
    if array.dtype == np.bool_:
        return array
    if array.dtype.kind == "c":
        raise TypeError(f"{name} has dtype {array.dtype}; expected real numbers. Write its real part, or its absolute value.")
    if array.dtype.kind in "iu":
        if array.size and (array.min() < -(2**31) or array.max() >= 2**31):
            raise ValueError(f"{name} holds whole numbers beyond 32 bits, which not every format has. Pass {name}.astype(float).")
        return array.astype(np.int32)
    # Half precision is widened, and what is longer than float64 is cut.
    array = array.astype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    bad = ~np.isfinite(array)
    if bad.any():
        index = [int(i) for i in np.argwhere(bad)[0]]
        raise ValueError(
            f"{name}{index if index else ''} = {array[tuple(index)]}, which no viewer draws ({int(bad.sum())} of {array.size} values are "
            f"not finite). Leave it out; raise_for_status(result) says where it began in a run."
        )
    return array


def _framed(array: np.ndarray, is_series: bool) -> np.ndarray:
    return array if is_series else array[None]


def _padded(vectors: np.ndarray) -> np.ndarray:
    """(F, N, 3) of (F, N, D)."""
    return np.pad(vectors, ((0, 0), (0, 0), (0, 3 - vectors.shape[-1])))


def _alive(net: Topology, state: State, n_frames: int, is_series: bool) -> np.ndarray | None:
    """(F, E), or None where the state tells nothing of this net's springs."""
    first = jax.tree.map(lambda a: a[0], state) if is_series else state
    place = next((i for i, field in enumerate(fields_of(first.alive)) if net.owns(field)), None)
    if place is None or not net.n_springs:
        return None
    alive = fields_of(state.alive)[place]
    flat = np.asarray(jax.vmap(net.flatten)(alive) if is_series else net.flatten(alive))
    return np.broadcast_to(flat, (n_frames, net.n_springs))


__all__ = ["Frames", "NodeFields", "SpringFields", "States", "frames_of"]
