"""Draws docs/images/cloth.png: three published fabrics in Cusick's drape test, at rest.

python docs/images/cloth.py
"""

import pathlib

import jax
import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import jaxspring as js

jax.config.update("jax_enable_x64", True)
LIGHT = np.array([0.35, -0.45, 0.82])
FABRICS = {"interlock": js.cloth.INTERLOCK, "denim": js.cloth.DENIM, "swim knit": js.cloth.SWIM_KNIT}
SCENE = js.cloth.cusick(js.cloth.ClothSettings(spacing=0.0125))


@jax.jit
def at_rest(material):
    """Places [m], drape coefficient, status."""
    rough = SCENE.points.copy()
    overhangs = np.hypot(rough[:, 0], rough[:, 1]) > 0.09 + 1e-9
    rough[:, 2] = 1e-3 * np.random.default_rng(1).normal(size=len(rough)) * overhangs
    made = SCENE.made_of(material)
    found = js.equilibrium(made.system, js.State.from_points(SCENE.cloth.net, rough), tolerance=1e-6)
    return found.state.points, js.cloth.drape_coefficient(made, found.state), found.status


def draw(axes, points):
    """The surface, shaded."""
    corners = 100 * points[np.asarray(SCENE.cloth.net.triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shade = 0.3 + 0.7 * np.abs(normals @ LIGHT) / np.linalg.norm(normals, axis=1)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=shade[:, None] * [0.35, 0.62, 0.85], edgecolors="none"))
    axes.set(xlim=(-14, 14), ylim=(-14, 14), zlim=(-7, 1))
    axes.set_box_aspect((28, 28, 8), zoom=1.3)
    axes.view_init(elev=28, azim=-60)
    axes.set_axis_off()


def main():
    """Three panels."""
    figure = Figure((9.6, 3.2), 110, layout="constrained")
    for i, (name, published) in enumerate(FABRICS.items()):
        points, coefficient, status = at_rest(published.fabric())
        js.raise_for_status(status)
        axes = figure.add_subplot(1, 3, i + 1, projection="3d")
        draw(axes, np.asarray(points))
        axes.set_title(f"{name}: drape coefficient {float(coefficient):.2f}")
        print(name, float(coefficient))
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(64).save(target, optimize=True)


if __name__ == "__main__":
    main()
