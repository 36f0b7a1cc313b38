"""Draws docs/images/range_data.png: a terrain with holes, what a mesh makes of it, its error bars; ground under boxes and shrubs.

python docs/images/range_data.py
"""

import pathlib

import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxspring as js

NOISE = 10.0  # m


def terrain():
    """The elevation model with a third of its pixels in holes, noise on the others; a fitted mesh and its error bars."""
    model = js.images.elevation_model()
    heights = np.asarray(model.values)[::2, ::2]
    rng = np.random.default_rng(2)
    missing = np.kron(rng.random((11, 13)) < 0.25, np.ones((16, 16), bool))[: heights.shape[0], : heights.shape[1]]
    missing |= rng.random(heights.shape) < 0.1
    noisy = (heights + rng.normal(0, NOISE, heights.shape)).astype(np.float32)
    image = js.Image(np.where(missing, np.nan, noisy), weights=~missing)
    settings = js.reconstruction.SpringSettings(nodes=(41, 48), n_iterations=300, membrane=1e-3)
    return heights, missing, js.reconstruction.fit_springs(image, settings)


def cloud():
    """Points of hills with boxes and shrubs, and the ground found in them."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 60, (20_000, 2))
    x, y = xy.T

    def hills(x, y):
        return 4 * np.sin(x / 14) + 3 * np.cos(y / 17)

    z = hills(x, y) + rng.normal(0, 0.05, len(xy))
    for cx, cy, wide, deep, high in [(15, 30, 9, 8, 5), (42, 31, 10, 10, 8)]:
        z[(np.abs(x - cx) < wide / 2) & (np.abs(y - cy) < deep / 2)] = hills(cx, cy) + high
    shrub = rng.random(len(xy)) < 0.05
    z[shrub] += rng.uniform(0.8, 5, shrub.sum())
    points = np.column_stack([xy, z])
    return points, js.reconstruction.ground_of_points(js.images.PointCloud(points))


def main():
    """Four panels."""
    heights, missing, found = terrain()
    points, ground = cloud()
    figure = Figure(figsize=(13, 9), layout="compressed")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    low, high = heights.min(), heights.max()
    drawn = axes[0, 0].imshow(np.where(missing, np.nan, heights), cmap="terrain", vmin=low, vmax=high)
    axes[0, 0].set_title(f"heights, {missing.mean():.0%} of the pixels missing, noise {NOISE:g} m")
    axes[0, 1].imshow(found.fitted.image_best, cmap="terrain", vmin=low, vmax=high)
    away = (found.fitted.image_best - heights)[missing]
    axes[0, 1].set_title(f"fitted mesh, 41 x 48 nodes: rmse {np.sqrt(np.mean(away**2)):.0f} m under the holes")
    figure.colorbar(drawn, ax=axes[0], label="height [m]")
    bars = axes[1, 0].tripcolor(*(np.ravel(a) for a in (found.fitted.x, found.fitted.y, found.error_bars(NOISE))), shading="gouraud")
    unreached = found.fitted.unreached
    axes[1, 0].plot(found.fitted.x[unreached], found.fitted.y[unreached], "r.", markersize=4, label="reached by no datum")
    axes[1, 0].set(title="error bars of the heights", aspect="equal")
    axes[1, 0].invert_yaxis()
    axes[1, 0].legend(loc="upper right")
    figure.colorbar(bars, ax=axes[1, 0], label="standard deviation [m]")
    strip = np.abs(points[:, 1] - 30) < 1.5
    for is_ground, colour, name in ((False, "tab:red", "not ground"), (True, "tab:blue", "ground")):
        some = strip & (ground.is_ground == is_ground)
        axes[1, 1].plot(points[some, 0], points[some, 2], ".", markersize=3, color=colour, label=name)
    row = int(np.argmin(np.abs(ground.y[:, 0] + ground.corner[1] - 30)))
    axes[1, 1].plot(ground.x[row] + ground.corner[0], ground.z[row], color="k", linewidth=1.2, label="cloth")
    axes[1, 1].set(title="ground from points: a strip 3 m wide", xlabel="x [m]", ylabel="z [m]")
    axes[1, 1].legend()
    path = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(path, dpi=100)
    PIL.Image.open(path).convert("P", palette=PIL.Image.Palette.ADAPTIVE).save(path, optimize=True)


if __name__ == "__main__":
    main()
