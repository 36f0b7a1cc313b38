"""Hard cases H: batches, compiles, other processes and cores. (Those of the toolchain alone are apart.)"""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.laws import Hooke, PowerLaw, TensionOnly
from jaxspring.status import Flag
from tests.reference import Traces, relative_error, spring_forces

NET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)


def lane(points, k, dt, free):
    """200 damped steps of a small sheet, everything given as arrays."""
    system = js.System(NET, 1.0, (js.Springs(NET, k, 1.0), js.Drag(0.3)), free=free)
    result = js.rollout(system, js.State.from_points(NET, points), js.VelocityVerlet(), dt, 200)
    return result.state.points, result.status


def five_lanes(rng):
    points = np.c_[NET.grid(), np.zeros(20)] + 0.05 * rng.normal(size=(5, 20, 3))
    free = rng.random((5, 20)) > 0.2
    return [jnp.asarray(a) for a in (points, rng.uniform(20, 60, (5, NET.n_springs)), rng.uniform(5e-3, 2e-2, 5), free)]


def test_h1_vmap_is_a_loop(rng):
    """A vmap over positions, stiffness, dt and mask agrees with a loop to 1e-13; reversed lanes and a lane of NaN change no other bit."""
    inputs = five_lanes(rng)
    batch = jax.jit(jax.vmap(lane))
    points, status = batch(*inputs)
    assert np.all(status.flags == 0)
    one = jax.jit(lane)
    loop = np.stack([one(*(a[i] for a in inputs))[0] for i in range(5)])
    assert relative_error(points, loop) <= 1e-13
    backward, _ = batch(*(a[::-1] for a in inputs))
    np.testing.assert_array_equal(backward[::-1], points)
    ill = [inputs[0].at[2, 7, 1].set(np.nan), *inputs[1:]]
    poisoned, status = batch(*ill)
    well = np.array([0, 1, 3, 4])
    np.testing.assert_array_equal(poisoned[well], points[well])
    assert [bool(f) for f in status.has(Flag.NONFINITE)] == [False, False, True, False, False]
    assert (int(status.step[2]), int(status.node[2])) == (0, 7)
    with pytest.raises(js.SimulationError, match="lane 2"):
        js.raise_for_status(status)


class Witness(js.Force):
    """No force, but it tells when it is traced."""

    tell: Traces = eqx.field(static=True)

    def force(self, state):
        self.tell()
        return js.Vector.zeros_like(state.position)


def test_h3_one_compile_for_every_kind_of_dt(user_mode):
    """A dt as a float, a NumPy float of either width, an int or a 0-d array, and new parameters and states, share one compile."""
    traces = Traces()

    def go(dt, k=10.0, shift=0.0):
        system = js.System(NET, 1.0, (js.Springs(NET, k, 1.0), Witness(traces)))
        state = js.State.from_points(NET, NET.grid().astype(np.float32) + shift)
        return js.rollout(system, state, js.SymplecticEuler(), dt, 7).state

    state = go(1e-3)
    traces.count = 0
    for dt in (2e-3, 3e-3, np.float64(1e-3), np.float32(1e-3), 0, np.array(1e-3), jnp.asarray(1e-3)):
        state = go(dt)
    go(1e-3, k=20.0, shift=1.0)
    assert traces.count == 0
    assert state.dtype == jnp.float32


PROGRAM = """
    import hashlib, sys
    import jax, numpy as np
    jax.config.update("jax_enable_x64", True)
    import jaxspring as js
    sheet = js.lattice((12, 12), js.STRUCTURAL + js.SHEAR)
    digest = hashlib.sha256()
    for net in (sheet, js.Graph.from_edges(sheet.edges, 144)):
        points = sheet.grid() + 0.1 * np.sin(np.arange(288.0)).reshape(144, 2)
        def end(k):
            system = js.System(net, 1.0, (js.Springs(net, k, 1.0), js.Drag(0.1)))
            return js.rollout(system, js.State.from_points(net, points), js.SymplecticEuler(), 1e-2, 50).state.points
        k = np.linspace(50.0, 80.0, net.n_springs)
        digest.update(np.asarray(jax.jit(end)(k)).tobytes())
        digest.update(np.asarray(jax.jit(jax.grad(lambda k: (end(k) ** 2).sum()))(k)).tobytes())
    print(len(jax.devices()), digest.hexdigest())
"""


def digest_in_a_new_process(prefix=(), **variables):
    root = Path(js.__file__).parent.parent
    environment = {**os.environ, "PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1", **variables}
    command = [*prefix, sys.executable, "-c", textwrap.dedent(PROGRAM)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300)
    n_devices, digest = done.stdout.split()
    return int(n_devices), digest


@pytest.mark.slow
def test_h5_bitwise_the_same_in_every_process():
    """States and gradients have the same bytes in two processes, on one core, and with four host devices."""
    first = digest_in_a_new_process()
    assert digest_in_a_new_process() == first
    four = digest_in_a_new_process(XLA_FLAGS=os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4")
    assert four == (4, first[1])
    if shutil.which("taskset"):
        core = str(min(os.sched_getaffinity(0)))
        assert digest_in_a_new_process(("taskset", "-c", core)) == first


def laws_in_numpy(law, r, k, l):
    """Pull of each law, positive in tension, and its energy."""
    e = r - l
    if isinstance(law, PowerLaw):
        s = e / l
        return k * l * np.sign(s) * np.abs(s) ** 3, k * l**2 * np.abs(s) ** 4 / 4
    if isinstance(law, TensionOnly):
        e = np.maximum(e, 0)
    return k * e, 0.5 * k * e**2


@pytest.mark.parametrize("kind", ["lattice", "graph"])
@pytest.mark.parametrize("n_springs", [16_384, 16_385])
def test_h10_every_kernel_past_a_power_of_two(rng, n_springs, kind):
    """With 16,384 and 16,385 springs, every operator and every law is what NumPy gives, at every spring and node."""
    n = n_springs + 1
    net = js.lattice(n)
    if kind != "lattice":
        net = js.Graph.from_edges(net.edges, n)
    points = np.c_[np.arange(float(n)), np.zeros((n, 2))] + 0.2 * rng.normal(size=(n, 3))
    k, l = rng.uniform(1, 2, n_springs), rng.uniform(0.5, 1.5, n_springs)
    state = js.State.from_points(net, points)
    a = rng.normal(size=n)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)

    @jax.jit
    def operators(state, a, k):
        node = net.node_field(a)
        return {
            "lengths": net.lengths(state.position),
            "average": net.flatten(net.average(node)),
            "incident": net.flatten_nodes(net.incident_sum(net.edge_field(k))),
            "round trip": net.flatten(net.edge_field(k)),
        }

    expected = {
        "lengths": length,
        "average": 0.5 * (a[1:] + a[:-1]),
        "incident": np.append(k, 0) + np.append(0, k),
        "round trip": k,
    }
    for name, got in operators(state, a, k).items():
        np.testing.assert_allclose(got, expected[name], rtol=1e-13, atol=1e-13, err_msg=name)
    for law in (Hooke(), TensionOnly(), PowerLaw(3.0)):
        springs = js.Springs(net, k, l, law=law)
        pull, energy = laws_in_numpy(law, length, k, l)

        @jax.jit
        def forces(state, springs=springs):
            return jnp.stack([net.flatten_nodes(f) for f in springs.force(state)], axis=-1), springs.energy(state)

        got, total = forces(state)
        along = pull[:, None] * np.diff(points, axis=0) / length[:, None]
        zero = np.zeros((1, 3))
        np.testing.assert_allclose(got, np.concatenate([along, zero]) - np.concatenate([zero, along]), atol=1e-12)
        assert total == pytest.approx(energy.sum(), rel=1e-12)
    np.testing.assert_allclose(spring_forces(points, js.lattice(n).edges, k, l).sum(axis=0), 0, atol=1e-9)
