"""How much better than a uniform mesh is a fitted one, on images of many kinds, with the same settings for all?

    python -m benchmarks.reconstruction [--quick]

The main job with its default settings: 41 x 41 nodes, one stiffness per spring, fitted through the rollout. Images are the elevation
models that ship with matplotlib and photographs that ship with scikit-image. Read: errors are root mean squares over all pixels in
the image's own unit; `sampled` takes the height from the image under each node, `best` by least squares over all pixels; each ratio
compares like rule with like; `law` is the slides' stiffness law before the fit. Seconds are those of the whole job in this process,
compilation included: images of one size share their compilation, so the first of a size is the honest one; `first_gradient_s` is the
fit's first iteration.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch
from jaxspring.scenes.reconstruction.fitting import SpringSettings, fit_springs

from .measure import arguments, show, write

PHOTOGRAPHS = ("camera", "coins", "moon", "page", "text", "clock", "brick", "grass", "gravel")


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
    """Fit every image, print, write the table and the picture."""
    rows = []
    for name, image in images(arguments(__doc__).quick):
        rows.append(row(name, image))
        show(name, rows[-1:])
    show("all", rows)
    path = write("reconstruction", vars(SpringSettings()), {"images": rows})
    picture(rows, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
