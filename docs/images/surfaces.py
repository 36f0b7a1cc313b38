"""Draws docs/images/surfaces.png: a faulted surface in noise, a section across its faults, and a mesh refined where its error is.

python docs/images/surfaces.py
"""

import pathlib

import jax
import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxspring as js

jax.config.update("jax_enable_x64", True)
SIDE, NOISE, STEP = 61, 0.05, 0.4


def main():
    """Three panels."""
    net = js.lattice((SIDE, SIDE))
    x, y = np.asarray(net.grid()).T
    truth = 1.0 * (x > 0.4 * y + 14) + 0.7 * (y > 40.5) + 0.2 * np.sin(x / 13) + 0.15 * np.cos(y / 11)
    data = truth + NOISE * np.random.default_rng(3).standard_normal(len(truth))
    broken = js.reconstruction.find_breaks(net, net.grid(), data, stiffness=1.0, data_stiffness=0.3, step=STEP)
    whole = js.reconstruction.find_breaks(net, net.grid(), data, stiffness=1.0, data_stiffness=0.3, step=1e9)
    errors = [np.sqrt(np.mean((found.heights - truth) ** 2)) for found in (whole, broken)]
    figure = Figure((12.4, 4.0), 110, layout="constrained")
    axes = figure.subplots(1, 3)
    axes[0].imshow(data.reshape(SIDE, SIDE), cmap="gray")
    for line in broken.lines:
        axes[0].plot(*line.T, color="tab:red", linewidth=1.5)
    axes[0].set(title=f"{broken.n_broken} broken springs, noise {NOISE}", xticks=[], yticks=[])
    row = slice(25 * SIDE, 26 * SIDE)
    axes[1].plot(data[row], ".", color="0.6", markersize=4, label="data")
    axes[1].plot(whole.heights[row], color="tab:blue", label=f"in one piece, rmse {errors[0]:.3f}")
    axes[1].plot(broken.heights[row], color="tab:red", label=f"broken, rmse {errors[1]:.3f}")
    axes[1].set(title="row 25", xlabel="node")
    axes[1].legend(loc="lower right", fontsize=8)
    image = js.images.elevation_model()
    ny, nx = image.shape
    places = np.stack(np.meshgrid(np.linspace(0, nx - 1, 12), np.linspace(0, ny - 1, 11)), axis=-1).reshape(-1, 2)
    refined = js.reconstruction.refine_by_error(image, places, js.delaunay(places).triangles, 900)
    found = js.reconstruction.fitted_tin(image, refined.points, refined.mesh.triangles)
    axes[2].imshow(np.asarray(image.values), cmap="gray")
    axes[2].triplot(*found.points[:, :2].T, found.triangles, color="tab:orange", linewidth=0.5)
    axes[2].set(title=f"{len(found.points)} nodes, refined by error: rmse {found.errors(image).rmse:.0f} m", xticks=[], yticks=[])
    print(errors, found.errors(image))
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(256).save(target, optimize=True)


if __name__ == "__main__":
    main()
