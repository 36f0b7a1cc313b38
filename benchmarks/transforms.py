"""Which transform goes through which stepper, and is it right? Every cell is measured, on the jax that runs this.

    python -m benchmarks.transforms

writes the tables of `docs/transforms.md` for the running version of jax; those of other versions stay. A cell says `right` where the
result agrees with central differences in float64 (second derivatives with differences of the gradient), else how far off it is or what
was raised. `tests/transforms/test_every_transform.py` asks for the same cells.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np

import jaxspring as js
from jaxspring.scenes.melting.scene import MeltSettings, melting_block

PAGE = Path(__file__).parent.parent / "docs" / "transforms.md"
Function = Callable[[jax.Array], jax.Array]

# Where derivatives are taken, and along what.
AT = np.array([1.1, 0.9])
ALONG = np.array([0.6, -0.8])
# Rounding and truncation of a central difference are both below 1e-8 of the value here.
STEP = 1e-4
CLOSE = 2e-5


def chain(stepper: js.Stepper) -> Function:
    """Scales of stiffness and drag -> where two steps of a bent chain of three nodes lead."""
    net = js.lattice(3)
    points = np.array([[0.0, 0.0], [1.1, 0.2], [1.8, -0.3]])
    velocities = np.array([[0.0, 0.0], [0.3, -0.2], [-0.1, 0.4]])

    def end(p: jax.Array) -> jax.Array:
        start = js.State.from_points(net, points, velocities)
        forces = (js.Springs(net, 40.0 * p[0], 1.0), js.Drag(0.5 * p[1]), js.Gravity([0.0, -9.81]))
        system = js.System(net, 0.7, forces, free=np.array([False, True, True]))
        return js.rollout(system, start, stepper, 0.05, 2).state.points[1:].ravel()

    return end


def balance(p: jax.Array) -> jax.Array:
    """Scales of stiffness and weight -> where a chain hangs in balance."""
    net = js.lattice(3)
    start = js.State.from_points(net, np.array([[0.0, 0.0], [1.0, -0.1], [2.0, 0.0]]))
    forces = (js.Springs(net, 40.0 * p[0], 0.9), js.Gravity(jnp.stack([jnp.zeros(()), -9.81 * p[1]])))
    system = js.System(net, 0.7, forces, free=np.array([False, True, False]))
    return js.equilibrium(system, start, tolerance=1e-13).state.points[1]


def heat(scheme: js.thermal.HeatScheme) -> Function:
    """Scales of conductance and capacity -> temperatures of a block of 2 x 3 nodes after two steps."""
    net = js.lattice((2, 3))
    temperature = np.array([300.0, 340.0, 310.0, 420.0, 305.0, 390.0])

    def end(p: jax.Array) -> jax.Array:
        start = js.State.from_points(net, np.asarray(net.grid(), float), temperature=temperature)
        rule = js.Heat(net, 2.0 * p[1], 3.0 * p[0], scheme=scheme)
        system = js.System(net, 1.0, rules=rule)
        temperatures = js.rollout(system, start, js.Still(), 0.1, 2).state.temperature
        assert temperatures is not None
        return temperatures.ravel() / 300

    return end


def bounce(p: jax.Array) -> jax.Array:
    """Scales of restitution and weight -> where two balls are after they have met the floor, the second within a step."""
    net = js.lattice(2)
    start = js.State.from_points(net, np.array([[0.0, 0.3], [1.0, 0.05]]), np.array([[1.0, 0.0], [0.0, -1.0]]))
    weight = js.Gravity(jnp.stack([jnp.zeros(()), -9.81 * p[1]]))
    system = js.System(net, 1.0, weight, rules=js.Floor((0.0, 0.0), (0.0, 1.0), restitution=0.6 * p[0], friction=0.1))
    return js.rollout(system, start, js.VelocityVerlet(), 0.15, 2).state.points.ravel()


def fluid(pairs: js.fluid.Pairs) -> Function:
    """Scales of depth and diameter -> where four particles of a Lennard-Jones fluid with pair drag are after two steps."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 4)
    points = np.array([[0.0, 0.0], [1.2, 0.1], [0.3, 1.1], [1.5, 1.4]])

    def end(p: jax.Array) -> jax.Array:
        law = js.fluid.LennardJones(p[0], p[1])
        force = js.Fluid(law, cutoff=js.fluid.ShiftedForce(2.5), pairs=pairs, drag=js.fluid.PairDrag(0.5, 2.0))
        start = js.State.from_points(net, points, 0.3 * points[::-1])
        return js.rollout(js.System(net, 1.0, force), start, js.VelocityVerlet(), 0.05, 2).state.points.ravel()

    return end


def melting(p: jax.Array) -> jax.Array:
    """Scales of stiffness and conductivity -> velocities and temperatures of the melting block after two steps, its lowest layer molten."""
    with jax.ensure_compile_time_eval():
        scene = melting_block(MeltSettings(nodes=(2, 2, 3)))
        points = np.asarray(scene.state.points) * [1.1, 1.0, 1.05] + [0.0, 0.0, 1e-3]

    def constants(system: Any) -> tuple[Any, Any]:
        return system.forces[0].stiffness.full, system.rules[0].conductance

    full, conductance = constants(scene.system)
    system = eqx.tree_at(constants, scene.system, (p[0] * full, p[1] * conductance))
    start = js.State.from_points(scene.net, points, temperature=np.repeat([360.0, 340.0, 310.0], 4))
    state = js.rollout(system, start, js.SymplecticEuler(), 4e-4, 2).state
    assert state.temperature is not None
    return jnp.concatenate([state.velocities.ravel(), state.temperature.ravel() / 300])


STEPPERS: dict[str, Function] = {
    "ForwardEuler": chain(js.ForwardEuler()),
    "SymplecticEuler": chain(js.SymplecticEuler()),
    "VelocityVerlet": chain(js.VelocityVerlet()),
    "RungeKutta4": chain(js.RungeKutta4()),
    "SemiImplicit": chain(js.SemiImplicit()),
    "BackwardEuler, linear": chain(js.BackwardEuler(js.JaxCG(tolerance=1e-12))),
    "BackwardEuler, Newton": chain(
        js.BackwardEuler(newton=js.Newton(tolerance=1e-13), adjoint=js.linalg.ExactSolver(js.CG(tolerance=1e-12)))
    ),
    "ImplicitMidpoint": chain(
        js.ImplicitMidpoint(newton=js.Newton(tolerance=1e-13), adjoint=js.linalg.ExactSolver(js.CG(tolerance=1e-12)))
    ),
    "BDF2": chain(js.BDF2(newton=js.Newton(tolerance=1e-13), adjoint=js.linalg.ExactSolver(js.CG(tolerance=1e-12)))),
}
OTHERS: dict[str, Function] = {
    "CG": chain(js.BackwardEuler(js.CG(tolerance=1e-12))),
    "CG, Multigrid": chain(js.BackwardEuler(js.CG(tolerance=1e-12, preconditioner=js.linalg.Multigrid(js.lattice(3))))),
    "Skyline": chain(js.BackwardEuler(js.Skyline(js.lattice(3)))),
    "Lineax": chain(js.BackwardEuler(js.linalg.Lineax(lineax.CG(rtol=1e-12, atol=1e-14)))),
    "equilibrium": balance,
    "ExplicitHeat": heat(js.thermal.ExplicitHeat()),
    "BackwardEulerHeat": heat(js.thermal.BackwardEulerHeat(js.JaxCG(tolerance=1e-13))),
    "CrankNicolsonHeat": heat(js.thermal.CrankNicolsonHeat(js.JaxCG(tolerance=1e-13))),
    "SplitHeat": heat(js.thermal.SplitHeat()),
    "SymmetricSplitHeat": heat(js.thermal.SymmetricSplitHeat()),
}
SCENES: dict[str, Function] = {
    "a bounce with friction": bounce,
    "fluid, all pairs": fluid(js.fluid.AllPairs()),
    "fluid, neighbour list": fluid(js.fluid.NeighbourList(capacity=3, skin=0.3)),
    "melting block": melting,
}


def loss(function: Function) -> Function:
    """A number of what `function` gives."""
    return lambda p: jnp.sum(jnp.sin(function(p)))


class Differences:
    """What every transform of one function is compared with, from its values and first gradients alone."""

    def __init__(self, function: Function):
        self.function = function
        self.value = jax.jit(function)
        self.gradient = jax.jit(jax.grad(loss(function)))

    def jacobian(self) -> np.ndarray:
        """(values, 2) by differences of values."""
        return np.stack([np.asarray(self.value(AT + STEP * e) - self.value(AT - STEP * e)) / (2 * STEP) for e in np.eye(2)], axis=1)

    def of_loss(self, at: np.ndarray) -> np.ndarray:
        """(2,) gradient of the loss by differences of values."""
        total = [float(np.sum(np.sin(self.value(at + STEP * sign * e)))) for e in np.eye(2) for sign in (1, -1)]
        return np.array([total[0] - total[1], total[2] - total[3]]) / (2 * STEP)

    def hessian(self) -> np.ndarray:
        """(2, 2) by differences of gradients."""
        return np.stack([(self.gradient(AT + STEP * e) - self.gradient(AT - STEP * e)) / (2 * STEP) for e in np.eye(2)])


# Name -> (what it makes of a function, what is right).
TRANSFORMS: dict[str, tuple[Callable[[Function], Function], Callable[[Differences], Any]]] = {
    "jit": (lambda f: f, lambda d: d.function(jnp.asarray(AT))),
    "vmap": (lambda f: lambda p: jax.vmap(f)(jnp.stack([p, 1.05 * p])), lambda d: np.stack([d.value(AT), d.value(1.05 * AT)])),
    "grad": (lambda f: jax.grad(loss(f)), lambda d: d.of_loss(AT)),
    "vmap(grad)": (
        lambda f: lambda p: jax.vmap(jax.grad(loss(f)))(jnp.stack([p, 1.05 * p])),
        lambda d: np.stack([d.of_loss(AT), d.of_loss(1.05 * AT)]),
    ),
    "checkpoint": (lambda f: jax.grad(loss(jax.checkpoint(f))), lambda d: d.of_loss(AT)),
    "jvp": (lambda f: lambda p: jax.jvp(f, (p,), (jnp.asarray(ALONG),))[1], lambda d: d.jacobian() @ ALONG),
    "linearize": (lambda f: lambda p: jax.linearize(f, p)[1](jnp.asarray(ALONG)), lambda d: d.jacobian() @ ALONG),
    "jacfwd": (jax.jacfwd, lambda d: d.jacobian()),
    "jacrev": (jax.jacrev, lambda d: d.jacobian()),
    "hessian": (lambda f: jax.hessian(loss(f)), lambda d: d.hessian()),
}


def cell(function: Function, differences: Differences, transform: str) -> str:
    """`right`, or in one sentence what is not."""
    transformed, wanted = TRANSFORMS[transform]
    try:
        found, right = np.asarray(jax.jit(transformed(function))(AT)), np.asarray(wanted(differences))
    except Exception as error:  # Whatever a transform raises is what its cell must say.
        return f"{type(error).__name__}: {str(error).splitlines()[0][:80]}"
    size = max(float(np.max(np.abs(right))), 1e-3)
    off = float(np.max(np.abs(found - right))) / size
    return "right" if found.shape == right.shape and off <= CLOSE else f"off by {off:.1e}"


def table(title: str, rows: dict[str, Function]) -> str:
    """A markdown table, one line per function; says on stderr how far it is."""
    lines = [f"| {title} | " + " | ".join(TRANSFORMS) + " |", "|---|" + "---|" * len(TRANSFORMS)]
    for name, function in rows.items():
        differences = Differences(function)
        lines.append(f"| {name} | " + " | ".join(cell(function, differences, transform) for transform in TRANSFORMS) + " |")
        sys.stderr.write(lines[-1] + "\n")
    return "\n".join(lines)


def main() -> None:
    """Write the tables of the running version of jax."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    jax.config.update("jax_enable_x64", True)
    # Programs run once: compiling is all that takes time.
    jax.config.update("jax_disable_most_optimizations", True)
    section = f"## jax {jax.__version__}\n\n{table('stepper', STEPPERS)}\n\n{table('solver, scheme', OTHERS)}\n\n{table('scene', SCENES)}\n"
    head, *others = re.split(r"^(?=## jax )", PAGE.read_text(), flags=re.MULTILINE)
    kept = [other.strip() + "\n" for other in others if not other.startswith(f"## jax {jax.__version__}\n")]
    PAGE.write_text("\n".join([head.strip() + "\n", *sorted([*kept, section])]))


if __name__ == "__main__":
    main()
