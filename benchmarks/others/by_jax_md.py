"""The neighbour list and pair sum of jax-md, as in `benchmarks.fluid_peers`."""

from benchmarks import fluid_peers

from .layouts import Forms, Scene, of_peer


def forms(scene: Scene) -> Forms:
    """One form."""
    points, speeds, reach, skin = scene["x"], scene["v"], scene.number("reach"), scene.number("skin")
    return {"neighbour list": lambda: of_peer(fluid_peers.jax_md(points, speeds, reach, skin), scene)}
