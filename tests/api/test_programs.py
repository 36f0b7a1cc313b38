"""What the compiled programs hold: no scatter, and only the operations that the scene names. Read from their StableHLO."""

import re
import subprocess
import sys
from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxspring as js
from jaxspring.images import Image
from tests import source

SHEET = js.lattice((5, 6), js.STRUCTURAL + js.SHEAR + js.BEND)
GRAPH = js.Graph.from_edges(SHEET.edges[::-1], 30)

# Operations that move or repeat nothing at run time: the compiler folds them into the loops that read them.
FOLDED = {"constant", "broadcast_in_dim", "convert", "reshape", "negate"}


def operations(program):
    """How often each StableHLO operation is executed, calls of inner functions followed (a loop's body counts once)."""
    text = program.as_text()
    bodies = {m[1]: m[2] for m in re.finditer(r"func\.func [a-z]+ @(\S+?)\((.*?)\n  }", text, re.DOTALL)}

    def count(name):
        total = Counter(re.findall(r"(?<!#)stablehlo\.([a-z_]+)", bodies[name]))
        total.pop("return", None)  # of a loop's body
        for inner in re.findall(r"\bcall @([\w.]+)\(", bodies[name]):
            total += count(inner)
        return total

    return count("main")


def seen(program):
    """As `operations`, without those that the compiler folds."""
    return Counter({name: n for name, n in operations(program).items() if name not in FOLDED})


def loss_of(net):
    """Loss of a rollout as a function of flat k and l in the user's order."""
    points = np.c_[1.1 * SHEET.grid(), np.zeros(30)]

    def loss(k, l):
        system = js.System(net, 1.0, (js.Springs(net, k, l), js.Drag(0.1)))
        end = js.rollout(system, js.State.from_points(net, points), js.SymplecticEuler(), 1e-2, 20, save_every=5).state
        return jnp.sum(end.points**2)

    return loss


@pytest.mark.parametrize("net", [SHEET, GRAPH], ids=["lattice", "graph"])
def test_no_scatter(net):
    """Forward, gradient, batched gradient and Hessian-vector product hold no scatter, with k and l flat in the user's order."""
    loss = loss_of(net)
    k, l = (np.full(net.n_springs, c) for c in (20.0, 1.0))
    gradient = jax.grad(loss, argnums=(0, 1))
    programs = {
        "forward": jax.jit(loss).lower(k, l),
        "gradient": jax.jit(gradient).lower(k, l),
        "batch": jax.jit(jax.vmap(gradient)).lower(np.stack([k, k]), np.stack([l, l])),
        "curvature": jax.jit(lambda k, l: jax.jvp(lambda k: gradient(k, l), (k,), (k,))).lower(k, l),
    }
    for name, program in programs.items():
        assert "scatter" not in program.as_text(), name


def test_a_scatter_would_show():
    """The test above can fail: the transpose of a bare gather is a scatter."""
    assert "scatter" in jax.jit(jax.grad(lambda a: jnp.sum(a[np.array([0, 2])] ** 2))).lower(np.ones(3)).as_text()


# A chain in the plane: one family, so that the step fits on a page. The library keeps springs on an extended range.
CHAIN, N = js.lattice(8), 8


def minimal_force(x, y, k, l):
    """Hooke's law on a chain by hand, for components and springs -1 ... n - 1 of which the first and last do not exist: their k is 0."""

    def difference(a):
        padded = lax.pad(a, np.zeros((), a.dtype), [(1, 1, 0)])
        return padded[1:] - padded[:-1]

    def on_nodes(p):
        return p[1:] - p[:-1]

    dx, dy = difference(x), difference(y)
    weight = k * (1 - l * lax.rsqrt(jnp.maximum(dx * dx + dy * dy, jnp.finfo(x.dtype).tiny)))
    return on_nodes(weight * dx), on_nodes(weight * dy)


def minimal_step(x, y, vx, vy, k, l, m, dt):
    """The slides' update by hand."""
    fx, fy = minimal_force(x, y, k, l)
    w = 1 / m
    vx, vy = vx + dt * (w * fx), vy + dt * (w * fy)
    return x + dt * vx, y + dt * vy, vx, vy


def library_step(*effects, dim=2):
    """A step of the library, prepared as `rollout` does once before its loop."""
    springs = js.Springs(CHAIN, np.full(N - 1, 10.0), np.ones(N - 1))
    system = js.System(CHAIN, 1.0, (springs, *effects))
    state = js.State.from_points(CHAIN, np.eye(N, dim))

    def step(system, state, dt):
        return js.SymplecticEuler().step(system, state, dt, None)[0]

    return jax.jit(step).lower(system.bind(state.dtype), state, jnp.asarray(1e-2))


def minimal(*shapes):
    return [jnp.zeros(shape) for shape in shapes]


def test_a_step_of_springs_holds_a_minimal_step():
    """A springs-only step has exactly the operations of the step written by hand."""
    by_hand = jax.jit(minimal_step).lower(*minimal(N, N, N, N, N + 1, N + 1, (), ()))
    assert seen(library_step()) == seen(by_hand)
    # And these are: differences, lengths, the law, sums on the nodes, the update.
    assert {"subtract", "multiply", "add", "maximum", "rsqrt", "divide"} <= set(seen(by_hand))
    assert seen(by_hand)["rsqrt"] == 1
    assert seen(by_hand)["divide"] == 1  # by the mass, once


def minimal_rollout(x, y, vx, vy, k, l, m, dt):
    """The hand-written steps in two nested loops, with the time."""

    def step(carry, _):
        state, i = carry
        i = i + 1
        return ((*minimal_step(*state[:4], k, l, m, dt), i.astype(dt.dtype) * dt), i), None

    def block(carry, _):
        return lax.scan(step, carry, None, length=10)[0], None

    return lax.scan(block, ((x, y, vx, vy, jnp.zeros_like(dt)), jnp.zeros((), jnp.int32)), None, length=10)[0]


# What looking for trouble takes: is it finite, where, what each effect reports, whether the constants are ones a constructor would take,
# and the replay of a failed run.
OF_STATUSES = {"is_finite", "not", "or", "and", "reduce", "select", "compare", "maximum", "minimum", "abs", "concatenate", "sqrt", "iota"}
OF_STATUSES |= {"case", "while", "add", "subtract", "multiply", "divide", "rsqrt", "pad", "slice", "reduce_precision"}


def lowered_rollout(what):
    springs = js.Springs(CHAIN, np.full(N - 1, 10.0), np.ones(N - 1))
    system = js.System(CHAIN, 1.0, springs)
    state = js.State.from_points(CHAIN, np.c_[np.arange(float(N)), np.zeros(N)])

    def run(system, state, dt):
        return what(js.rollout(system, state, js.SymplecticEuler(), dt, 100))

    return jax.jit(run).lower(system, state, jnp.asarray(1e-2))


def test_a_rollout_adds_the_statuses_alone():
    """A rollout whose status nobody asks for is the hand-written loop; with it, only what finding trouble takes is added."""
    bare = seen(jax.jit(minimal_rollout).lower(*minimal(N, N, N, N, N + 1, N + 1, (), ())))
    stateless = seen(lowered_rollout(lambda result: result.state))
    # Outside the loop k and l are cut into families and brought to the extended range, where k is zero; in it, the start time is added
    # to i dt.
    more = stateless - bare
    assert not bare - stateless
    assert more == Counter(slice=2, pad=2, add=1, select=1)
    full = seen(lowered_rollout(lambda result: (result.state, result.status)))
    assert set(full - stateless) <= OF_STATUSES


def force_alone(effect, dim):
    state = js.State.from_points(CHAIN, np.zeros((N, dim)))
    ready = js.System(CHAIN, 1.0, effect).bind(state.dtype)
    return jax.jit(lambda system, state: system.forces[0].force(state)).lower(ready, state)


@pytest.mark.parametrize(
    ("effect", "theirs"),
    [
        (js.Drag(0.1), {"multiply": 2}),
        (js.Gravity((0.0, -9.81)), {"slice": 2, "multiply": 2}),
    ],
    ids=["drag", "gravity"],
)
def test_an_effect_adds_its_own_operations(effect, theirs):
    """Drag and gravity add their own product per coordinate and one sum per coordinate, and nothing else."""
    plain, with_effect = seen(library_step()), seen(library_step(effect))
    assert seen(force_alone(effect, 2)) == Counter(theirs)
    assert with_effect - plain == Counter(theirs) + Counter(add=2)
    assert not plain - with_effect


def test_an_image_adds_its_own_operations():
    """Data springs add the reading of the image at the nodes, one product and one difference, and one sum per coordinate."""
    data = js.DataSprings(Image(np.eye(8)), 1.0)
    plain, with_image = seen(library_step(dim=3)), seen(library_step(data, dim=3))
    alone = seen(force_alone(data, 3))
    assert alone["gather"] == 4  # the corners of a cell
    assert "scatter" not in alone
    assert with_image == plain + alone + Counter(add=3)


def test_penalty_contact_adds_its_own_operations():
    """A push out of a plane and out of a ball adds its own operations and a sum per coordinate: no branch, no gather, no velocity where
    there is no friction.
    """
    plain = seen(library_step())
    for obstacle in (js.contact.Plane((0.0, 0.0), (0.0, 1.0)), js.contact.Sphere((0.0, 0.0), 1.0)):
        push = js.contact.Penalty(obstacle, 10.0)
        with_push, alone = seen(library_step(push)), seen(force_alone(push, 2))
        assert with_push == plain + alone + Counter(add=2)
        assert not {"case", "while", "gather", "scatter", "sort"} & set(alone)
        assert alone["sqrt"] == isinstance(obstacle, js.contact.Sphere)
        assert sum(alone.values()) < 60


def test_no_contact_no_import():
    """A scene without contact loads none of its forces, and none of the fields of images and meshes."""
    code = (
        "import sys, numpy as np, jaxspring as js\n"
        "net = js.lattice(3)\n"
        "system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), rules=js.Heat(net, 1.0, 1.0))\n"
        "system.bind(np.float32)\n"
        "print([name for name in sys.modules if name.startswith('jaxspring.contact.')])"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=source.ROOT, capture_output=True, text=True, timeout=300)
    loaded = run.stdout
    assert run.returncode == 0, run.stderr
    for name in ("penalty", "pairs", "law", "joined", "height_field", "mesh_field", "moving"):
        assert f"contact.{name}'" not in loaded


def test_no_heat_no_cost():
    """A state holds time, position and velocity, and nothing that the scene does not name."""
    state = js.State.from_points(CHAIN, np.zeros((N, 2)))
    assert len(jax.tree.leaves(eqx.filter(state, eqx.is_array))) == 5


def warm_rollout(stiffness, temperature, *rules):
    """Operations of a rollout's state alone, by these rules of temperature."""
    system = js.System(CHAIN, 1.0, js.Springs(CHAIN, stiffness, np.ones(N - 1)), rules=rules)
    state = js.State.from_points(CHAIN, np.zeros((N, 2)), temperature=temperature)
    run = jax.jit(lambda system, state, dt: js.rollout(system, state, js.SymplecticEuler(), dt, 100).state)
    return seen(run.lower(system, state, jnp.asarray(1e-2)))


def test_each_rule_of_temperature_adds_its_own_operations():
    """A temperature that no effect reads is computed with nowhere; softening adds a mean and a ramp, and only the smooth one exponentials;
    fusing adds a mean, one comparison and one bit, and only refreezing measures lengths again. None adds a branch, a loop or a scatter.
    """
    k = np.full(N - 1, 10.0)
    cold = warm_rollout(k, None)
    assert warm_rollout(k, 300.0) == cold
    soft = warm_rollout(js.thermal.ThermalStiffness(10.0, 300.0, 350.0), 300.0)
    smooth = warm_rollout(js.thermal.ThermalStiffness(10.0, 300.0, 350.0, 20.0), 300.0)
    fused = warm_rollout(k, 300.0, js.Fusing(CHAIN, 350.0))
    again = warm_rollout(k, 300.0, js.Fusing(CHAIN, 350.0, js.thermal.Refreezing(10.0, 2.0)))
    # The mean is a slice, an addition and a multiplication, and the ramp a difference, a division and two bounds. The full stiffness is
    # brought to the extended range of springs, where it is zero, as every stiffness is.
    ramp = Counter(subtract=2, divide=1, maximum=1, minimum=1)
    assert soft - cold == ramp + Counter(slice=1, add=1, multiply=2, select=4)
    assert (smooth - soft)["exponential"] == 2
    # Nothing of a broken spring is read: two coordinates of its length, its stiffness and its rest length, and two of its pull; nor are
    # temperatures beyond the ends. Seven selections, and a bit that is padded and cut.
    assert fused - cold == Counter(compare=1, slice=2, add=1, multiply=1, pad=1, select=7) + Counter({"and": 1})
    assert again["sqrt"] == 1
    assert cold["rsqrt"] == soft["rsqrt"] == fused["rsqrt"] == 1
    for program in (soft, smooth, fused, again):
        assert not {"case", "scatter", "gather", "sort"} & set(program)
        assert program["while"] == cold["while"]
