from __future__ import annotations

import copy
import itertools
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_model.errors import GnsError, SceneError
from gns_model.files import write_whole
from gns_model.scene import Scene


def plain(**changes: object) -> dict:
    """A valid scene as plain values; `changes` sets entries by "table.key" or "list[0].key"."""
    values: dict = {
        "duration": 0.5,
        "domain": {"lower": [0.0, 0.0, 0.0], "upper": [2.0, 1.0, 1.0]},
        "friction": {"base": 0.5},
        "material": {"friction_angle": 30.0},
        "release": [{"lower": [0, 0, 0], "upper": [0.4, 0.3, 1.0], "velocity": [1, 0, 0]}],
        "baffle": [{"center": [1.0, 0.5], "size": [0.1, 0.3, 0.2]}],
        "placement": {"lower": [0.6, 0.0], "upper": [1.8, 1.0]},
    }
    for path, value in changes.items():
        spot = values
        *parents, last = path.split("__")
        for name in parents:
            spot = spot[int(name) if name.isdigit() else name]
        spot[int(last) if last.isdigit() else last] = value
    return values


def test_plain_is_a_scene():
    scene = Scene.from_dict(plain())
    assert scene.dim == 3
    assert scene.front == 0.4
    assert scene.base == 0.0
    assert scene.control_section == pytest.approx(1.2)
    assert scene.gravity == (0.0, -9.81, 0.0)


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"colour": "red"}, ["colour", "'red'", "unknown key"]),
        ({"material__stiffness": 2e6}, ["material.stiffness", "2000000", "unknown key"]),
        ({"baffle__0__angle": 10}, ["baffle.0.angle", "10", "unknown key"]),
        ({"duration": -1.0}, ["duration", "-1.0", "greater than 0"]),
        ({"duration": "long"}, ["duration", "'long'", "number"]),
        ({"duration": math.nan}, ["duration", "nan", "finite"]),
        ({"friction__base": -0.1}, ["friction.base", "-0.1", "greater than or equal to 0"]),
        ({"friction__walls": math.inf}, ["friction.walls", "inf", "finite"]),
        ({"material__density": 0.0}, ["material.density", "0.0", "greater than 0"]),
        ({"material__youngs_modulus": 0.0}, ["material.youngs_modulus", "greater than 0"]),
        ({"material__poisson_ratio": 0.5}, ["material.poisson_ratio", "0.5", "less than 0.5"]),
        ({"material__friction_angle": 90.0}, ["material.friction_angle", "90", "less than 90"]),
        ({"material__cohesion": -1.0}, ["material.cohesion", "-1.0", "or equal to 0"]),
        ({"material__tension_cutoff": 5.0}, ["material", "tension_cutoff 5 Pa", "apex", "= 0 Pa"]),
        ({"gravity": [0.0, -9.81]}, ["gravity", "-9.81", "3 numbers"]),
        ({"domain__upper": [2.0, 1.0]}, ["domain", "2"]),
        ({"domain__upper": [2.0, 0.0, 1.0]}, ["domain", "(2.0, 0.0, 1.0)", "exceed"]),
        ({"release": []}, ["release", "[]", "at least 1"]),
        ({"release__0__upper": [3.0, 0.3, 1.0]}, ["release[0]", "3.0", "domain", "2.0"]),
        ({"release__0__velocity": [1.0, 0.0]}, ["release[0]", "(1.0, 0.0)", "3 numbers"]),
        ({"release__0__velocity": [1, 0, math.inf]}, ["release.0.velocity", "inf", "finite"]),
        ({"baffle__0__center": [1.97, 0.5]}, ["baffle[0]", "2.02", "leaves the domain"]),
        ({"baffle__0__size": [0.1, 1.5, 0.2]}, ["baffle[0]", "1.5", "leaves the domain"]),
        ({"baffle__0__size": [0.1, -0.3, 0.2]}, ["baffle.0", "-0.3", "positive"]),
        ({"baffle__0__size": [0.1, 0.3]}, ["baffle.0", "(0.1, 0.3)", "center needs 1"]),
        ({"baffle__0__center": [0.42, 0.5]}, ["baffle[0]", "0.37", "overlaps release[0]", "0.4"]),
        ({"section": 2.5}, ["section", "2.5", "inside the domain, 0 to 2"]),
        ({"placement__upper": [2.5, 1.0]}, ["placement", "2.5", "leaves the domain"]),
        ({"placement__upper": [0.5, 1.0]}, ["placement", "0.5", "exceed"]),
        ({"placement__gap": -0.1}, ["placement.gap", "-0.1", "or equal to 0"]),
        ({"placement__size": [0.1, 0.3]}, ["placement", "(0.1, 0.3)", "3 positive"]),
        ({"placement__keep_out": [[1.0, 0.2]]}, ["placement", "keep_out[0]", "(1.0, 0.2)", "4"]),
        ({"placement__lower": [0.6], "placement__upper": [1.8]}, ["placement", "0.6", "2 numbers"]),
    ],
)
def test_a_refusal_names_key_value_and_what_is_allowed(changes, fragments):
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(plain(**changes), source="my.toml")
    message = str(caught.value)
    assert message.startswith("my.toml: ")
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("key", ["domain", "release"])
def test_a_missing_key_is_named(key):
    values = plain()
    del values[key]
    with pytest.raises(SceneError, match=f"'{key}' is missing"):
        Scene.from_dict(values)


def test_overlaps_are_refused_and_touching_is_not():
    values = plain()
    values["baffle"].append({"center": [1.1, 0.5], "size": [0.1, 0.3, 0.2]})
    Scene.from_dict(values)
    values["baffle"][1]["center"] = [1.09, 0.5]
    with pytest.raises(SceneError, match=r"baffle\[1\].*overlaps baffle\[0\]"):
        Scene.from_dict(values)
    values = plain()
    values["release"].append({"lower": [0.4, 0, 0], "upper": [0.6, 0.3, 1], "velocity": [0, 0, 0]})
    Scene.from_dict(values)
    values["release"][1]["lower"] = [0.39, 0, 0]
    with pytest.raises(SceneError, match=r"release\[1\].*overlaps release\[0\]"):
        Scene.from_dict(values)


@pytest.mark.parametrize(
    ("content", "fragment"),
    [(b"duration = ", "not a TOML file"), (b"\xff\xfe\x00", "not a TOML file"), (b"", "missing")],
)
def test_a_malformed_file_is_named(tmp_path: Path, content: bytes, fragment: str):
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=fragment) as caught:
        Scene.from_toml(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(GnsError, match="cannot be read") as caught:
            Scene.from_toml(path)
        assert str(path) in str(caught.value)


def test_every_example_reads_and_round_trips(examples: Path):
    paths = sorted(examples.rglob("*.toml"))
    names = {p.relative_to(examples).as_posix() for p in paths}
    assert {"flume.toml", "flume_six.toml", "columns/a-0.5.toml"} <= names
    for path in paths:
        if "release" in tomllib.loads(path.read_text()):
            scene = Scene.from_toml(path)
            assert Scene.from_dict(tomllib.loads(scene.to_toml())) == scene


def test_the_flume_is_the_papers(flume: Scene):
    assert flume.domain.lower == (0.1, 0.1, 0.1)
    assert flume.domain.upper == (1.9, 0.9, 1.9)
    assert flume.releases[0].size == pytest.approx((0.35, 0.25, 1.4))
    assert flume.releases[0].velocity == (2.0, 0.0, 0.0)
    assert [b.center for b in flume.baffles] == [(0.775, 0.375), (0.775, 1.625), (1.275, 1.0)]
    assert {b.size for b in flume.baffles} == {(0.15, 0.30, 0.15)}
    assert flume.friction.base == pytest.approx(math.tan(math.radians(35)), abs=1e-3)
    np.testing.assert_allclose(flume.baffle_boxes()[0], [[0.7, 0.1, 0.3], [0.85, 0.4, 0.45]])


@pytest.mark.parametrize(
    ("name", "aspect", "height"),
    [("0.5", 0.5, 0.20), ("0.8", 0.8, 0.24), ("1.0", 1.0, 0.30), ("2.0", 2.0, 0.30),
     ("3.0", 3.0, 0.36), ("4.0", 4.0, 0.30), ("0.8-upscaled", 0.8, 0.36)],
)  # fmt: skip
def test_the_columns_are_the_papers(examples: Path, name: str, aspect: float, height: float):
    scene = Scene.from_toml(examples / "columns" / f"a-{name}.toml")
    (length, tall) = scene.releases[0].size
    assert tall == pytest.approx(height)
    assert tall / length == pytest.approx(aspect)
    assert scene.releases[0].lower == scene.domain.lower
    assert scene.material.cohesion == 100
    assert scene.material.tension_cutoff == 50


# -- laws ------------------------------------------------------------------------------------------

unit = st.floats(0.0, 1.0)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    dim = draw(st.sampled_from([2, 3]))
    number = st.floats(-50, 50)
    lower = [draw(number) for _ in range(dim)]
    size = [draw(st.floats(0.5, 5)) for _ in range(dim)]
    upper = [lo + s for lo, s in zip(lower, size, strict=True)]
    release = [lo + s * draw(st.floats(0.1, 0.3)) for lo, s in zip(lower, size, strict=True)]
    baffles = [
        {
            # Slots of a tenth of the domain, so that no two overlap.
            "center": [lower[0] + size[0] * (0.45 + 0.1 * k)]
            + [lo + s / 2 for lo, s in zip(lower[2:], size[2:], strict=True)],
            "size": [s * draw(st.floats(0.01, 0.09)) for s in size],
        }
        for k in range(draw(st.integers(0, 4)))
    ]
    values = {
        "name": draw(st.text(max_size=12)),
        "duration": draw(st.floats(1e-6, 1e6)),
        "domain": {"lower": lower, "upper": upper},
        "gravity": [draw(st.floats(-20, 20)) for _ in range(dim)],
        "friction": {"base": draw(unit), "walls": draw(unit), "baffles": draw(unit)},
        "material": {
            "density": draw(st.floats(1, 5000)),
            "youngs_modulus": draw(st.floats(1e3, 1e12)),
            "friction_angle": draw(st.floats(1, 60)),
            "cohesion": draw(st.floats(0, 1e5)),
        },
        "release": [
            {"lower": lower, "upper": release, "velocity": [draw(number) for _ in range(dim)]}
        ],
        "baffle": baffles,
    }
    if draw(st.booleans()):
        values["section"] = lower[0] + size[0] * draw(st.floats(0.1, 0.9))
    if draw(st.booleans()):
        plan = [0, *range(2, dim)]
        values["placement"] = {
            "lower": [lower[i] for i in plan],
            "upper": [upper[i] for i in plan],
            "gap": draw(unit),
            "size": [0.1] * dim,
            "keep_out": [[lower[i] for i in plan] + [upper[i] for i in plan]],
        }
    return Scene.from_dict(values)


@given(scenes())
def test_toml_and_dict_round_trip(scene: Scene):
    assert Scene.from_dict(tomllib.loads(scene.to_toml())) == scene
    assert Scene.from_dict(scene.to_dict()) == scene
    assert scene.replace() == scene
    assert hash(scene) == hash(scene.replace())


def test_file_round_trip(tmp_path: Path, flume: Scene):
    path = tmp_path / "deep" / "scene.toml"
    text = flume.to_toml(path)
    assert path.read_text() == text
    assert Scene.from_toml(path) == flume


@given(st.lists(st.tuples(st.floats(0.7, 1.7), st.floats(0.2, 1.7)), max_size=3))
def test_with_baffles_places_all_or_refuses(flume: Scene, centres: list[tuple[float, float]]):
    pairs = itertools.combinations(centres, 2)
    if any(max(abs(a[0] - b[0]), abs(a[1] - b[1])) < 0.15 - 1e-6 for a, b in pairs):
        with pytest.raises(SceneError, match="overlaps baffle"):
            flume.with_baffles(centres)
        return
    scene = flume.with_baffles(centres)
    assert [b.center for b in scene.baffles] == centres
    assert {b.size for b in scene.baffles} <= {(0.15, 0.30, 0.15)}
    # All else is as it was, and emptied scenes can be filled again.
    assert scene.with_baffles([b.center for b in flume.baffles]) == flume


def test_with_baffles_of_an_emptied_scene_without_placement_size(flume: Scene):
    bare = flume.replace(placement={"lower": (0.6, 0.1), "upper": (1.5, 1.9)})
    assert bare.with_baffles([]).with_baffles([[1.0, 1.0]]).baffles[0].size == (0.15, 0.30, 0.15)
    with pytest.raises(SceneError, match="which size"):
        flume.replace(placement=None).with_baffles([]).with_baffles([[1.0, 1.0]])


@pytest.mark.parametrize(
    ("centres", "fragment"),
    [
        ([[0.775]], r"shape \(n, 2\)"),
        ([0.775, 1.0], r"shape \(n, 2\)"),
        ([[math.nan, 1.0]], "finite"),
        ([[0.4, 1.0]], "overlaps release"),
        ([[1.0, 0.1]], "leaves the domain"),
        ([[1.0, 1.0], [1.1, 1.1]], r"overlaps baffle\[0\]"),
    ],
)
def test_with_baffles_refuses(flume: Scene, centres: list, fragment: str):
    with pytest.raises(SceneError, match=fragment):
        flume.with_baffles(centres)


def test_a_scene_is_frozen(flume: Scene):
    before = copy.deepcopy(flume)
    with pytest.raises(ValueError, match="frozen"):
        flume.duration = 3.0  # type: ignore[misc]
    assert flume == before


def test_write_whole_leaves_the_old_file_when_it_fails(tmp_path: Path):
    path = tmp_path / "file"
    write_whole(path, b"old")
    with pytest.raises(TypeError):
        write_whole(path, "not bytes")  # type: ignore[arg-type]
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
