"""PyTorch on the CPU: `grid_sample` on a picture, and its own gradient by the points."""

# pyright: reportMissingImports=false

import os
from typing import Any

import numpy as np
import torch

from .layouts import Forms, Program, Scene

torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    return {"grid_sample": lambda: image(scene)}


def image(scene: Scene) -> Program:
    """`grid_sample` takes points from -1 to 1 from edge pixel to edge pixel; the scene's points are brought there outside the timing."""
    slopes = str(scene["kind"]) == "gradient image"
    ny, nx = scene["image"].shape
    picture = torch.from_numpy(scene["image"])[None, None]
    scale = torch.tensor([2 / (nx - 1), 2 / (ny - 1)])
    grid = (torch.from_numpy(np.stack([scene["x"], scene["y"]], axis=-1)) * scale - 1)[None, None].requires_grad_(slopes)
    last: list[Any] = [None]

    def sample() -> Any:
        return torch.nn.functional.grid_sample(picture, grid, mode="bilinear", padding_mode="border", align_corners=True)

    def run(n_steps: int) -> None:
        for _ in range(n_steps):
            if slopes:
                (last[0],) = torch.autograd.grad((sample() ** 2).sum(), grid)
            else:
                last[0] = sample()

    def result() -> np.ndarray:
        if slopes:
            return (last[0][0, 0] * scale).numpy().T
        return last[0][0, 0, 0].numpy()

    return Program(run, result)
