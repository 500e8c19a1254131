"""When a flow strikes a wall that it did not stand at.

Its accelerations then rise several times over within a step, which hardly anything foretells and a
flow with room never sees. Of squares that collapse in a box of 1.5 m, the quarter of the windows
that follows an impact held 63% of all squared errors, relative to what moves the scene, and what is
learned of the rest is what that leaves (docs/training.md, "One velocity, and no impacts").
"""

from __future__ import annotations

import numpy as np

from gns_model.data.windows import Source
from gns_model.errors import FileFormatError
from gns_model.trajectory import open_trajectory

#: How near a wall a flow is stopped by it [spacings of the model]: the grid of the solver carries
#: its forces over two of its own cells.
CLEARANCE = 3.0


def frames_before_impact(source: Source, spacing: float) -> int:
    """Number of frames, from the first, in which no grain is near a side wall of the domain that
    none was near at the first; all frames of a flow that strikes none.

    Baffles are no walls here: they are what a flow around them is about.

    Args:
        source: the file.
        spacing: of the points of the model [m].

    Raises:
        FileFormatError: if the file has become unreadable since it was checked.
    """
    sides = [axis for axis in range(source.scene.dim) if axis != 1]
    try:
        with open_trajectory(source.path) as file:
            place = file["positions"][()][..., sides]
    except (OSError, KeyError) as error:
        raise FileFormatError(f"{source.path}: unreadable ({error})") from None
    domain = source.scene.domain
    lower, upper = (np.asarray(corner)[sides] for corner in (domain.lower, domain.upper))
    gaps = np.concatenate([place.min(1) - lower, upper - place.max(1)], axis=1)
    near = gaps < CLEARANCE * spacing
    struck = (near & ~near[0]).any(1)
    return int(struck.argmax()) if struck.any() else len(place)
