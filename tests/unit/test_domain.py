"""`js.domain`: one lattice over two devices is that of one device, and only rows at the border travel in a step."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxspring as js

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
    import math, re, sys
    import jax, jax.numpy as jnp, numpy as np
    import jaxspring as js

    n, steps = 24, 100
    net = js.lattice((n, n), js.STRUCTURAL + js.SHEAR + js.BEND)
    rng = np.random.default_rng(0)
    points = np.pad(net.grid(), ((0, 0), (0, 1))) + 0.05 * rng.normal(size=(n * n, 3))
    one = js.State.from_points(net, points, rng.normal(size=(n * n, 3)))
    two = js.domain(one, jax.make_mesh((2,), ("rows",)))
    k = rng.uniform(1, 2, net.n_springs)

    def end(k, state):
        forces = js.Springs(net, k, 1.0), js.Dashpots(net, 0.1), js.Gravity([0.0, 0.0, -9.81])
        system = js.System(net, 1.0, forces, free=np.arange(n * n) >= n)
        return js.rollout(system, state, js.SymplecticEuler(), 0.02, steps)

    def loss(k, state):
        return sum(jnp.sum(a * a) for a in end(k, state).state.position)

    by_one, by_two = (jax.jit(end)(k, state) for state in (one, two))
    assert len(by_two.state.position.x.sharding.device_set) == 2
    np.testing.assert_allclose(by_two.state.points, by_one.state.points, atol=1e-11)
    np.testing.assert_allclose(js.rollout(js.System(net, 1.0, js.Springs(net, k, 1.0)), two, js.SymplecticEuler(), 0.02, 5).state.points,
        js.rollout(js.System(net, 1.0, js.Springs(net, k, 1.0)), one, js.SymplecticEuler(), 0.02, 5).state.points, atol=1e-12)
    assert bool(by_two.status.is_ok)
    np.testing.assert_allclose(*(jax.jit(jax.grad(loss))(k, state) for state in (two, one)), rtol=1e-9, atol=1e-12)

    text = jax.jit(end).lower(k, two).compile().as_text()
    moved = [(kind, math.prod(int(a) for a in shape.split(",") if a)) for shape, kind in
        re.findall(r" = f64\\[([\\d,]*)\\]\\S* (collective-permute|all-gather|all-to-all)\\(", text)]
    assert {kind for kind, _ in moved} >= {"collective-permute"}
    assert max(size for _, size in moved) <= n * n - n  # a spring family's lengths, which the check of rounding gathers once
    loops = re.findall(r"body=(%[\\w.]+)", text)
    halo = {}
    for body in loops:
        inside = text[text.index(f"{body} ("):]
        inside = inside[: inside.index("\\n}")]
        rows = re.findall(r" = f64\\[([\\d,]*)\\]\\S* collective-permute\\(", inside)
        if "1," + str(n) in rows:
            assert "f64" not in re.findall(r" = (\\w+)\\[\\S* all-gather\\(", inside)
            halo[body] = sum(8 * math.prod(int(a) for a in row.split(",")) for row in rows)
    assert halo and max(halo.values()) <= 90 * n * 8, halo  # bytes that a device sends in a step: rows

    # One whole array is saved, whoever holds it, and read on the devices of `like`.
    one_file, two_file = sys.argv[1] + "/one.npz", sys.argv[1] + "/two.npz"
    js.save(one_file, one)
    js.save(two_file, two)
    assert open(one_file, "rb").read() == open(two_file, "rb").read()
    ended = by_two.state, by_two.resume
    js.save(two_file, ended)
    for like, n_devices in ((ended, 2), ((by_one.state, by_one.resume), 1)):
        read = js.load(two_file, like=like)
        assert len(read[0].position.x.sharding.device_set) == n_devices
        jax.tree.map(np.testing.assert_array_equal, read, ended)
    print("done")
"""


def test_two_devices_compute_what_one_does(tmp_path):
    """State and gradient to rounding after 100 steps with held nodes, dashpots and weight; in a step rows alone cross the border. A file
    of the shared state is that of the whole, and is read on one device or two, bit for bit.
    """
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_ENABLE_X64": "1"}
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, cwd=ROOT)
    assert done.stdout == "done\n", done.stderr[-3000:]


def test_what_cannot_be_shared_is_refused():
    """A graph, a batch of states, rows that do not divide: a sentence each."""
    mesh = jax.make_mesh((1,), ("rows",))
    graph = js.Graph.from_edges([(0, 1)], 2)
    with pytest.raises(ValueError, match="the state is of a graph: its springs may join any two nodes"):
        js.domain(js.State.from_points(graph, np.ones((2, 2))), mesh)
    net = js.lattice((3, 3))
    state = js.State.from_points(net, net.grid())
    with pytest.raises(ValueError, match=r"arrays have shape \(2, 3, 3\); expected one state"):
        js.domain(jax.tree.map(lambda a: np.stack([a, a]), state), mesh)
