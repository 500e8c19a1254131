"""Number, form and rows: every layout that leaves a space can be built, and is one point."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.form import Form
from design.parameters import distributions, ordered, to_centres, to_parameters
from design.rows import RowSpace
from design.space import DesignSpace, built, design_space
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError
from gns_model.footprint import separation

from .search_kit import formula_scene

VARY = {"height": [0.1, 0.35], "across": [0.1, 0.4], "yaw": [-30, 60], "number": [1, 4]}


def scene(vary=None, **placement):
    """The formula's flume with what may vary and what limits it."""
    area = {"lower": [0.5, 0.0], "upper": [1.8, 1.6], "gap": 0.1, **placement}
    return formula_scene(placement={**area, **({"vary": vary} if vary else {})})


LIMITED = scene(VARY, max_height=0.3, max_volume=0.015, wall_gap=0.05)
SPACE = DesignSpace(LIMITED, 2)


def keeps(layout, space, given):
    centres, form = space.split(layout)
    placed = built(given, space, layout)
    placement = given.placement
    assert space.check(layout) == []
    assert len(placed.baffles) == len(centres) in space.numbers
    assert max(b.size[1] for b in placed.baffles) <= (placement.max_height or 9) + 1e-9
    volume = sum(math.prod(b.size) for b in placed.baffles)
    assert volume <= (placement.max_volume or 9) * (1 + 1e-6)
    assert {(b.size, b.yaw) for b in placed.baffles} == {(form.size, form.yaw)}
    for k, one in enumerate(placed.baffles):
        for other in placed.baffles[:k]:
            assert separation(one.corners, other.corners) >= placement.gap - 1e-9
        low, high = one.corners.min(0), one.corners.max(0)
        assert min(low[1], 1.6 - high[1]) >= placement.wall_gap - 1e-9


@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_random_and_projected_layouts_keep_every_constraint(seed):
    rng = np.random.default_rng(seed)
    layout = SPACE.random(rng)
    keeps(layout, SPACE, LIMITED)
    wish = layout + rng.normal(0, 0.1, layout.shape)
    found = SPACE.project(wish)
    keeps(found, SPACE, LIMITED)
    assert (SPACE.project(found) == found).all()
    assert len(found) == len(wish)


@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_every_layout_is_one_point_of_what_a_sampler_sees(seed):
    rng = np.random.default_rng(seed)
    layout = SPACE.random(rng)
    parameters = to_parameters(SPACE, rng.permutation(layout))
    assert set(parameters) == set(distributions(SPACE))
    assert all(
        d._contains(d.to_internal_repr(parameters[name]))
        for name, d in distributions(SPACE).items()
    )
    np.testing.assert_allclose(to_centres(SPACE, parameters), ordered(layout, 2), atol=1e-7)


def test_a_sampler_sees_number_form_and_as_many_places_as_the_most_baffles_need():
    names = list(distributions(SPACE))
    assert names[:4] == ["number", "height", "across", "yaw"]
    assert names[4:] == [f"{axis}{k}" for k in range(1, 5) for axis in ("x", "across")]
    assert (distributions(SPACE)["number"].low, distributions(SPACE)["number"].high) == (1, 4)


def test_the_concrete_limit_shrinks_what_may_shrink_by_one_factor():
    space = DesignSpace(scene({"height": [0.1, 0.4], "across": [0.1, 0.3]}, max_volume=0.01), 2)
    wish = space.join([[0.7, 0.4], [1.2, 1.2]], Form((0.15, 0.4, 0.3)))
    _, form = space.split(space.project(wish))
    assert 2 * math.prod(form.size) == pytest.approx(0.01)
    assert form.size[0] == 0.15
    assert form.size[1] / 0.4 == pytest.approx(form.size[2] / 0.3)


def test_numbers_that_do_not_fit_are_left_out_and_said():
    space = DesignSpace(scene({"number": [2, 6]}, max_volume=0.0203), 6)
    assert space.numbers == (2, 3)
    assert space.n_baffles == 3
    assert "4 baffles are left out" in space.notes[0]
    assert "max_volume" in space.notes[0]


@pytest.mark.parametrize(
    ("given", "blamed"),
    [
        (scene({"number": [3, 5]}, max_volume=0.01), "max_volume 0.01"),
        (scene({"height": [0.3, 0.5]}, max_height=0.25), "max_height is to blame"),
        (scene({"height": [0.1, 0.2], "number": [2, 3]}, max_volume=0.001), "max_volume"),
        (scene({"across": [0.8, 1.0], "number": [2, 4]}, upper=[0.7, 1.6]), "gap of 0.1 m"),
        (scene({"yaw": [0, 45]}, lower=[0.5, 0.0], upper=[0.6, 1.6]), "larger than"),
    ],
)
def test_ranges_that_exclude_each_other_are_one_line_with_the_one_to_blame(given, blamed):
    with pytest.raises(LayoutError) as error:
        design_space(given, 2)
    assert blamed in str(error.value)
    assert "\n" not in str(error.value)


def test_a_scene_that_varies_nothing_has_its_plain_space(plane_scene):
    assert isinstance(design_space(scene(), 2), LayoutSpace)
    flat = plane_scene.replace(
        placement={"lower": [0.4], "upper": [1.0], "vary": {"height": [0.1, 0.2]}}
    )
    space = design_space(flat, 2)
    layout = space.random(np.random.default_rng(0))
    assert layout.shape == (2, 2)
    assert space.check(layout) == []
    back = to_centres(space, to_parameters(space, layout))
    np.testing.assert_allclose(back, ordered(layout, 1), atol=1e-9)


# -- rows ------------------------------------------------------------------------------------------

BESIDE = {"keep_out": [[0.8, 0.0, 1.0, 0.5]]}


@pytest.mark.parametrize(
    ("given", "n"),
    [(scene(), 1), (scene(), 3), (scene(**BESIDE), 4), (scene({"number": [2, 5]}), 3)],
)
def test_rows_are_rows_buildable_and_one_point(given, n):
    space, rng = RowSpace(given, n), np.random.default_rng(n)
    kinds = set()
    for _ in range(12):
        layout = space.random(rng)
        assert space.check(layout) == []
        places, counts = np.unique(layout[:, 0].round(6), return_counts=True)
        assert np.ptp(counts) <= 1
        assert np.ptp(np.diff(places)) < 1e-5 if len(places) > 2 else True
        for x in places:
            gaps = np.diff(np.sort(layout[np.isclose(layout[:, 0], x), 1]))
            assert np.ptp(gaps) < 1e-5 if len(gaps) > 1 else True
        parameters = to_parameters(space, layout)
        back = ordered(to_centres(space, parameters), 2)
        np.testing.assert_allclose(back, ordered(layout, 2), atol=1e-4)
        kinds.add((len(layout), len(places)))
    assert n == 1 or len(kinds) > 1


def test_the_scene_s_own_staggered_layout_is_rows_and_another_is_not():
    space = RowSpace(scene(), 3)
    assert space.check([[0.8, 0.3], [0.8, 1.3], [1.3, 0.8]]) == []
    assert "straight rows" in space.check([[0.8, 0.3], [0.9, 1.3], [1.3, 0.6]])[0]


def test_where_no_rows_may_stand_it_is_said():
    # Two corners that are free, and neither beside nor behind each other.
    zones = [[0.0, 0.3, 2.0, 1.3], [0.0, 0.0, 1.5, 0.3], [0.7, 1.3, 2.0, 1.6]]
    with pytest.raises(LayoutError, match="pattern free"):
        RowSpace(scene(keep_out=zones), 2)
