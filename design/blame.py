"""Which constraint to blame where baffles do not fit: the one that, taken away, makes room."""

from __future__ import annotations

from collections.abc import Iterator

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
        return "the gap and the keep-outs are to blame together: without both they would fit"
    to_blame = [name for name in to_blame if name != "all"]
    verb = "is" if len(to_blame) == 1 else "are each"
    return f"{' and '.join(to_blame)} {verb} to blame: without it they would fit"


def _relaxed(placement: Placement) -> Iterator[tuple[str, Placement]]:
    """Placements with one constraint less, by its name; last, "all", without any."""
    zones = placement.keep_out
    if placement.gap > 0:
        yield f"the gap of {placement.gap:g} m", placement.model_copy(update={"gap": 0.0})
    if len(zones) <= MOST_KEEP_OUTS:
        for k in range(len(zones)):
            rest = tuple(zone for j, zone in enumerate(zones) if j != k)
            yield f"keep_out[{k}]", placement.model_copy(update={"keep_out": rest})
    else:
        yield "the set of keep-outs", placement.model_copy(update={"keep_out": ()})
    if placement.gap > 0 and zones:
        yield "all", placement.model_copy(update={"gap": 0.0, "keep_out": ()})


def _fits(scene: Scene, n_baffles: int) -> bool:
    try:
        LayoutSpace(scene, n_baffles)
    except LayoutError:
        return False
    return True
