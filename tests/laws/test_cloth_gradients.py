"""Derivatives through a second of cloth by implicit steps, and stretch and bending from the track of a strip that swings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET, FLAT = js.cloth.rectangle(0.07, 0.02, 0.01)
HELD = FLAT[:, 0] < FLAT[:, 0].min() + 0.012
TRUE = {"bending": 4e-5, "stretch": 25.0, "density": 0.187}


def strip(numbers, wind=0.0):
    """A strip of these numbers, clamped level at one end, in air and under its weight."""
    fabric = js.cloth.Fabric(numbers["density"], numbers["stretch"], numbers["stretch"] / 3, numbers["bending"])
    cloth = js.cloth.fabric(NET, FLAT, fabric)
    air = js.cloth.Air(NET, drag=1.2, friction=0.02, wind=lambda places, time: breeze(wind, places, time))
    return js.System(NET, cloth.mass, (*cloth.forces, air, js.Gravity((0.0, 0.0, -9.81))), free=~HELD)


def breeze(wind, places, time):
    """Wind across the strip, that swells and grows outward."""
    along = wind * (1 + 0.3 * jnp.sin(9 * time)) * (1 + 5 * places.x)
    return js.Vector((0.2 * along, 0.5 * along, along))


@pytest.mark.slow
def test_a_hundred_implicit_steps(sooner):
    """By B, stretch, density, wind and the places of the pins, each against central differences to 1e-5."""
    rng = np.random.default_rng(5)
    weight = rng.normal(size=FLAT.shape)
    bumps = 2e-4 * rng.normal(size=FLAT.shape)  # springs at rest length are where their clamped blocks have a kink: none is
    pins = rng.normal(size=FLAT.shape) * HELD[:, None]

    def loss(numbers):
        start = js.State.from_points(NET, FLAT + bumps + numbers["pins"])
        stepper = js.BackwardEuler(js.CG(tolerance=1e-13))
        run = js.rollout(strip(numbers, numbers["wind"]), start, stepper, 4e-3, 100)
        return jnp.sum(run.state.points * weight), run.status

    given = {**TRUE, "wind": 2.0, "pins": np.zeros_like(FLAT)}
    value = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, status), slopes = value(given)
    js.raise_for_status(status)
    for name, slope in slopes.items():
        way, h = (pins, 1e-7) if name == "pins" else (1.0, 1e-5 * given[name])
        up, down = (value({**given, name: given[name] + s * h * way})[0][0] for s in (1, -1))
        assert float(jnp.sum(slope * way)) == pytest.approx(float((up - down) / (2 * h)), rel=1e-5)


@pytest.mark.slow
def test_bending_and_stretch_from_a_marker_track(sooner):
    """A strip let go swings down; from the track of its markers, filmed a hundred times a second with 50 micrometres of noise, `fit` finds
    B within 2 % and the stretch stiffness within 5 %, from twice and half as much. The film is of Verlet's steps, the fit of implicit ones.
    """
    start = js.State.from_points(NET, FLAT)

    def track(numbers, stepper, dt):
        every = round(0.01 / dt)
        return js.rollout(strip(numbers), start, stepper, dt, 12 * every, save_every=every, observe=lambda state: state.points).saved

    film = jax.jit(lambda: track(TRUE, js.VelocityVerlet(), 2e-4))()
    film = film + 5e-5 * np.random.default_rng(3).normal(size=film.shape)

    def residuals(parameters):
        return (track({**parameters, "density": TRUE["density"]}, js.ImplicitMidpoint(), 2.5e-3) - film) / 5e-5

    guess = {"bending": 2 * TRUE["bending"], "stretch": 0.5 * TRUE["stretch"]}
    fitted = js.fit(residuals, guess, js.LeastSquares(), n_iterations=7, transforms=js.Positive())
    js.raise_for_status(fitted.status)
    assert float(fitted.parameters["bending"]) == pytest.approx(TRUE["bending"], rel=0.02)
    assert float(fitted.parameters["stretch"]) == pytest.approx(TRUE["stretch"], rel=0.05)
