"""Which constraint to blame where baffles do not fit: the one that, taken away, makes room."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError
from gns_model.scene import Placement, Scene

#: Keep-outs that are tried one by one; of more, all are taken away together.
MOST_KEEP_OUTS = 6


def room_for(scene: Scene, n_baffles: int) -> LayoutSpace:
    """The buildable layouts, or an error that names the constraint to blame.

    Raises:
        LayoutError: if that many baffles do not fit: as `LayoutSpace` says it, and what to change.
        SceneError: as `LayoutSpace`.
    """
    try:
        return LayoutSpace(scene, n_baffles)
    except LayoutError as error:
        culprit = _culprit(scene, n_baffles)
        if culprit is None:
            raise
        raise LayoutError(f"{error}; {culprit}") from None


def _culprit(scene: Scene, n_baffles: int) -> str | None:
    placement = scene.placement
    if placement is None or n_baffles < 1:
        return None
    # Sizes may come from baffles that stand in the way of what is tried here.
    own = {"size": scene.baffle_size, "yaw": scene.baffle_yaw or None}
    bare = scene.replace(baffles=(), placement=placement.model_copy(update=own))
    assert bare.placement is not None
    to_blame = [
        name
        for name, relaxed in _relaxed(bare.placement)
        if _fits(bare.replace(placement=relaxed), n_baffles)
    ]
    if not to_blame:
        return None
    if to_blame == ["all"]:
        names = [name for name, _ in _relaxed(bare.placement)][:-1]
        return (
            f"{', '.join(names[:-1])} and {names[-1]} are to blame together: without them they "
            "would fit"
        )
    to_blame = [name for name in to_blame if name != "all"]
    verb = "is" if len(to_blame) == 1 else "are each"
    return f"{' and '.join(to_blame)} {verb} to blame: without it they would fit"


def _relaxed(placement: Placement) -> Iterator[tuple[str, Placement]]:
    """Placements with one constraint less, by its name; last, "all", without any."""
    p = placement
    free: dict[str, Any] = {}
    for name, words, nothing in (
        ("gap", f"the gap of {p.gap:g} m", 0.0),
        ("wall_gap", f"wall_gap of {p.wall_gap:g} m", 0.0),
        ("max_height", f"max_height of {p.max_height or 0:g} m", None),
        ("max_volume", f"max_volume of {p.max_volume or 0:g}", None),
    ):
        if getattr(p, name):
            free[name] = nothing
            yield words, p.model_copy(update={name: nothing})
    for name, words in (("keep_out", "keep-outs"), ("keep_out_polygons", "keep-out polygons")):
        zones = getattr(p, name)
        if not zones:
            continue
        free[name] = ()
        if len(zones) > MOST_KEEP_OUTS:
            yield f"the set of {words}", p.model_copy(update={name: ()})
            continue
        for k in range(len(zones)):
            rest = tuple(zone for j, zone in enumerate(zones) if j != k)
            yield f"{name}[{k}]", p.model_copy(update={name: rest})
    if len(free) > 1 or sum(len(getattr(p, name)) for name in free if "keep" in name) > 1:
        yield "all", p.model_copy(update=free)


def _fits(scene: Scene, n_baffles: int) -> bool:
    try:
        LayoutSpace(scene, n_baffles)
    except LayoutError:
        return False
    return True
