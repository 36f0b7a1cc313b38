"""`js.batch`: every scene as by itself, in any chunks, on any number of devices."""

import os
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
from jaxspring.batching import CACHE, _fitting

NET = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
ROOT = Path(__file__).resolve().parents[2]


def scene(points, k, dt):
    """Sixty damped steps of a small sheet."""
    system = js.System(NET, 1.0, (js.Springs(NET, k, 1.0), js.Drag(0.3)), free=np.arange(12) > 2)
    return js.rollout(system, js.State.from_points(NET, points), js.SymplecticEuler(), dt, 60)


def scenes(n=7):
    rng = np.random.default_rng(4)
    points = NET.grid() + 0.1 * rng.normal(size=(n, 12, 2))
    return jnp.asarray(points), jnp.asarray(rng.uniform(5, 20, (n, NET.n_springs))), jnp.asarray(rng.uniform(0.01, 0.03, n))


@pytest.mark.parametrize("chunk", [None, 1, 2, 3, 7, 100])
def test_every_scene_is_as_by_itself(chunk):
    """States, statuses and the gradient of a sum over scenes, whatever the chunk and what is left over by it."""
    points, k, dt = scenes()
    k = k.at[4, 2].set(jnp.nan)
    result = jax.jit(js.batch(scene, chunk=chunk))(points, k, dt)
    each = [jax.jit(scene)(points[i], k[i], dt[i]) for i in range(7)]
    np.testing.assert_array_equal(result.status.is_ok, [True] * 4 + [False] + [True] * 2)
    for i in (0, 1, 2, 3, 5, 6):
        np.testing.assert_allclose(result.state.points[i], each[i].state.points, rtol=0, atol=1e-13)
        assert int(result.status.flags[i]) == int(each[i].status.flags)
    assert int(result.status.step[4]) == int(each[4].status.step)

    def loss(k):
        return jnp.sum(js.batch(scene, (0, 0, None), chunk=chunk)(points, k, 0.02).state.points ** 2)

    good = k.at[4, 2].set(9.0)
    gradient = jax.jit(jax.grad(loss))(good)
    expected = jax.jit(jax.grad(lambda k: jnp.sum(scene(points[5], k, 0.02).state.points ** 2)))(good[5])
    np.testing.assert_allclose(gradient[5], expected, rtol=1e-9, atol=1e-12)


def test_any_argument_along_any_axis():
    """A batch of systems beside one state; the last axis; NumPy arrays; a tree of axes; what no array is goes along."""
    points, k, _ = scenes(4)
    law = js.EnergyLaw(lambda r, k, l: 0.5 * k * (r - l) ** 2)
    systems = [js.System(NET, 1.0, js.Springs(NET, row, 1.0, law=law)) for row in k]
    start = js.State.from_points(NET, points[0])

    def end(system, state, dt):
        return js.rollout(system, state, js.SymplecticEuler(), dt, 20).state.points

    expected = np.stack([end(system, start, 0.02) for system in systems])
    axes = eqx.tree_at(lambda s: s.forces[0].stiffness, jax.tree.map(lambda _: None, systems[0]), 0, is_leaf=lambda x: x is None)
    batch = eqx.tree_at(lambda s: s.forces[0].stiffness, systems[0], k)
    for chunk in (None, 2):
        np.testing.assert_allclose(js.batch(end, (axes, None, None), chunk=chunk)(batch, start, 0.02), expected, atol=1e-13)
        by_constants = js.batch(lambda k: end(js.replace(systems[0], stiffness=k), start, 0.02), -1, chunk=chunk)
        np.testing.assert_allclose(by_constants(np.asarray(k).T), expected, atol=1e-13)


def test_what_is_no_array_of_jax():
    """Whatever the library reads as an array is one along an axis; what is shared stays what it was; functions and words go along."""

    class Table:
        def __array__(self, dtype=None, copy=None):
            return np.arange(6.0)

    for given in (Table(), np.arange(6.0).astype(">f8")):
        np.testing.assert_array_equal(js.batch(lambda a, b: a * b)(np.ones(6), given), np.arange(6.0))

    def steps(k, n_steps, name):
        assert name == "sheet"
        return js.rollout(
            js.System(NET, 1.0, js.Springs(NET, k, 1.0)), js.State.from_points(NET, NET.grid()), js.SymplecticEuler(), 0.01, n_steps
        )

    for chunk in (None, 1):
        run = js.batch(steps, [0, None, 0], chunk=chunk)(np.array([1.0, 2.0]), np.int64(3), "sheet")
        np.testing.assert_allclose(run.state.time, 0.03)
    with pytest.raises(TypeError, match=r"in_axes holds 0\.5; expected whole numbers"):
        js.batch(lambda a: a, 0.5)(np.ones(3))
    with pytest.raises(TypeError, match=r"mesh is a int; expected a jax\.sharding\.Mesh"):
        js.batch(lambda a: a, mesh=2)
    with pytest.raises(ValueError, match="masked"):
        js.batch(lambda a: a)(np.ma.masked_array(np.ones(3), [0, 1, 0]))


def test_memory_is_that_of_a_chunk():
    """The temporaries of a gradient over 64 scenes in chunks of 4 are a fraction of those of all at once."""
    points, k, dt = (jnp.tile(a[:1], (64,) + (1,) * (a.ndim - 1)) for a in scenes())

    def temporaries(map_of):
        loss = jax.jit(jax.grad(lambda k: jnp.sum(map_of(scene)(points, k, dt).state.points ** 2)))
        return loss.lower(k).compile().memory_analysis().temp_size_in_bytes

    assert temporaries(lambda f: js.batch(f, chunk=4)) < 0.3 * temporaries(jax.vmap)


def test_the_chunk_that_is_chosen():
    """As many scenes as the cache holds, without a rest where that costs little; all of them where they are few or small."""
    big = [jnp.zeros((1024, CACHE // 32 // 4), jnp.float32)]
    assert _fitting(big, 1024) == 32
    assert _fitting([a[:1000] for a in big], 1000) == 25
    assert _fitting([a[:997] for a in big], 997) == 32
    assert _fitting([jnp.zeros((50, 3))], 50) == 50
    assert _fitting([jnp.zeros((3, CACHE))], 3) == 1


@pytest.mark.parametrize(
    ("options", "arguments", "words"),
    [
        ({"chunk": 0}, (), "chunk = 0; expected 1 scene or more"),
        ({}, (np.ones(3), np.ones(4)), r"axes of different lengths: \[3, 4\]"),
        ({"in_axes": None}, (np.ones(3),), "no argument has an axis of scenes"),
        ({"in_axes": (0,)}, (np.ones(3), 1.0), r"in_axes = \(0,\) has 1 entries for 2 arguments"),
        ({}, (np.ones(3), np.float64(2)), r"an array of shape \(\) has no axis 0 of scenes. Let in_axes be None"),
    ],
)
def test_mistakes_are_named(options, arguments, words):
    with pytest.raises(ValueError, match=words):
        js.batch(lambda *a: a[0], **options)(*arguments)


DEVICES = """
    import re, sys
    import jax, jax.numpy as jnp, numpy as np
    from jax.sharding import Mesh, NamedSharding, PartitionSpec
    sys.path.insert(0, {root!r})
    import jaxspring as js
    from tests.unit.test_batch import scene, scenes

    assert jax.device_count() == 2
    inputs = tuple(jnp.concatenate([a, a[:1]]) for a in scenes())
    mesh = Mesh(np.array(jax.devices()), ("scenes",))
    one = jax.jit(js.batch(scene, chunk=2))
    two = jax.jit(js.batch(scene, chunk=2, mesh=mesh))
    for a, b in zip(jax.tree.leaves(one(*inputs)), jax.tree.leaves(two(*inputs)), strict=True):
        np.testing.assert_array_equal(a, b)
    made = jax.make_mesh((2,), ("scenes",))
    np.testing.assert_array_equal(jax.jit(js.batch(scene, mesh=made))(*inputs).state.points, jax.jit(js.batch(scene))(*inputs).state.points)
    np.testing.assert_array_equal(js.batch(scene, mesh=made)(*inputs).status.is_ok, [True] * 8)
    elsewhere = tuple(jax.device_put(a, jax.devices()[1]) for a in inputs)
    np.testing.assert_array_equal(js.batch(scene, chunk=2, mesh=made)(*elsewhere).state.points, one(*inputs).state.points)
    found = two(*inputs).state.points
    assert len(found.sharding.device_set) == 2
    js.save(sys.argv[1], two(*inputs))
    for like in (one(*inputs), two(*inputs)):
        read = js.load(sys.argv[1], like=like)
        assert read.state.position.x.sharding.device_set == like.state.position.x.sharding.device_set
        jax.tree.map(np.testing.assert_array_equal, read, like)

    def loss(map_of, k):
        return jnp.mean(map_of(inputs[0], k, inputs[2]).state.points ** 2)

    by_one = jax.jit(jax.grad(lambda k: loss(js.batch(scene, chunk=2), k)))
    by_two = jax.jit(jax.grad(lambda k: loss(js.batch(scene, chunk=2, mesh=mesh), k)))
    np.testing.assert_allclose(by_one(inputs[1]), by_two(inputs[1]), rtol=1e-12)
    sharding = NamedSharding(mesh, PartitionSpec("scenes"))
    shared = tuple(jax.device_put(a, sharding) for a in inputs)
    plain = jax.jit(jax.vmap(scene))
    np.testing.assert_allclose(plain(*shared).state.points, one(*inputs).state.points, atol=1e-12)
    moves = "all-gather|all-to-all|collective-permute|reduce-scatter"
    for program in (two.lower(*inputs), by_two.lower(inputs[1]), two.lower(*shared), plain.lower(*shared)):
        assert not re.search(moves, program.compile().as_text())
    try:
        js.batch(scene, mesh=mesh)(*(a[:7] for a in inputs))
    except ValueError as error:
        assert "7 scenes cannot be shared by 2 devices; expected a multiple of 2" in str(error)
    else:
        raise SystemExit("7 scenes were shared by 2 devices")
    print("done")
"""


def test_two_devices_give_the_bits_of_one(tmp_path):
    """Each scene's state and status are bitwise those of one device; no array of states travels, in a value or a gradient; a batch that a
    user has sharded stays where it is under `jax.vmap` in the user's own `jit`; a file of it is read on one device or two.
    """
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_ENABLE_X64": "1"}
    program = textwrap.dedent(DEVICES.format(root=str(ROOT)))
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "two.npz")], capture_output=True, text=True, env=environment, check=False, cwd=ROOT
    )
    assert done.stdout == "done\n", done.stderr[-3000:]


CACHED = """
    import sys
    import jax
    jax.config.update("jax_compilation_cache_dir", sys.argv[1])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    import numpy as np
    import jaxspring as js
    net = js.Graph.from_edges([(0, 1), (1, 2), (2, 3), (0, 2)], 4)
    points = np.random.default_rng(0).normal(size=(4, 2))
    def loss(k):
        system = js.System(net, 1.0, js.Springs(net, k, 1.0, law=js.EnergyLaw(lambda r, k, l: 0.5 * k * (r - l) ** 2)))
        return (js.rollout(system, js.State.from_points(net, points), js.BackwardEuler(), 0.01, 10).state.points ** 2).sum()
    print(float(jax.jit(jax.grad(loss))(np.full(4, 3.0))[0]))
"""


def test_compiled_programs_are_found_again(tmp_path):
    """With JAX's cache on the disk a second process compiles nothing: no program of the library differs from one process to the next."""
    outputs, counts = [], []
    for _ in range(2):
        command = [sys.executable, "-c", textwrap.dedent(CACHED), str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
        outputs.append(done.stdout)
        counts.append(len(list(tmp_path.glob("*-cache"))))
    assert counts[0] == counts[1] > 0
    assert outputs[0] == outputs[1]
