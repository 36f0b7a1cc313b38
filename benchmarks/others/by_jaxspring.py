"""The library as a user calls it: rollouts with their statuses on, gradients by `jax.grad`, batches by `jax.vmap`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js
from benchmarks import scenes

from .layouts import Forms, Program, Scene
from .robots import CHECKED_ROBOTS, PARTS


def forms(scene: Scene) -> Forms:
    """One form of each: what the library chooses."""
    if "robots" in str(scene["kind"]):
        return {f"chunks of {n}": lambda n=n: robots(scene, n) for n in (16, 64)}
    make = {
        "cloth": positions,
        "mesh": positions,
        "gradient cloth": gradient,
        "gradient mesh": gradient,
        "batch": batch,
        "heat": heat,
        "image": samples,
        "gradient image": slopes,
        "fluid": fluid,
        "implicit": implicit,
    }
    return {"rollout": lambda: make[str(scene["kind"])](scene)}


def system_of(scene: Scene) -> tuple[js.System, Any]:
    """System and net, masses one."""
    edges, shape = scene["edges"], scene["shape"].tolist() if "offsets" in scene else None
    net: Any = js.Graph.from_edges(edges, scene["x"].shape[-2]) if shape is None else js.lattice(tuple(shape), springs=scenes.FAMILIES)
    assert np.array_equal(net.edges, edges), "springs in the scene's order"
    k = scene["k"] if scene["k"].ndim == 1 else scene["k"][0]
    return js.System(net, mass=np.float32(1), forces=js.Springs(net, k, scene["l"])), net


def kept(run: Callable[[int], Any], of_last: Callable[[Any], Any]) -> Program:
    """A program that blocks, and keeps what came out."""
    last: list[Any] = [None]

    def timed(n_steps: int) -> None:
        last[0] = jax.block_until_ready(run(n_steps))

    return Program(timed, lambda: np.asarray(of_last(last[0])))


def positions(scene: Scene) -> Program:
    """`rollout`, as it is."""
    system, net = system_of(scene)
    state, dt = js.State.from_points(net, scene["x"], scene["v"]), scene["dt"]
    return kept(lambda n: js.rollout(system, state, js.SymplecticEuler(), dt, n), lambda end: end.state.points)


def implicit(scene: Scene) -> Program:
    """Backward Euler with the solver that the library chooses."""
    system, net = system_of(scene)
    state, dt = js.State.from_points(net, scene["x"], scene["v"]), scene["dt"]
    return kept(lambda n: js.rollout(system, state, js.BackwardEuler(), dt, n), lambda end: end.state.points)


def gradient(scene: Scene) -> Program:
    """`jax.grad` of a loss over the rollout, by every k and l, jitted."""
    system, net = system_of(scene)
    state = js.State.from_points(net, scene["x"], scene["v"])
    programs: dict[int, Any] = {}

    def run(n_steps: int) -> Any:
        if n_steps not in programs:
            programs[n_steps] = scenes.gradient_program(system, state, scene["dt"], n_steps)
        function, arrays = programs[n_steps]
        return function(*arrays)

    return kept(run, lambda found: np.stack([np.asarray(a) for a in found]))


def batch(scene: Scene) -> Program:
    """`jax.vmap` over states and stiffnesses, jitted."""
    system, net = system_of(scene)
    dt = scene["dt"]

    def batched(x: Any, v: Any, k: Any, n_steps: int) -> Any:
        def one(x: Any, v: Any, k: Any) -> Any:
            start = js.State.from_points(net, x, v)
            end = js.rollout(js.replace(system, stiffness=k), start, js.SymplecticEuler(), dt, n_steps)
            return end.state.points, end.status

        return jax.vmap(one)(x, v, k)

    run: Any = jax.jit(batched, static_argnums=3)
    arrays = [jnp.asarray(scene[name]) for name in ("x", "v", "k")]
    return kept(lambda n: run(*arrays, n), lambda end: end[0])


def heat(scene: Scene) -> Program:
    """`Heat` of a system whose nodes stand still."""
    net = js.lattice(tuple(scene["shape"].tolist()))
    system = js.System(net, np.float32(1), rules=js.Heat(net, np.float32(1), scene["g"]))
    state = js.State.from_points(net, net.grid().astype(np.float32), temperature=scene["start"])
    return kept(lambda n: js.rollout(system, state, js.Still(), scene["dt"], n), lambda end: end.state.temperatures)


def _image_program(scene: Scene, function: Callable[[js.Image, Any, Any], Any]) -> Program:
    program = jax.jit(function)
    image, x, y = js.Image(scene["image"]), jnp.asarray(scene["x"]), jnp.asarray(scene["y"])

    def run(n_steps: int) -> Any:
        found = None
        for _ in range(n_steps):
            found = jax.block_until_ready(program(image, x, y))
        return found

    return kept(run, lambda found: np.stack(found) if isinstance(found, tuple) else found)


def samples(scene: Scene) -> Program:
    """`Image.sample`, jitted."""
    return _image_program(scene, lambda image, x, y: image.sample(x, y))


def slopes(scene: Scene) -> Program:
    """`jax.grad` of the sum of squared samples by the points, jitted."""
    return _image_program(scene, jax.grad(lambda image, x, y: jnp.sum(image.sample(x, y) ** 2), argnums=(1, 2)))


def fluid(scene: Scene) -> Program:
    """`Fluid` with a neighbour list that is remade when it must be."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), len(scene["x"]))
    pairs = js.fluid.NeighbourList(scene.number("capacity"), scene.number("skin"))
    law = js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.ShiftedForce(scene.number("reach")), pairs)
    system = js.System(net, 1.0, law)
    state = eqx.filter_jit(lambda s: system.begin(s))(js.State.from_points(net, scene["x"], scene["v"]))
    return kept(lambda n: js.rollout(system, state, js.VelocityVerlet(), scene.number("dt"), n), lambda end: end.state.points)


def robots(scene: Scene, chunk: int) -> Program:
    """`js.robot.distance` of many controllers, or its gradient by all weights, by `js.batch`."""
    names = {
        "cell": "size",
        "node_mass": "mass",
        "stiffness": "k",
        **{n: n for n in ("damping", "friction", "gravity", "frequency", "reach", "dt")},
    }
    numbers: dict[str, Any] = {name: float(scene[of]) for name, of in names.items()}
    settings = js.robot.RobotSettings(**numbers)
    net = js.Graph.from_edges(scene["edges"], len(scene["x"]))
    robot = js.robot.walking_robot(settings, net=net, points=scene["x"], groups=scene["groups"], dtype=jnp.dtype(jnp.float32))
    n_nodes, order = net.n_nodes, net.node_permutation.order
    # The library's network reads nodes in the net's own order, the scene's in that of its points.
    columns = np.concatenate([np.arange(4), *(4 + d * n_nodes + order for d in range(4))])

    def walked(parts: Any, n_steps: int) -> Any:
        first, first_bias, second, second_bias = parts
        like = robot.controller
        controller = eqx.tree_at(
            lambda c: (c.first, c.first_bias, c.second, c.second_bias), like, (first[:, columns], first_bias, second, second_bias)
        )
        return js.robot.distance(robot, controller, n_steps)

    wanted = jax.grad(walked) if str(scene["kind"]).startswith("gradient") else walked
    programs: dict[int, Any] = {}
    weights = tuple(jnp.asarray(scene[name]) for name in PARTS)

    def run(n_steps: int) -> Any:
        if n_steps not in programs:
            programs[n_steps] = jax.jit(js.batch(lambda parts: wanted(parts, n_steps), chunk=chunk))
        return programs[n_steps](weights)

    def last(found: Any) -> Any:
        if not isinstance(found, tuple):
            return found
        return np.concatenate([np.asarray(part)[:CHECKED_ROBOTS].reshape(CHECKED_ROBOTS, -1) for part in found], axis=1)

    return kept(run, last)
