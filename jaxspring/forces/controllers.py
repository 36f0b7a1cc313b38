"""Controllers: what tells actuators their commands.

    open loop      c_g = 1 + a_g sin(2 pi f t + p_g)                                                          `Oscillators`
    closed loop    c = 1 + r tanh(W2 tanh(W1 s + b1) + b2)                                                    `NeuralController`
                   s: sin and cos of 2 pi f t and 4 pi f t, places about the centre over the size, velocities over 2 pi f size

Each is a tree of arrays, so that a fit may train it; what is not to be trained is static.

Source: the network with waves and sensors as inputs as in Hu and others (2020), in a smaller form.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, positive
from ..state import State

N_WAVES = 4  # sin and cos of the beat and of its double
FAINT = 0.1  # of the weight of what the sensors say, at first


class Oscillators(eqx.Module):
    """Commands that swing about 1, each by itself, whatever the robot does.

    Attributes:
        amplitude: (G,) a.
        phase: (G,) p [rad].
        frequency: f [Hz], one number.

    Raises:
        ValueError: amplitudes and phases of different numbers, or not finite.

    >>> import jaxspring as js
    >>> beat = Oscillators(amplitude=[0.2, 0.1], phase=[0.0, 1.5707963], frequency=1.0)
    >>> net = js.lattice(3)
    >>> print(beat(js.State.from_points(net, net.grid())))
    [1.  1.1]
    """

    amplitude: Array
    phase: Array
    frequency: Array

    def __init__(self, amplitude: Numbers, phase: Numbers, frequency: Numbers):
        self.amplitude, self.phase = as_inexact("amplitude", amplitude), as_inexact("phase", phase)
        self.frequency = as_inexact("frequency", frequency)
        for name in ("amplitude", "phase", "frequency"):
            finite(name, getattr(self, name))
        if self.amplitude.ndim != 1 or self.phase.shape != self.amplitude.shape or self.frequency.ndim != 0:
            raise ValueError(
                f"amplitude has shape {self.amplitude.shape}, phase {self.phase.shape}, frequency {self.frequency.shape}; expected (G,), "
                f"(G,) and one number."
            )

    def __call__(self, state: State) -> Array:
        """(G,) commands."""
        return 1 + self.amplitude * jnp.sin(2 * math.pi * self.frequency * state.time + self.phase)


class NeuralController(eqx.Module):
    """A network of one hidden layer that knows the time and, in a closed loop, where the nodes are and how fast they move.

    Places are those about their mean, in the node order of the net; so the commands do not depend on how far the robot has come.

    Attributes:
        first, first_bias: (H, S) and (H,), from the inputs to the hidden layer.
        second, second_bias: (G, H) and (G,), from there to the commands.
        frequency: f [Hz] (static).
        size: length by which places are divided [m] (static).
        reach: r, largest change of a command (static).
        senses: whether places and velocities are inputs (static).
    """

    first: Array
    first_bias: Array
    second: Array
    second_bias: Array
    frequency: float = eqx.field(static=True)
    size: float = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    senses: bool = eqx.field(static=True)

    @staticmethod
    def random(
        key: Array,
        like: State,
        n_commands: int,
        n_hidden: int = 16,
        frequency: float = 2.0,
        size: float = 0.1,
        reach: float = 0.2,
        senses: bool = True,
    ) -> NeuralController:
        """A network with weights drawn at random, in the dtype of a state.

        Args:
            key: of `jax.random`.
            like: a state of the robot, for its number of nodes and coordinates.
            n_commands: G.
            n_hidden: H.
            frequency: [Hz].
            size: [m], about that of a cell.
            reach: above 0, below 1.
            senses: False leaves the time alone: an open loop.

        Raises:
            ValueError: a frequency, size or reach that is not above zero.

        >>> import jax
        >>> import jaxspring as js
        >>> net = js.lattice(3)
        >>> start = js.State.from_points(net, net.grid())
        >>> print(NeuralController.random(jax.random.key(0), start, n_commands=2)(start).shape)
        (2,)
        """
        for name, value in (("frequency", frequency), ("size", size), ("reach", reach)):
            positive(name, as_inexact(name, value), "The network divides by it, or would command nothing.")
        n_inputs = N_WAVES + (2 * like.dim * math.prod(like.position.shape) if senses else 0)
        one, two = jax.random.split(key)
        first = jax.random.normal(one, (n_hidden, n_inputs), like.dtype)
        # A loop that listens to its sensors from the start is chaotic before it walks.
        is_wave = jnp.arange(n_inputs) < N_WAVES
        first = first * jnp.where(is_wave, 1 / math.sqrt(N_WAVES), FAINT / math.sqrt(n_inputs)).astype(like.dtype)[None, :]
        second = jax.random.normal(two, (n_commands, n_hidden), like.dtype) / math.sqrt(n_hidden)
        zeros = (jnp.zeros(n_hidden, like.dtype), jnp.zeros(n_commands, like.dtype))
        return NeuralController(first, zeros[0], second, zeros[1], float(frequency), float(size), float(reach), bool(senses))

    def inputs(self, state: State) -> Array:
        """(S,) what the network sees."""
        turns = 2 * math.pi * self.frequency * state.time * jnp.arange(1, 3, dtype=state.dtype)
        seen = [jnp.sin(turns), jnp.cos(turns)]
        if self.senses:
            seen += [jnp.ravel(a - jnp.mean(a)) / self.size for a in state.position]
            seen += [jnp.ravel(v) / (2 * math.pi * self.frequency * self.size) for v in state.velocity]
        return jnp.concatenate(seen)

    def __call__(self, state: State) -> Array:
        """(G,) commands."""
        hidden = jnp.tanh(self.first @ self.inputs(state) + self.first_bias)
        return 1 + self.reach * jnp.tanh(self.second @ hidden + self.second_bias)


__all__ = ["NeuralController", "Oscillators"]
