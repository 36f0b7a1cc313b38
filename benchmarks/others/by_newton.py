"""Newton's semi-implicit solver, which is symplectic Euler, on the CPU: its springs alone, all steps in one graph."""

# pyright: reportMissingImports=false

from typing import Any

import newton
import numpy as np
import warp as wp

from .layouts import Forms, Program, Scene, sorted_graph

wp.config.quiet = True


def forms(scene: Scene) -> Forms:
    """Its springs have one form: each is added to both of its ends by atomics."""
    return {"SolverSemiImplicit": lambda: forward(scene)}


def _model(scene: Scene, order: np.ndarray, edges: np.ndarray, springs: np.ndarray) -> Any:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    n = len(order)
    builder.add_particles([wp.vec3(*a) for a in scene["x"][order].tolist()], [wp.vec3(*a) for a in scene["v"][order].tolist()], [1.0] * n)
    # The same as `add_spring` for each, which takes long.
    builder.spring_indices = edges.ravel().tolist()
    builder.spring_rest_length = scene["l"][springs].tolist()
    builder.spring_stiffness = scene["k"][springs].tolist()
    builder.spring_damping = builder.spring_control = [0.0] * len(edges)
    model = builder.finalize(device="cpu")
    model.particle_grid = None
    model.particle_max_velocity = 1e9
    return model


def forward(scene: Scene) -> Program:
    """Two states that take turns, nodes in the order for locality."""
    if "order" in scene:
        order, edges, springs = sorted_graph(scene)
    else:
        order, edges, springs = np.arange(len(scene["x"])), scene["edges"], np.arange(len(scene["k"]))
    model, dt = _model(scene, order, edges, springs), scene.number("dt")
    solver, states, start = newton.solvers.SolverSemiImplicit(model), [model.state(), model.state()], model.state()
    graphs: dict[int, Any] = {}
    last = [0]

    def steps(n: int) -> None:
        for t in range(n):
            states[t % 2].clear_forces()
            solver.step(states[t % 2], states[(t + 1) % 2], None, None, dt)

    def run(n_steps: int) -> None:
        if n_steps not in graphs:
            steps(2)
            with wp.ScopedCapture(device="cpu") as capture:
                steps(n_steps)
            graphs[n_steps] = capture.graph
        wp.copy(states[0].particle_q, start.particle_q)
        wp.copy(states[0].particle_qd, start.particle_qd)
        wp.capture_launch(graphs[n_steps])
        last[0] = n_steps % 2

    def result() -> np.ndarray:
        out = np.empty_like(scene["x"])
        out[order] = states[last[0]].particle_q.numpy()
        return out

    return Program(run, result)
