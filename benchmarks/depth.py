"""How well are withheld pixels of a depth image recovered, beside linear interpolation?

    python -m benchmarks.depth [--quick]

The disparity of scikit-image's motorcycle, every second pixel, of which a third is withheld, pixel by pixel or in squares; the pixels
without a disparity are holes already. Read: errors over the withheld pixels, in pixels of disparity; `rmse` counts the steps between things
most, `mean` the surfaces. The rows:

    linear          SciPy's LinearNDInterpolator over the pixels that are left (Delaunay)
    even springs    a node per pixel, equal springs along z to 8 neighbours, data springs of the pixels that are left: a membrane
    photo springs   the same, each spring weaker by exp(-|dI| / scale) where the photograph changes by |dI|, summed over its channels: a
                    surface may break where the picture does. The scale is chosen on another third of the pixels, withheld from the rest
    fitted mesh     `fit_springs` on the holed image, 41 x 41 nodes only, best heights
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from scipy.interpolate import LinearNDInterpolator

import jaxspring as js
from jaxspring.progress import Stopwatch

from .measure import arguments, show, write

SCALES = (10.0, 20.0, 40.0, 80.0)
LEAST = 1e-4  # of a spring across an edge, so that no node hangs in the air
DATA = 1e3  # data springs over the springs of the membrane: the data are clean


def scene(quick: bool) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (NaN where there is none) and photograph, every second pixel; of a quick run the middle alone."""
    from skimage import data

    left, _, disparity = data.stereo_motorcycle()
    part = np.s_[150:350:2, 200:400:2] if quick else np.s_[::2, ::2]
    disparity = np.asarray(disparity[part], np.float64)
    return np.where(np.isfinite(disparity), disparity, np.nan), np.asarray(left[part], np.float64)


def withheld(shape: tuple[int, int], side: int, rng: np.random.Generator) -> np.ndarray:
    """A third of the pixels, in squares of `side`."""
    squares = rng.random([-(-n // side) for n in shape]) < 1 / 3
    return np.kron(squares, np.ones((side, side), bool))[: shape[0], : shape[1]]


def membrane(disparity: np.ndarray, known: np.ndarray, photo: np.ndarray | None = None, scale: float = 1.0) -> np.ndarray:
    """Heights of a node per pixel at rest between data springs and springs along z."""
    ny, nx = disparity.shape
    net = js.lattice((ny, nx), js.STRUCTURAL + js.SHEAR)
    stiffness = np.ones(net.n_springs)
    if photo is not None:
        tail, head = np.asarray(net.edges).T
        colours = photo.reshape(-1, 3)
        stiffness = np.maximum(np.exp(-np.abs(colours[tail] - colours[head]).sum(axis=-1) / scale), LEAST)
    image = js.Image(np.where(known, disparity, np.nan), weights=known)
    x, y = np.meshgrid(np.arange(nx, dtype=float), np.arange(ny, dtype=float))
    free = np.zeros((ny * nx, 3), bool)
    free[:, 2] = True
    system = js.System(net, 1.0, (js.Springs(net, stiffness, 0.0, axes=(2,)), js.DataSprings(image, DATA)), free=free)
    start = js.State.from_points(net, np.stack([x, y, np.asarray(image.values)], axis=-1).reshape(-1, 3))
    found = js.equilibrium(system, start, tolerance=1e-6)
    js.raise_for_status(found.status)
    return np.asarray(found.state.position.z)


def mesh(disparity: np.ndarray, known: np.ndarray, quick: bool) -> np.ndarray:
    """The surface of a fitted mesh at every pixel."""
    settings = js.reconstruction.SpringSettings(n_iterations=50 if quick else 300)
    image = js.Image(np.where(known, disparity, np.nan).astype(np.float32), weights=known)
    return js.reconstruction.fit_springs(image, settings).fitted.image_best


def rows(quick: bool) -> tuple[list[dict], dict[str, np.ndarray]]:
    """A row per way of withholding and method, and what the picture needs."""
    disparity, photo = scene(quick)
    has, rng = np.isfinite(disparity), np.random.default_rng(1)
    found, kept = [], {"disparity": disparity, "photo": photo}
    for side in (1, 8):
        hidden, learning = (withheld(disparity.shape, side, rng) for _ in range(2))
        known = has & ~hidden
        scores = [error(membrane(disparity, known & ~learning, photo, scale), disparity, known & learning)[0] for scale in SCALES]
        of_side, surfaces = compared(disparity, photo, known, has & hidden, SCALES[int(np.argmin(scores))], quick)
        found += [{"withheld": f"{side} x {side}", **row} for row in of_side]
        kept |= {f"{name}, {side}": np.abs(surface - disparity) for name, surface in surfaces.items()}
    return found, kept


def compared(
    disparity: np.ndarray, photo: np.ndarray, known: np.ndarray, test: np.ndarray, scale: float, quick: bool
) -> tuple[list[dict], dict[str, np.ndarray]]:
    """Every method from the pixels `known`, judged on `test`."""
    methods = {
        "linear": lambda: LinearNDInterpolator(np.argwhere(known), disparity[known])(np.indices(disparity.shape).transpose(1, 2, 0)),
        "even springs": lambda: membrane(disparity, known),
        "photo springs": lambda: membrane(disparity, known, photo, scale),
        "fitted mesh": lambda: mesh(disparity, known, quick),
    }
    found, surfaces = [], {}
    for name, method in methods.items():
        clock = Stopwatch()
        surfaces[name] = method()
        # Outside the convex hull there is no linear interpolation: there nobody is judged.
        judged = test & np.isfinite(surfaces["linear"])
        rmse, mean = error(surfaces[name], disparity, judged)
        numbers = {"pixels": int(judged.sum()), "rmse": rmse, "mean": mean}
        found.append({"method": name, **numbers, "scale": scale if name == "photo springs" else None, "seconds": clock.seconds})
    return found, surfaces


def error(surface: np.ndarray, disparity: np.ndarray, where: np.ndarray) -> tuple[float, float]:
    """Root mean square and mean absolute error there."""
    away = (surface - disparity)[where]
    return float(np.sqrt(np.mean(away**2))), float(np.mean(np.abs(away)))


def picture(found: list[dict], kept: dict[str, np.ndarray], path: Path) -> None:
    """Disparity, photograph, and where two methods err on squares."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8), layout="compressed")
    axes = figure.subplots(2, 2)
    axes[0, 0].imshow(kept["photo"].astype(np.uint8))
    axes[0, 0].set_title("photograph")
    drawn = axes[0, 1].imshow(kept["disparity"], cmap="viridis")
    axes[0, 1].set_title("disparity [pixels]; white: none")
    figure.colorbar(drawn, ax=axes[0, 1])
    rmse = {row["method"]: row["rmse"] for row in found if row["withheld"] == "8 x 8"}
    for place, name in zip(axes[1], ("linear", "photo springs"), strict=True):
        drawn = place.imshow(kept[f"{name}, 8"], cmap="magma", vmin=0, vmax=5)
        place.set_title(f"{name}: error with a third withheld in squares of 8, rmse {rmse[name]:.3g}")
    figure.colorbar(drawn, ax=axes[1], label="|error| [pixels]")
    for place in axes.flat:
        place.set_axis_off()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Compare, print, write the table and the picture."""
    found, kept = rows(arguments(__doc__).quick)
    show("a third of the pixels of a depth image withheld", found)
    path = write("depth", {"scales": SCALES, "data": DATA, "least": LEAST}, {"rows": found})
    picture(found, kept, path.with_suffix(".png"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
