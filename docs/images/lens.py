"""Draws docs/images/lens.png: a portrait, the lens of springs that magnifies two parts of it, and how it compares with its wish.

python docs/images/lens.py
"""

import pathlib

import equinox as eqx
import matplotlib.cbook
import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxspring as js
from jaxspring.scenes.lens.pictures import triangle_nodes

FOCI = (js.lens.Disc((250.0, 190.0), 75.0, 1.7), js.lens.Disc((420.0, 500.0), 38.0, 2.0))


def main():
    """Three panels: before, after with the mesh, magnification where it is shown."""
    pixels = np.asarray(PIL.Image.open(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    lens = js.lens.Lens((pixels.shape[0], pixels.shape[1]))
    warp = eqx.filter_jit(lens.warp)(FOCI)
    channels = warp.apply(np.moveaxis(pixels, -1, 0).astype(np.float32))
    after = np.clip(np.moveaxis(np.asarray(channels), 0, -1), 0, 255).round().astype(np.uint8)
    certificate = warp.certificate()
    print("delivered", np.asarray(warp.delivered), "folds", int(certificate.n_folds), "least area", float(certificate.least_area))
    x, y = (np.asarray(a) for a in warp.position)
    figure = Figure((11.5, 4.7), 100, layout="compressed")
    before, meshed, shown = figure.subplots(1, 3)
    before.imshow(pixels)
    meshed.imshow(after)
    meshed.triplot(x.ravel(), y.ravel(), triangle_nodes(warp), color="tab:orange", linewidth=0.35)
    drawn = shown.pcolormesh(x, y, np.log2(np.asarray(warp.magnification)), cmap="PuOr_r", vmin=-1, vmax=1)
    shown.set(aspect="equal", xlim=(0, x.max()), ylim=(y.max(), 0))
    bar = figure.colorbar(drawn, ax=shown, ticks=[-1, -0.5, 0, 0.5, 1], label="linear magnification")
    bar.ax.set_yticklabels(["0.5", "0.71", "1", "1.41", "2"])
    for axes, title in zip((before, meshed, shown), ("before", "after, with the net", "achieved"), strict=True):
        axes.set_title(title)
        axes.set_xticks([])
        axes.set_yticks([])
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(128).save(target, optimize=True)


if __name__ == "__main__":
    main()
