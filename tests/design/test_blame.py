"""Constraints that exclude each other: the error names the one to blame."""

import pytest

from design.blame import room_for
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError

from .search_kit import formula_scene


def placed(**placement):
    """The formula's flume, its baffles 0.15 m square, with this placement."""
    area = {"lower": [0.5, 0.0], "upper": [1.8, 1.6], "size": [0.15, 0.3, 0.15], **placement}
    return formula_scene(placement=area, baffle=[])


@pytest.mark.parametrize(
    ("placement", "n", "blamed"),
    [
        # In a strip 0.2 m wide three baffles stand one beside the other, 1.6 m for them all.
        ({"upper": [0.7, 1.6], "gap": 0.9}, 3, "the gap of 0.9 m is to blame"),
        ({"keep_out": [[1.7, 0.0, 1.8, 1.6], [0.4, -0.1, 1.7, 1.7]], "gap": 0.0}, 1,
         "keep_out[1] is to blame"),
        ({"upper": [0.7, 1.6], "gap": 0.5, "keep_out": [[0.4, 0.4, 0.8, 1.7]]}, 2,
         "the gap of 0.5 m and keep_out[0] are each to blame"),
        ({"upper": [0.7, 1.6], "gap": 0.5, "keep_out": [[0.4, 0.5, 0.8, 1.7]]}, 4,
         "the gap of 0.5 m and keep_out[0] are to blame together"),
        ({"wall_gap": 0.75}, 1, "wall_gap of 0.75 m is to blame"),
        ({"max_height": 0.2}, 2, "max_height of 0.2 m is to blame"),
        ({"max_volume": 0.01}, 2, "max_volume of 0.01 is to blame"),
        ({"keep_out_polygons": [[[0.4, -0.1], [1.9, -0.1], [1.9, 1.7], [0.4, 1.7]]]}, 1,
         "keep_out_polygons[0] is to blame"),
        ({"max_height": 0.2, "max_volume": 0.01}, 2,
         "max_height of 0.2 m and max_volume of 0.01 are to blame together"),
    ],
)  # fmt: skip
def test_the_constraint_to_blame_is_named(placement, n, blamed):
    with pytest.raises(LayoutError) as error:
        room_for(placed(**placement), n)
    assert blamed in str(error.value)
    assert "\n" not in str(error.value)


def test_an_area_that_is_too_small_has_nobody_else_to_blame():
    with pytest.raises(LayoutError) as error:
        room_for(placed(gap=0.1), 500)
    assert "blame" not in str(error.value)
    with pytest.raises(LayoutError):
        room_for(placed(gap=0.1), 0)


def test_what_fits_is_as_it_was():
    space, plain = room_for(placed(gap=0.1), 3), LayoutSpace(placed(gap=0.1), 3)
    assert space.lower.tolist() == plain.lower.tolist()
    assert space.n_baffles == 3
