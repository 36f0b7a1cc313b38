"""Objects print as a few lines that a person can read."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

NET = js.lattice((3, 4))
SPRINGS = js.Springs(NET, np.linspace(40.0, 60.0, NET.n_springs), 1.0)
FREE = np.ones(12, bool)
FREE[[0, 3]] = False
SYSTEM = js.System(NET, 0.5, (SPRINGS, js.Gravity((0.0, -9.81))), FREE, rules=js.Floor((0.0, 0.0), (0.0, 1.0), friction=0.3))
START = js.State.from_points(NET, NET.grid(0.1), np.full((12, 2), [3.0, 4.0]), temperature=300.0)


def test_a_system_names_what_is_in_it():
    """Net, masses, held nodes, and every effect with the range of its constants."""
    assert str(SYSTEM).splitlines() == [
        "System on a Lattice of 3 x 4 nodes, 17 springs",
        "  mass 0.5 kg",
        "  free 10 of 12",
        "  Springs: 17 springs, stiffness 40 to 60, rest_length 1, law Hooke",
        "  Gravity: acceleration (0, -9.81)",
        "  after each step, Floor: point (0, 0), normal (0, 1), friction 0.3, restitution 0",
    ]


def test_a_state_shows_ranges():
    """Sizes, precision, time, and ranges with units; of a batch, how many."""
    lines = ["x 0 to 0.3 m", "y 0 to 0.2 m", "speed 5 m/s", "temperature 300 K"]
    assert str(START).splitlines() == ["State of 12 nodes in 2 coordinates, float64, at 0 s", *(f"  {line}" for line in lines)]
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), START)
    assert str(batch).splitlines()[0].endswith(", a batch of 2")


def test_results_say_how_they_ended():
    """Statuses stand in words, with the place of what went wrong."""
    run = js.rollout(SYSTEM, START, js.SymplecticEuler(), 1e-3, 4)
    assert str(run).splitlines()[:2] == ["Result after 4 steps: OK", "  State of 12 nodes in 2 coordinates, float64, at 0.004 s"]
    assert str(run.status) == "OK"
    fit = js.fit(lambda p: jnp.sum(p["k"] ** 2), {"k": jnp.ones(3)}, js.Adam(0.1), 1)
    assert str(fit).splitlines() == [
        f"Fit: loss {fit.value:.6g} at iteration 1, ITERATIONS; OK",
        f"  ['k'] {float(fit.parameters['k'][0]):.6g}",
    ]


def test_a_traced_value_shows_its_shape():
    """Inside `jit` nothing is read."""
    seen = []

    @jax.jit
    def inside(k, state):
        seen.extend((str(js.Springs(NET, k, 1.0)), str(state)))
        return k

    inside(jnp.ones(17), START)
    assert "stiffness float64[17], traced" in seen[0]
    assert "x float64[3, 4], traced m" in seen[1]


def test_a_state_of_which_a_part_is_traced():
    """Velocities alone may be what is differentiated: the speed is not read then."""
    seen = []

    def inside(v):
        state = js.State.from_points(NET, NET.grid(0.1), v * jnp.ones((12, 2)))
        seen.append(str(state))
        return jnp.sum(state.velocity.x)

    jax.grad(inside)(1.0)
    assert "x 0 to 0.3 m" in seen[0]
    assert "speed traced" in seen[0]


def test_what_is_not_finite_is_counted():
    """A range would hide it."""
    broken = js.State(START.time, js.Vector((START.position.x.at[0, 0].set(jnp.nan), START.position.y)), START.velocity, START.layout)
    assert "  x 1 of 12 not finite m" in str(broken).splitlines()
