"""Draws docs/images/cloth.png: a draped disc, a sheet hung by two corners, and the strip of the bending test, each as it comes to rest.

python docs/images/cloth.py
"""

import pathlib

import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import jaxspring as js

LIGHT = np.array([0.35, -0.45, 0.82])
CLOTH = js.cloth.ClothSettings
SCENES = {
    "Cusick's drape test": (js.cloth.cusick(CLOTH(spacing=0.0125)), 1.2),
    "hung by two corners": (js.cloth.hanging(CLOTH(size=0.4, spacing=0.02)), 1.5),
    "the bending test": (js.cloth.cantilever(CLOTH(size=0.06, spacing=0.004)), 0.8),
}


def at_rest(scene, duration, dt=0.01):
    """Places after some seconds of implicit steps with drag [m]."""
    damped = js.System(
        scene.cloth.net,
        scene.cloth.mass,
        (*scene.system.forces, js.Drag(4.0 * scene.cloth.mass)),
        free=scene.cloth.net.flatten_nodes(scene.system.free),
    )
    rough = scene.points + np.random.default_rng(0).normal(size=scene.points.shape) * [0, 0, 5e-4]
    run = js.rollout(damped, js.State.from_points(scene.cloth.net, rough), scene.stepper, dt, round(duration / dt))
    js.raise_for_status(run)
    return np.asarray(run.state.points)


def draw(axes, triangles, points):
    """The surface, shaded."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shade = 0.3 + 0.7 * np.abs(normals @ LIGHT) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=shade[:, None] * [0.35, 0.62, 0.85], edgecolors="none"))
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) / 2, 0.05 * np.max(high - low))
    middle = (low + high) / 2
    axes.set(**{f"{name}lim": (m - h, m + h) for name, m, h in zip("xyz", middle, half, strict=True)})
    axes.set_box_aspect(half, zoom=1.15)
    axes.view_init(elev=24, azim=-60)
    axes.set_axis_off()


def main():
    """Three panels."""
    figure = Figure((9.6, 3.6), 110, layout="constrained")
    for i, (name, (scene, duration)) in enumerate(SCENES.items()):
        axes = figure.add_subplot(1, 3, i + 1, projection="3d")
        points = at_rest(scene, duration)
        draw(axes, np.asarray(scene.cloth.net.triangles), points)
        axes.set_title(name)
    FigureCanvasAgg(figure)
    target = pathlib.Path(__file__).with_suffix(".png")
    figure.savefig(target, metadata={"Software": None})
    PIL.Image.open(target).convert("RGB").quantize(64).save(target, optimize=True)


if __name__ == "__main__":
    main()
