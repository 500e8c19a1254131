"""A block of grains of any number of points, for timing: what it does later does not matter."""

from __future__ import annotations

from gns_model import paper
from gns_model.scene import Scene


def block_scene(dim: int, points: int, spacing: float) -> Scene:
    """A block half as high as long, in a domain twice as long, of about `points` points.

    Material and friction are those of the paper's columns in 2D and of its flume in 3D.
    """
    height = max(2, round((points / 2) ** 0.5 if dim == 2 else (points / 4) ** (1 / 3)))
    across = [max(2, round((points / height) ** (1 / (dim - 1))))] * (dim - 1)
    counts = (across[0], height, *across[1:])
    size = tuple(n * spacing for n in counts)
    like = paper.column_scene(paper.COLUMNS[0]) if dim == 2 else paper.flume_scene()
    return Scene.from_dict(
        {
            "name": f"block-{points}",
            "duration": 1.0,
            "domain": {
                "lower": (0.0,) * dim,
                "upper": (2 * size[0], 1.25 * size[1], *size[2:]),
            },
            "friction": like.friction.model_dump(),
            "material": like.material.model_dump(),
            "release": [{"lower": (0.0,) * dim, "upper": size, "velocity": (0.0,) * dim}],
        }
    )
