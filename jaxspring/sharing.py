"""One large lattice over several devices: its rows are shared out, and what crosses a border are a few rows of neighbours per step.

The step itself is the one of a single device. Its differences and sums are shifted slices, which the compiler splits at the borders: each
device sends the rows that its neighbours read, and no device ever holds the whole.
"""

from __future__ import annotations

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .processes import spread
from .state import State


def domain(state: State, mesh: Mesh) -> State:
    """The state with the rows of its lattice shared out over devices: whatever runs on it under `jax.jit` runs on all of them.

    Args:
        state: of a lattice; rows are its first axis: the slowest, that of ny in (ny, nx).
        mesh: the devices, of this process or of several. Their number must divide that of the rows.

    Returns:
        The same state. Time, and what is of no node, is on every device.

    Raises:
        ValueError: a graph, whose springs may join any two nodes, so that no border is short; rows that the devices cannot share.

    >>> net = js.lattice((4, 3))
    >>> state = js.State.from_points(net, net.grid())
    >>> print(domain(state, jax.make_mesh((1,), ("rows",))).points[-1])
    [2. 3.]
    """
    shape, permutation = state.layout.shape, state.layout.permutation
    if permutation is not None:
        raise ValueError(
            "the state is of a graph: its springs may join any two nodes, so that devices would exchange whole states in every step. "
            "Take a lattice, or share many scenes by js.batch(..., mesh=mesh)."
        )
    if state.position[0].shape != shape:
        raise ValueError(f"the state's arrays have shape {state.position[0].shape}; expected one state of a lattice of {shape}.")
    if shape[0] % mesh.size:
        raise ValueError(f"the lattice has {shape[0]} rows, which {mesh.size} devices cannot share; expected a multiple of {mesh.size}.")
    rows, whole = shardings(mesh)
    return jax.tree.map(lambda a: spread(a, rows if a.shape == shape else whole), state)


def shardings(mesh: Mesh) -> tuple[NamedSharding, NamedSharding]:
    """How an array is shared out along its first axis, and how it is whole on every device.

    Along axes that are not explicit: arguments may come from anywhere, and what is computed of them may lie as it comes.
    """
    devices = Mesh(mesh.devices, mesh.axis_names)
    return NamedSharding(devices, PartitionSpec(mesh.axis_names)), NamedSharding(devices, PartitionSpec())


__all__ = ["domain", "shardings"]
