"""The state of a simulation: time, position, velocity, and what the scene's effects add."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import printing
from ._arrays import Numbers, kept
from ._checks import as_inexact, finite, has_shape
from .memory import Memories
from .topology.base import NodeLayout, Topology
from .topology.edge_field import EdgeField, OfNets, field_of, with_field
from .vector import Vector


class State(eqx.Module):
    """Where everything is, and how fast it moves. Build it with `State.from_points`.

    Attributes:
        time: [s], a 0-d array.
        position: `Vector` in node shape [m].
        velocity: `Vector` in node shape [m/s].
        layout: how node fields are stored (static).
        temperature: node shape [K], or None where the scene has no heat. On a graph this is the graph's own order, as it is of all that is
            in node shape: `temperatures`, `points` and `velocities` are the user's.
        enthalpy: heat that melting has taken up, of each node [J], or None without latent heat.
        alive: bool edge field, False where a spring has broken; a tuple of such fields where the springs of several nets break; None where
            none does. `alive_of(net)` is that of one net.
        rest_length: edge field [m] of rest lengths that have changed for good, or a tuple of several nets', or None.
        memory: what single effects remember, an entry for each part of the system that made the state (`Memory`); None where no part
            remembers anything.

    What is None is not there: it costs nothing, and its effect is not in the scene.
    """

    time: Array = eqx.field(converter=kept)
    position: Vector
    velocity: Vector
    layout: NodeLayout = eqx.field(static=True)
    temperature: Array | None = eqx.field(converter=kept, default=None)
    enthalpy: Array | None = eqx.field(converter=kept, default=None)
    alive: OfNets = None
    rest_length: OfNets = None
    memory: Memories = None

    def __str__(self) -> str:
        """A few lines for a person."""
        return printing.state(self)

    @staticmethod
    def from_points(
        net: Topology, points: Numbers, velocities: Numbers | None = None, time: Numbers = 0.0, temperature: Numbers | None = None
    ) -> State:
        """A state from (N, D) arrays in the user's node order.

        Args:
            net: the topology.
            points: (N, D) positions [m], D = 1, 2 or 3. Integers are converted to the default float.
            velocities: (N, D) velocities [m/s]; None is at rest.
            time: [s].
            temperature: [K]: one number, or (N,) in the user's order; None where the scene has no heat.

        Raises:
            ValueError: a wrong shape, or a NaN or infinity, named with its index.
            TypeError: half precision, complex numbers.
        """
        position = net.vector_field(points, "points")
        if velocities is None:
            velocity = Vector.zeros_like(position)
        else:
            velocity = net.vector_field(as_inexact("velocities", velocities, position.dtype), "velocities")
            if velocity.dim != position.dim:
                raise ValueError(f"velocities have {velocity.dim} coordinates, points have {position.dim}.")
        if temperature is not None:
            temperature = as_inexact("temperature", temperature, position.dtype)
            has_shape("temperature", temperature, {"one number": (), "one per node": (net.n_nodes,), "node shape": net.node_shape})
            finite("temperature", temperature)
            temperature = jnp.broadcast_to(net.node_field(temperature, "temperature"), net.node_shape)
        time = as_inexact("time", time, position.dtype)
        has_shape("time", time, {"one number": ()})
        finite("time", time)
        return State(time, position, velocity, net.layout, temperature)

    def moved(self, position: Vector, velocity: Vector, time: Array | None = None) -> State:
        """The state at another place, velocity and (where given) time, all else as it is."""
        time = self.time if time is None else time
        return dataclasses.replace(self, time=time, position=position, velocity=velocity)

    def alive_of(self, net: Topology) -> EdgeField:
        """Which springs of this net hold, a bool edge field; all of them where none breaks."""
        found = field_of(net, self.alive)
        return net.everywhere(jnp.ones((), bool)) if found is None else found

    def rest_length_of(self, net: Topology) -> EdgeField | None:
        """Rest lengths of this net's springs that have changed for good [m], or None."""
        return field_of(net, self.rest_length)

    def with_alive(self, net: Topology, alive: EdgeField) -> State:
        """The state where these springs of this net hold."""
        return dataclasses.replace(self, alive=with_field(net, self.alive, net.own(alive.families)))

    def with_rest_length(self, net: Topology, rest_length: EdgeField) -> State:
        """The state where this net's springs have these rest lengths [m]."""
        return dataclasses.replace(self, rest_length=with_field(net, self.rest_length, net.own(rest_length.families)))

    def checked(self) -> State:
        """The state itself, where a system can take it. Whatever takes a state asks here.

        Raises:
            TypeError: float64 while JAX's x64 is off.
            ValueError: a leading axis of states or frames, outside of `jax.vmap`.
        """
        if jax.dtypes.canonicalize_dtype(self.dtype) != self.dtype:
            raise TypeError(
                f"the state is {self.dtype}, but x64 is switched off, so that JAX would mix it with float32. Switch it on again with "
                f"jax.config.update('jax_enable_x64', True), or make the state anew: it is float32 then."
            )
        if self.position.shape != self.layout.shape:
            raise ValueError(
                f"the state's positions have shape {self.position.shape}, those of one state {self.layout.shape}: these are many states (a "
                f"batch, or the frames of a run). Take one, jax.tree.map(lambda a: a[0], states), or all by jax.vmap: "
                f"jax.vmap(lambda state: ...)(states)."
            )
        return self

    @property
    def points(self) -> Array:
        """(..., N, D) positions [m] in the user's node order."""
        return jnp.stack([self.layout.flatten(a) for a in self.position], axis=-1)

    @property
    def velocities(self) -> Array:
        """(..., N, D) velocities [m/s] in the user's node order."""
        return jnp.stack([self.layout.flatten(a) for a in self.velocity], axis=-1)

    @property
    def temperatures(self) -> Array:
        """(..., N) temperatures [K] in the user's node order."""
        if self.temperature is None:
            raise ValueError("this state has no temperature. Pass temperature=... to State.from_points.")
        return self.layout.flatten(self.temperature)

    @property
    def dtype(self) -> jnp.dtype:
        """Floating type of the simulation."""
        return self.position.dtype

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return self.position.dim
