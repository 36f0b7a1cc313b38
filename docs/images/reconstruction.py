"""Draws docs/images/reconstruction.png from the folder that `jaxspring fit` wrote.

python -m jaxspring fit --out DIR
python docs/images/reconstruction.py DIR
"""

import pathlib
import sys

import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.tri import LinearTriInterpolator, Triangulation

import jaxspring as js
from jaxspring.scenes.reconstruction.report import uniform_errors
from jaxspring.scenes.reconstruction.scene import Reconstruction


def main(folder):
    """Six panels: image, fitted mesh, and for either mesh the surface and its error on one scale."""
    image = js.images.elevation_model()
    values = np.asarray(image.values, float)
    mesh = np.load(folder / "mesh.npz")
    x, y, z = mesh["points"].T
    net = Triangulation(x, y, mesh["triangles"])
    rows, columns = np.indices(values.shape)
    fitted = np.clip(LinearTriInterpolator(net, z)(columns, rows).filled(np.nan), values.min(), values.max())
    _, _, uniform = uniform_errors(Reconstruction(image, (41, 41)))
    figure = Figure((9.6, 5.6), 110, layout="constrained")
    axes = figure.subplots(2, 3)
    grey = {"cmap": "gray", "vmin": values.min(), "vmax": values.max()}
    axes[0, 0].imshow(values, **grey)
    axes[0, 0].set_title("image: 344 x 403 heights")
    axes[0, 1].imshow(uniform, **grey)
    axes[0, 1].set_title("41 x 41 nodes, uniform mesh")
    shown = axes[0, 2].imshow(fitted, **grey)
    axes[0, 2].set_title("41 x 41 nodes, fitted mesh")
    axes[1, 0].triplot(net, color="tab:blue", linewidth=0.35)
    axes[1, 0].set(xlim=(0, values.shape[1] - 1), ylim=(values.shape[0] - 1, 0), aspect="equal", title="the fitted mesh")
    for panel, surface in ((axes[1, 1], uniform), (axes[1, 2], fitted)):
        error = surface - values
        errors = panel.imshow(error, cmap="RdBu_r", vmin=-80, vmax=80)
        panel.set_title(f"error: rmse {np.sqrt(np.nanmean(error**2)):.1f} m")
    for panel in axes.ravel():
        panel.set_xticks([])
        panel.set_yticks([])
    figure.colorbar(shown, ax=axes[0], label="height (m)")
    figure.colorbar(errors, ax=axes[1], label="surface - image (m)")
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(256).save(target, optimize=True)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
