"""Draws docs/images/plasticity.png: pull over stretch of one spring that yields, creeps and tears.

python docs/images/plasticity.py
"""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxspring as js

PAIR = js.lattice(2)
SPRINGS = js.Springs(PAIR, 100.0, 1.0)  # N/m, m
CYCLES = np.array([0.0, *[0.1, -0.1] * 3])


def driven(rule, stretches, per_second=200):
    """Stretch [m] and pull [N] after every step: the stretches are reached at t = 0, 1, 2 ... s."""
    times = jnp.arange(len(stretches), dtype=float)

    def path(t):
        return js.Vector((jnp.stack([jnp.zeros_like(t), 1 + jnp.interp(t, times, jnp.asarray(stretches))]),))

    motion = js.Motion(np.array([False, True]), path)
    system = js.System(PAIR, 1.0, SPRINGS, free=np.zeros(2, bool), motion=motion, rules=rule)
    start = js.State.from_points(PAIR, [[0.0], [1.0]])
    n_steps = per_second * (len(stretches) - 1)
    frames = js.rollout(system, start, js.Still(), 1 / per_second, n_steps, save_every=1).saved
    pull = jax.vmap(lambda state: PAIR.flatten(SPRINGS.tension(state))[0])(frames)
    return np.asarray(frames.points[:, 1, 0]) - 1, np.asarray(pull)


def main():
    """Four panels."""
    yielding, tearing = js.plasticity.Yielding, js.plasticity.Tearing
    once = np.array([0.0, 0.3])
    panels = {
        "yields at 2 N, hardens by 25 N/m": {"": driven(yielding(PAIR, 2.0, hardening=25.0), CYCLES)},
        "perfectly plastic": {"": driven(yielding(PAIR, 2.0), CYCLES)},
        "overstress by viscosity": {f"{eta:g} N s/m": driven(yielding(PAIR, 2.0, viscosity=eta), CYCLES) for eta in (30.0, 10.0, 1.0)},
        "tears beyond a strain of 0.12": {
            **{f"band {band:g}": driven(tearing(PAIR, strain=0.12, band=band), once) for band in (0.16, 0.08)},
            "at once": driven(tearing(PAIR, strain=0.12), once),
        },
    }
    figure = Figure((9.6, 5.6), 110, layout="constrained")
    for axes, (title, curves) in zip(figure.subplots(2, 2).ravel(), panels.items(), strict=True):
        for name, (stretch, pull) in curves.items():
            axes.plot(np.append(0, stretch), np.append(0, pull), label=name, linewidth=1.2)
        axes.set(title=title, xlabel="stretch (m)", ylabel="pull (N)")
        axes.locator_params(axis="x", nbins=6)
        axes.grid(alpha=0.3)
        if len(curves) > 1:
            axes.legend()
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(64).save(target, optimize=True)


if __name__ == "__main__":
    main()
