"""What is buildable, the nearest buildable layout, and what is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gns_env.layout import LayoutSpace
from gns_env.projection import Arrangement, Projector
from gns_model.errors import LayoutError, SceneError
from gns_model.scene import Placement, Scene

PAPER = [[0.775, 0.375], [0.775, 1.625], [1.275, 1.0]]
SIZE = (0.15, 0.30, 0.15)


def _flume(**changes: object) -> Scene:
    values = {
        "domain": {"lower": [0.1, 0.1, 0.1], "upper": [1.9, 0.9, 1.9]},
        "release": [{"lower": [0.1, 0.1, 0.3], "upper": [0.45, 0.35, 1.7], "velocity": [2, 0, 0]}],
        "placement": {"lower": [0.6, 0.1], "upper": [1.5, 1.9], "gap": 0.05, "size": SIZE},
    }
    return Scene.from_dict({**values, **changes})


def _placement(**changes: object) -> dict[str, object]:
    return {"lower": (0.6, 0.1), "upper": (1.5, 1.9), "gap": 0.05, "size": SIZE, **changes}


PLANE = Scene.from_dict(
    {
        "domain": {"lower": [0.0, 0.0], "upper": [2.0, 1.0]},
        "release": [{"lower": [0.0, 0.0], "upper": [0.3, 0.3], "velocity": [0.0, 0.0]}],
        "placement": {"lower": [0.4], "upper": [1.9], "size": [0.1, 0.2], "keep_out": [[1.0, 1.1]]},
    }
)
KEEP_OUT = ((0.9, 0.8, 1.1, 1.2), (0.6, 0.1, 0.8, 0.3), (1.0, 1.1, 1.4, 1.6))
SCENES = {
    "open": _flume(),
    "keep-outs": _flume(placement=_placement(keep_out=KEEP_OUT)),
    "touching": _flume(placement=_placement(gap=0.0)),
    "over the release": _flume(placement=_placement(lower=(0.1, 0.1))),
    "plane": PLANE,
}
MOST = {"open": 12, "keep-outs": 9, "touching": 12, "over the release": 8, "plane": 6}
SPACES = {
    (name, n): LayoutSpace(scene, n)
    for name, scene in SCENES.items()
    for n in {1, 2, 3, 5, MOST[name]}
}


@st.composite
def requests(draw: st.DrawFn) -> tuple[LayoutSpace, np.ndarray]:
    """A space and centres near, in, far outside, or all at one place of it."""
    space = SPACES[draw(st.sampled_from(sorted(SPACES)))]
    shape = (space.n_baffles, len(space.lower))
    far = draw(st.sampled_from([0.3, 2.0, 1e9]))
    numbers = st.floats(-far, 2 + far, allow_nan=False)
    kind = draw(st.sampled_from(["spread", "one point", "a line", "rounded"]))
    if kind == "one point":
        centres = np.tile(draw(arrays(float, shape[1], elements=numbers)), (shape[0], 1))
    else:
        centres = draw(arrays(float, shape, elements=numbers))
        if kind == "a line":
            centres[:, 0] = centres[0, 0]
        elif kind == "rounded":
            centres = centres.round(1)
    return space, centres


@settings(max_examples=200)
@given(requests())
def test_a_projected_layout_is_buildable_and_stands_in_the_scene(
    case: tuple[LayoutSpace, np.ndarray],
) -> None:
    space, centres = case
    found = space.project(centres)
    assert space.check(found) == []
    assert len(space.scene.with_baffles(found, size=space.size).baffles) == space.n_baffles
    # What is buildable stays; so projecting twice is projecting once.
    np.testing.assert_array_equal(space.project(found), found)


@pytest.mark.slow
def test_five_hundred_requests_for_three_and_for_twelve() -> None:
    rng = np.random.default_rng(3)
    for name, n, times in (("open", 3, 440), ("keep-outs", 3, 50), ("open", 12, 10)):
        space = SPACES[name, n]
        for _ in range(times):
            centres = rng.normal(rng.uniform(space.lower, space.upper), 0.2, (n, 2))
            assert space.check(space.project(centres)) == []


@settings(max_examples=60)
@given(requests(), st.randoms(use_true_random=False))
def test_permuted_requests_give_permuted_layouts(
    case: tuple[LayoutSpace, np.ndarray], random: np.random.Generator
) -> None:
    space, centres = case
    order = list(range(space.n_baffles))
    random.shuffle(order)
    straight, permuted = space.project(centres)[order], space.project(centres[order])
    if len(np.unique(centres, axis=0)) == len(centres):
        np.testing.assert_allclose(permuted, straight, atol=1e-9)
    else:  # coincident requests are interchangeable, as a set nothing changes
        key = np.lexsort(permuted.T), np.lexsort(straight.T)
        np.testing.assert_allclose(permuted[key[0]], straight[key[1]], atol=1e-9)


def _exhaustive(space: LayoutSpace, centres: np.ndarray) -> float:
    """Least squared distance over every cell of every baffle and every side of every pair."""
    projector = Projector(space._free, space.separation, space._slots, len(centres))
    sides = list(itertools.product(range(len(space.lower)), (1.0, -1.0)))
    best = np.inf
    for cells in itertools.product(range(len(space._free)), repeat=len(centres)):
        lower, upper = space._free[list(cells)].swapaxes(0, 1)
        for chosen in itertools.product(sides, repeat=len(projector.first)):
            axis, order = map(np.array, zip(*chosen, strict=True))
            result = projector._solve(centres, Arrangement(lower, upper, axis, order))
            if result is not None:
                best = min(best, result[0])
    return best


def test_two_baffles_land_at_the_nearest_layout_of_all() -> None:
    rng = np.random.default_rng(0)
    for name, times in (("open", 40), ("keep-outs", 4)):
        space = SPACES[name, 2]
        for _ in range(times):
            centres = rng.uniform(space.lower, space.upper) + rng.uniform(-0.15, 0.15, (2, 2))
            distance = float(((space.project(centres) - centres) ** 2).sum())
            assert distance <= _exhaustive(space, centres) * (1 + 1e-4) + 1e-9


def test_three_crowded_baffles_land_near_the_nearest_layout() -> None:
    rng = np.random.default_rng(1)
    space = SPACES["open", 3]
    ratios = []
    while len(ratios) < 15:
        centres = rng.uniform(space.lower, space.upper) + rng.uniform(-0.12, 0.12, (3, 2))
        if space.check(centres):
            distance = float(((space.project(centres) - centres) ** 2).sum())
            ratios.append(distance / _exhaustive(space, centres))
    assert np.median(ratios) < 1 + 1e-4
    assert max(ratios) < 2


def test_a_wish_outside_lands_on_the_edge() -> None:
    space = LayoutSpace(_flume(), 1)
    np.testing.assert_allclose(space.project([[5.0, 1.0]]), [[1.425, 1.0]])
    np.testing.assert_allclose(space.project([[0.0, -3.0]]), [[0.675, 0.175]])


def test_two_at_one_place_part_by_one_gap() -> None:
    found = LayoutSpace(_flume(), 2).project([[1.0, 1.0], [1.0, 1.0]])
    apart = np.abs(found[0] - found[1])
    np.testing.assert_allclose(sorted(apart), [0.0, 0.2], atol=1e-5)
    np.testing.assert_allclose(found.mean(0), [1.0, 1.0], atol=1e-5)


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(SPACES)))
def test_encoding_and_back(seed: int, key: tuple[str, int]) -> None:
    space = SPACES[key]
    unit = np.random.default_rng(seed).uniform(size=space.dim)
    centres = space.decode(unit)
    assert centres.shape == (space.n_baffles, len(space.lower))
    assert (centres >= space.lower).all()
    assert (centres <= space.upper).all()
    np.testing.assert_allclose(space.encode(centres), unit, atol=1e-12)


def test_the_ends_of_the_unit_box_are_the_bounds_exactly() -> None:
    space = LayoutSpace(_flume(), 2)
    np.testing.assert_array_equal(space.decode([0, 0, 1, 1]), [space.lower, space.upper])


def test_random_layouts_are_buildable_and_repeatable() -> None:
    for space in SPACES.values():
        drawn = space.random(np.random.default_rng(5))
        assert space.check(drawn) == []
        np.testing.assert_array_equal(drawn, space.random(np.random.default_rng(5)))


# -- one by one -----------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(SPACES)))
def test_placing_one_by_one_never_ends_in_a_dead_end(seed: int, key: tuple[str, int]) -> None:
    space, rng = SPACES[key], np.random.default_rng(seed)
    centres = np.zeros((0, len(space.lower)))
    for _ in range(space.n_baffles):
        place = space.place(rng.uniform(space.lower - 0.2, space.upper + 0.2), centres)
        centres = np.vstack([centres, place])
        assert space.check(centres) == []


def test_the_last_places_are_kept_for_the_last_baffles() -> None:
    # Room for exactly two; the first one wishes for the middle, which would leave none.
    scene = _flume(placement=_placement(upper=(0.75, 0.45), lower=(0.6, 0.1)))
    space = LayoutSpace(scene, 2)
    first = space.place([0.675, 0.275], np.zeros((0, 2)))
    second = space.place([0.675, 0.275], [first])
    np.testing.assert_allclose(sorted([first[1], second[1]]), [0.175, 0.375])
    with pytest.raises(LayoutError, match="all 2 baffles"):
        space.place([0.675, 0.275], [first, second])


def test_a_free_place_is_taken_as_wished() -> None:
    space = LayoutSpace(_flume(), 3)
    np.testing.assert_array_equal(space.place([1.0, 1.0], [[0.7, 1.0]]), [1.0, 1.0])


# -- what is wrong, in words ----------------------------------------------------------------------


def test_every_fault_is_named() -> None:
    space = LayoutSpace(_flume(placement=_placement(keep_out=[(0.9, 0.8, 1.1, 1.2)])), 3)
    assert space.check(PAPER) == []
    faults = space.check([[0.6, 0.375], [1.0, 1.0], [1.1, 1.18]])
    assert len(faults) == 4
    assert "baffle 0 at 0.6, 0.375 m leaves the placement area" in faults[0]
    assert "baffles 1 and 2 are 0.03 m clear of each other, 0.05 m needed" in faults[1]
    assert "baffle 1 overlaps keep_out[0]" in faults[2]
    assert "baffle 2 overlaps keep_out[0]" in faults[3]


def test_a_baffle_may_stand_under_a_release_that_is_high_enough() -> None:
    high = {"lower": [0.1, 0.5, 0.3], "upper": [0.45, 0.7, 1.7], "velocity": [2.0, 0.0, 0.0]}
    wide = _placement(lower=(0.1, 0.1))
    assert LayoutSpace(_flume(placement=wide), 1).check([[0.3, 1.0]]) == [
        "baffle 0 overlaps release[0]"
    ]
    assert LayoutSpace(_flume(placement=wide, release=[high]), 1).check([[0.3, 1.0]]) == []


def test_without_a_placement_everything_downstream_of_the_front() -> None:
    scene = _flume(placement=None, baffle=[{"center": c, "size": SIZE} for c in PAPER])
    space = LayoutSpace(scene, 3)
    assert space.placement == Placement(lower=(0.5, 0.1), upper=(1.9, 1.9), gap=0.05, size=SIZE)
    assert space.check(PAPER) == []
    assert space.check([[0.56, 1.0]]) != []


@pytest.mark.parametrize(
    ("scene", "n", "message"),
    [
        (_flume(), 37, r"37 baffles of 0.15 x 0.15 m .* at most 36 do"),
        (_flume(), 0, "must be 1 or more, got 0"),
        (_flume(placement=_placement(size=(1.0, 0.3, 0.1))), 1, "larger than the placement"),
        (_flume(placement=_placement(size=(0.1, 0.9, 0.1))), 1, "exceed the domain"),
        (_flume(placement=_placement(keep_out=[(0, 0, 2, 2)])), 1, r"keep_out\[0\]: at most 0 do"),
        (PLANE, 10, r"10 baffles of 0.1 m .* beside keep_out\[0\]: at most 9 do"),
    ],
)
def test_an_impossible_number_of_baffles_is_refused_with_the_possible_one(
    scene: Scene, n: int, message: str
) -> None:
    with pytest.raises(LayoutError, match=message):
        LayoutSpace(scene, n)


def test_as_many_as_the_message_says_do_fit() -> None:
    space = LayoutSpace(_flume(), 36)
    assert space.check(space.project(np.full((36, 2), 1.0))) == []
    space = LayoutSpace(PLANE, 9)
    assert space.check(space.random(np.random.default_rng(0))) == []


def test_a_scene_that_names_no_size_is_refused() -> None:
    with pytest.raises(SceneError, match="which size"):
        LayoutSpace(_flume(placement=None), 2)


@pytest.mark.parametrize(
    ("centres", "message"),
    [
        ([[np.nan, 1.0], [1.0, 1.0]], "finite"),
        ([[np.inf, 1.0], [1.0, 1.0]], "finite"),
        ([[1.0, 1.0, 1.0]], "shape"),
        ([1.0, 1.0], "shape"),
        ([["a", "b"]], "numbers"),
        ([[1.0, 1.0]] * 3, "1 to 2 baffles"),
    ],
)
def test_centres_that_are_none_are_refused(centres: object, message: str) -> None:
    with pytest.raises(LayoutError, match=message):
        LayoutSpace(_flume(), 2).project(centres)  # type: ignore[arg-type]
