"""How much better than a uniform mesh is a fitted one, on images of many kinds, with the same settings for all? And than other meshes?

    python -m benchmarks.reconstruction [--quick]

The main job with its default settings: one stiffness per spring, fitted through the rollout, on elevation models that ship with
matplotlib and photographs that ship with scikit-image. First 41 x 41 nodes on every image; then 21, 41 and 81 nodes a side on two
elevation models and three photographs, each mesh with as many nodes: `uniform`, the bilinear spline on the regular grid; `law`, the
slides' stiffness law; `fitted`; `refined`, a fitted lattice of fewer nodes, split where its error is and its sides swapped; `triangles`,
a coarse regular mesh split where its error is, then one stiffness per spring fitted on these triangles, and its sides swapped;
`delatin`, greedy insertion of the worst pixel into a Delaunay mesh (Garland and Heckbert 1995; the package pydelatin, of the extra
`bench`).

Read: errors are root mean squares over all pixels in the image's own unit; `sampled` takes the height from the image under each node,
`best` by least squares over all pixels; `greatest` is the largest error under the same rule; each ratio compares like rule with like.
`folds`, and the smallest angle in degrees. Seconds are those of the whole job in this process, compilation included: images of one size
share their compilation, so the first of a size is the honest one; `first_gradient_s` is the fit's first iteration.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch
from jaxspring.scenes.reconstruction.extras import fitted_surface, greatest_errors
from jaxspring.scenes.reconstruction.fitting import Reconstructed, SpringSettings, fit_springs
from jaxspring.scenes.reconstruction.triangles import triangle_corners

from .measure import arguments, show, write

PHOTOGRAPHS = ("camera", "coins", "moon", "page", "text", "clock", "brick", "grass", "gravel")
SIDES = (21, 41, 81)
COMPARED = ("jacksboro (elevation)", "topobathy (elevation)", "camera", "coins", "moon")
# Nodes of the fitted lattice that is refined, over those of the refined mesh.
SHARE = 0.75


def images(quick: bool) -> Iterator[tuple[str, js.Image]]:
    """Names and images; none needs a download."""
    yield "jacksboro (elevation)", js.images.elevation_model()
    from skimage import data

    if not quick:
        from matplotlib.cbook import get_sample_data

        heights = np.asarray(dict(get_sample_data("topobathy.npz"))["topo"], np.float32)
        yield "topobathy (elevation)", js.Image(heights)
    for name in PHOTOGRAPHS[:1] if quick else PHOTOGRAPHS:
        yield name, js.Image(np.asarray(getattr(data, name)()))


def row(name: str, image: js.Image) -> dict:
    """One default job."""
    clock = Stopwatch()
    found = fit_springs(image)
    seconds = clock.seconds
    uniform, law, fitted = found.uniform, found.law.rmse, found.fitted.rmse
    return {
        "image": name,
        "pixels": "{} x {}".format(*image.shape),
        "uniform_sampled": uniform.sampled,
        "uniform_best": uniform.best,
        "ratio_sampled": uniform.sampled / fitted.sampled,
        "ratio_best": uniform.best / fitted.best,
        "over_law_sampled": law.sampled / fitted.sampled,
        "over_law_best": law.best / fitted.best,
        "folds": found.fitted.folds,
        "outside": found.fitted.outside,
        "seconds": seconds,
        "first_gradient_s": float(found.fit.history.seconds[0]),
    }


def compared(name: str, image: js.Image, side: int, n_iterations: int) -> list[dict]:
    """Every kind of mesh with side x side nodes."""
    clock = Stopwatch()
    found = fit_springs(image, SpringSettings(nodes=(side, side), n_iterations=n_iterations))
    seconds, greatest = clock.seconds, greatest_errors(image, found)
    rows = []
    for kind, errors, taken in (("uniform", found.uniform, 0.0), ("law", found.law.rmse, 0.0), ("fitted", found.fitted.rmse, seconds)):
        surface = {"law": found.law, "fitted": found.fitted}.get(kind)
        angle = None if surface is None else _surface(surface).errors(image).least_angle
        folds = 0 if surface is None else surface.folds
        rows.append(_entry(kind, side**2, errors, greatest[kind], folds, angle, taken))
    rows += [refined(image, side, n_iterations), triangles(image, side, n_iterations)]
    rows += delatin(image, side**2)
    uniform = rows[0]
    for entry in rows:
        entry["ratio_sampled"] = uniform["sampled"] / entry["sampled"]
        entry["ratio_best"] = uniform["best"] / entry["best"]
    return [{"image": name, "side": side, **entry} for entry in rows]


def refined(image: js.Image, side: int, n_iterations: int) -> dict:
    """A fitted lattice of fewer nodes, split where its error is until it has as many, its sides swapped."""
    clock = Stopwatch()
    fewer = max(round(side * SHARE**0.5), 3)
    found: Reconstructed = fit_springs(image, SpringSettings(nodes=(fewer, fewer), n_iterations=n_iterations))
    start = fitted_surface(found)
    finer = js.reconstruction.refine_by_error(image, start.points, start.triangles, side**2)
    tin = js.reconstruction.fitted_tin(image, finer.points, finer.mesh.triangles)
    return _of_tin("refined", image, js.reconstruction.swap_sides(image, tin), clock.seconds)


def triangles(image: js.Image, side: int, n_iterations: int) -> dict:
    """A regular mesh of half the nodes, split where its error is, its springs fitted, its sides swapped."""
    clock = Stopwatch()
    fewer = max(round(side * 0.5**0.5), 3)
    ny, nx = image.shape
    x, y = np.meshgrid(np.linspace(0, nx - 1, fewer), np.linspace(0, ny - 1, fewer))
    points, corners = np.stack([x.ravel(), y.ravel()], axis=-1), triangle_corners(np.zeros((fewer - 1, fewer - 1), bool))
    finer = js.reconstruction.refine_by_error(image, points, corners, side**2)
    settings = js.reconstruction.PlanarSettings(n_iterations=n_iterations, learning_rate=0.05)
    found = js.reconstruction.fit_triangles(image, finer.points, finer.mesh.triangles, settings)
    return _of_tin("triangles", image, js.reconstruction.swap_sides(image, found.tin), clock.seconds)


def delatin(image: js.Image, n_nodes: int) -> list[dict]:
    """The greedy Delaunay mesh, inserted until it has as many nodes: by bisection of its bound of the greatest error."""
    if importlib.util.find_spec("pydelatin") is None:
        return []
    delatin_of = importlib.import_module("pydelatin").Delatin
    values = np.asarray(image.values, np.float32)
    low, high, clock = 0.0, float(np.ptp(values)), Stopwatch()
    best = None
    for _ in range(25):
        bound = 0.5 * (low + high)
        mesh = delatin_of(values, max_error=bound)
        if len(mesh.vertices) <= n_nodes:
            best, high = mesh, bound
        else:
            low = bound
    if best is None:
        return []
    x, y = np.asarray(best.vertices)[:, :2].T
    # It counts y from below.
    points = np.column_stack([x, y])
    rows = values.shape[0] - 1 - y
    at = [values[np.rint(r).astype(int), np.rint(x).astype(int)] for r in (y, rows)]
    points[:, 1] = y if np.abs(at[0] - best.vertices[:, 2]).sum() <= np.abs(at[1] - best.vertices[:, 2]).sum() else rows
    triangles = np.asarray(best.triangles, np.int64).reshape(-1, 3)
    return [_of_tin("delatin", image, js.reconstruction.fitted_tin(image, points, triangles), clock.seconds)]


def _of_tin(kind: str, image: js.Image, tin: js.reconstruction.Tin, seconds: float) -> dict:
    sampled = js.reconstruction.Tin(
        np.column_stack([tin.points[:, :2], np.asarray(image.sample(*tin.points[:, :2].T))]), tin.triangles
    ).errors(image)
    best = tin.errors(image)
    errors, greatest = {"sampled": sampled.rmse, "best": best.rmse}, {"sampled": sampled.greatest, "best": best.greatest}
    return {
        "mesh": kind,
        "nodes": len(tin.points),
        **errors,
        "greatest_sampled": greatest["sampled"],
        "greatest_best": greatest["best"],
        "folds": best.folds,
        "least_angle": best.least_angle,
        "seconds": seconds,
    }


def _entry(kind: str, nodes: int, errors: object, greatest: dict, folds: int, angle: float | None, seconds: float) -> dict:
    sampled, best = (getattr(errors, rule) for rule in ("sampled", "best"))
    return {
        "mesh": kind,
        "nodes": nodes,
        "sampled": sampled,
        "best": best,
        "greatest_sampled": greatest["sampled"],
        "greatest_best": greatest["best"],
        "folds": folds,
        "least_angle": angle,
        "seconds": seconds,
    }


def _surface(mesh: object) -> js.reconstruction.Tin:
    x, y, z, flip = (np.asarray(getattr(mesh, name)) for name in ("x", "y", "z_best", "flip"))
    return js.reconstruction.Tin(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=-1), triangle_corners(flip))


def picture(rows: list[dict], path: Path) -> None:
    """Ratios of errors, an image a group."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(rows))
    axes.bar(place - 0.2, [r["ratio_sampled"] for r in rows], 0.4, label="heights sampled at the nodes")
    axes.bar(place + 0.2, [r["ratio_best"] for r in rows], 0.4, label="heights by least squares")
    axes.axhline(1, color="0.4", linewidth=0.8)
    axes.set_xticks(place, [r["image"] for r in rows], rotation=30, ha="right")
    axes.set(ylabel="rmse uniform / rmse fitted", title="41 x 41 nodes, default settings")
    axes.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Fit every image, print, write the table and the picture; then every kind of mesh of three sizes."""
    rows, meshes, quick = [], [], arguments(__doc__).quick
    for name, image in images(quick):
        if name in COMPARED:
            for side in SIDES[:1] if quick else SIDES:
                some = compared(name, image, side, 100 if quick else SpringSettings().n_iterations)
                show(f"{name}, {side} x {side} nodes", some)
                meshes += some
        if not quick:
            rows.append(row(name, image))
            show(name, rows[-1:])
    show("all", rows)
    path = write("reconstruction", vars(SpringSettings()), {"images": rows, "meshes": meshes})
    if rows:
        picture(rows, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
