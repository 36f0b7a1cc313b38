"""What does a lens of springs cost as a layer, and how does it distort beside a fisheye and a separable warp?

    python -m benchmarks.lens [--quick]

First table: images of 512 x 512 pixels, float32, a mesh of 33 x 33 nodes, one disc: the mesh alone, the layer, the layer with its gradient
by centre, radius and magnification, and batches of 16 with 16 discs. Second table: the same disc by three maps, each with the magnification
m in its middle, on the same triangles (a mesh of 65 x 65 nodes, float64):

    springs     js.lens.Lens
    fisheye     Sarkar and Brown (1994), g(t) = (d + 1) t / (d t + 1) along each axis from the focus to the border, d = m - 1
    separable   x and y by themselves, m times within the disc's width and evenly squeezed beside it

Read: `ms` the median of interleaved rounds, and its spread; `achieved` the least and largest magnification over the cells inside the disc,
`anisotropy` its largest value inside the disc and anywhere, `folds` triangles turned over, `context` the least magnification anywhere.

Needs: pip install 'jaxspring[bench]'
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

SIDE, BATCH = 512, 16
MIDDLE = (SIDE - 1) / 2


def layers(n_batch: int) -> dict[str, Callable[[], Any]]:
    """The programs to be timed, compiled."""
    lens = js.lens.Lens((SIDE, SIDE))
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.uniform(size=(n_batch, SIDE, SIDE)), jnp.float32)
    given = jnp.asarray([MIDDLE, MIDDLE, 0.3 * MIDDLE, 2.0], jnp.float32)
    shifts = jnp.linspace(-40, 40, n_batch, dtype=jnp.float32)[:, None] * jnp.asarray([1.0, 1.0, 0.0, 0.0], jnp.float32)

    def disc(p: jax.Array) -> js.lens.Disc:
        return js.lens.Disc(p[:2], p[2], p[3])

    def loss(p: jax.Array, image: jax.Array) -> jax.Array:
        return jnp.mean(lens(image, disc(p)) ** 2)

    mesh = jax.jit(lambda p: lens.warp(disc(p)).position)
    layer = jax.jit(lambda p, image: lens(image, disc(p)))
    slope = jax.jit(jax.value_and_grad(loss))
    many, many_slopes = jax.jit(jax.vmap(layer)), jax.jit(jax.vmap(jax.value_and_grad(loss)))
    return {
        "mesh": lambda: mesh(given),
        "layer": lambda: layer(given, images[0]),
        "layer and gradient": lambda: slope(given, images[0]),
        f"{n_batch} layers": lambda: many(given + shifts, images),
        f"{n_batch} layers and gradients": lambda: many_slopes(given + shifts, images),
        f"{n_batch} images, one disc": lambda: layer(given, images),
    }


def timed(programs: dict[str, Callable[[], Any]], rounds: int) -> dict[str, np.ndarray]:
    """Milliseconds of every program in interleaved rounds, after one that compiles."""
    for program in programs.values():
        jax.block_until_ready(program())
    spent: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            start = time.perf_counter()
            jax.block_until_ready(program())
            spent[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.asarray(values) for name, values in spent.items()}


def fisheye(t: np.ndarray, centre: float, magnification: float) -> np.ndarray:
    """Sarkar and Brown's map along one axis, whose ends are -1 and 1."""
    reach = np.where(t > centre, 1 - centre, 1 + centre)
    u, d = np.abs(t - centre) / reach, magnification - 1
    return centre + np.sign(t - centre) * reach * (d + 1) * u / (d * u + 1)


def separable(t: np.ndarray, centre: float, radius: float, magnification: float) -> np.ndarray:
    """m times within the radius, kept in place in the middle of the sheet, and evenly squeezed beside it."""
    squeezed = (1 - magnification * radius) / (1 - radius)
    off = t - centre
    inside = np.clip(off, -radius, radius)
    return centre + magnification * inside + squeezed * (off - inside)


def measures(warp: js.lens.Warp, radius: float) -> dict[str, float]:
    """What a map does to the disc and to the rest."""
    n = warp.mesh.cells[0]
    centres = (np.indices((n, n)) + 0.5) * 2 / n - 1
    inside = np.hypot(*centres) < radius - np.sqrt(2) / n
    magnification, anisotropy = np.asarray(warp.magnification), np.asarray(warp.anisotropy).max(axis=0)
    return {
        "least": magnification[inside].min(),
        "largest": magnification[inside].max(),
        "anisotropy_in": anisotropy[inside].max(),
        "anisotropy": anisotropy.max(),
        "folds": int(warp.certificate().n_folds),
        "context": magnification.min(),
    }


def peers(radius: float, magnification: float) -> dict[str, dict[str, float]]:
    """The three maps of one disc in the middle."""
    lens = js.lens.Lens((SIDE, SIDE), nodes=65)
    disc = js.lens.Disc((MIDDLE, MIDDLE), radius * MIDDLE, magnification)
    springs = eqx.filter_jit(lens.warp)(disc)
    t = np.asarray(lens.mesh.x)[0] / MIDDLE - 1
    found = {"springs": measures(springs, radius)}
    for name, along in (("fisheye", fisheye(t, 0.0, magnification)), ("separable", separable(t, 0.0, radius, magnification))):
        place = jnp.asarray(MIDDLE * (along + 1), lens.mesh.x.dtype)
        position = js.Vector((jnp.broadcast_to(place[None, :], lens.mesh.x.shape), jnp.broadcast_to(place[:, None], lens.mesh.x.shape)))
        found[name] = measures(eqx.tree_at(lambda w: w.position, springs, position), radius)
    return found


def main() -> None:
    """Both tables."""
    quick = "--quick" in sys.argv[1:]
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, {SIDE} x {SIDE} pixels")
    print(f"{'program':28s} {'ms':>8s} {'quartiles':>16s}")
    for name, spent in timed(layers(4 if quick else BATCH), 3 if quick else 15).items():
        low, middle, high = np.percentile(spent, [25, 50, 75])
        print(f"{name:28s} {middle:8.1f} {low:7.1f} .. {high:5.1f}")
    jax.config.update("jax_enable_x64", True)
    print(f"\n{'map':10s} {'R':>4s} {'m':>4s} {'achieved':>15s} {'anisotropy in':>13s} {'anywhere':>9s} {'folds':>5s} {'context':>8s}")
    for radius, magnification in ((0.3, 1.5), (0.3, 2.0), (0.2, 3.0)):
        for name, row in peers(radius, magnification).items():
            achieved = f"{row['least']:.3f} .. {row['largest']:.3f}"
            print(
                f"{name:10s} {radius:4.1f} {magnification:4.1f} {achieved:>15s} {row['anisotropy_in']:13.2f} {row['anisotropy']:9.2f} "
                f"{row['folds']:5d} {row['context']:8.3f}"
            )


if __name__ == "__main__":
    main()
