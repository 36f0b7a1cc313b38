"""A fit through melting: what a film of temperatures says about conductivity and melting point."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET, SPACING, THICKNESS = js.lattice((12, 12)), 0.01, 0.002  # m
DENSITY, SPECIFIC_HEAT, LATENT = 6000.0, 400.0, 8e4  # kg/m^3, J/(kg K), J/kg: about gallium's
COLD, HOT = 290.0, 340.0  # K
TRUE = {"conductivity": 30.0, "melting": 305.0}  # W/(m K), K
FIRST = {"conductivity": 18.0, "melting": 320.0}  # 40 % too low; twice as far above COLD
CAPACITY = js.thermal.capacities(NET, DENSITY, SPECIFIC_HEAT, SPACING, THICKNESS)
HEATED = (NET.grid()[:, 0] == 0) & (NET.grid()[:, 1] < 6)  # half of one side: isotherms are curved
START = js.State.from_points(NET, NET.grid(SPACING), temperature=COLD)


def film(p):
    """Thirty frames of temperature [K], one every 20 s, of a plate that melts from one side; and the run's status."""
    heat = js.Heat(
        NET,
        CAPACITY,
        js.thermal.conductances(NET, p["conductivity"], SPACING, THICKNESS),
        js.thermal.ExplicitHeat(),
        js.thermal.FixedTemperature(NET, HEATED, HOT),
        latent=js.thermal.LatentHeat(p["melting"], LATENT * DENSITY * SPACING**2 * THICKNESS),
    )
    # 1 s is half the limit of an explicit step at the true conductivity.
    run = js.rollout(js.System(NET, 1.0, rules=heat), START, js.Still(), 1.0, 600, save_every=20, observe=lambda state: state.temperature)
    return run.saved, run.status


@pytest.mark.slow
def test_conductivity_and_melting_point_are_recovered():
    """From frames with 1 % noise, by Adam through the rollout: within 2 % of the conductivity, and of the melting point above the start."""
    frames, status = film({name: jnp.asarray(value) for name, value in TRUE.items()})
    assert bool(status.is_ok)
    assert 0.1 < float(jnp.mean(frames[-1] > TRUE["melting"])) < 0.9, "a front crosses the plate"
    images = frames + 0.01 * (HOT - COLD) * np.random.default_rng(7).normal(size=frames.shape)

    def loss(p):
        return jnp.mean((film(p)[0] - images) ** 2)

    found = js.fit(
        loss,
        {name: jnp.asarray(value) for name, value in FIRST.items()},
        js.Adam(0.1),
        80,
        transforms={"conductivity": js.Positive(), "melting": js.Bounded(COLD, HOT)},
    )
    assert bool(found.status.is_ok)
    k, melting = (float(found.parameters[name]) for name in ("conductivity", "melting"))
    assert abs(k - TRUE["conductivity"]) < 0.02 * TRUE["conductivity"]
    # Of the distance to the cold plate: 0.3 K. Two per cent of 305 K would be 6 K, and say little.
    assert abs(melting - TRUE["melting"]) < 0.02 * (TRUE["melting"] - COLD)
