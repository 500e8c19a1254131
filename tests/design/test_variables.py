"""The options that free and limit a layout: what is refused, and a run on the coarse solver."""

import csv
import json

import numpy as np
import pytest

from design.results import RunResults
from design.run import optimise
from design.settings import Settings
from design.storage import StudyError
from gns_model.errors import GnsError
from gns_model.scene import Scene

from .short_runs import COARSE
from .test_cli import refused


@pytest.fixture
def scene_file(small_flume, tmp_path):
    """The small flume as a file."""
    path = tmp_path / "small.toml"
    small_flume.replace(duration=0.2).to_toml(path)
    return path


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--vary", "width=1:2"], "one of along, height, across, yaw"),
        (["--vary", "height=tall"], "range low:high"),
        (["--number", "2:x"], "range low:high"),
        (["--number", "4:2"], "lowest first"),
        (["--pattern", "ring"], "free or rows"),
        (["--pattern", "rows", "--method", "hybrid"], "keeps no rows"),
        (["--baffle-cost", "-1"], "0 or more"),
        (["--freeboard", "-0.1"], "freeboard"),
        (["--objectives", "runout,depth", "--baffle-cost", "0.1"], "one objective"),
        (["--max-volume", "0.001"], "max_volume of 0.001 is to blame"),
        (["--vary", "height=0.5:0.6", "--max-height", "0.4"], "max_height is to blame"),
        (["--number", "3:5", "--max-volume", "0.001"], "max_volume is to blame"),
        (["--wall-gap", "0.6"], "wall_gap of 0.6 m is to blame"),
    ],
)
def test_what_cannot_be_is_one_line_and_leaves_no_run(
    scene_file,
    tmp_path,
    capsys,
    options,
    said,
):
    out = tmp_path / "run"
    line = refused(capsys, "optimize", scene_file, *options, "--out", out)
    assert said in line
    assert not out.exists()


@pytest.fixture(scope="module")
def done(small_flume, tmp_path_factory):
    """Rows of two or three baffles of a height to be found, and a limit that nobody keeps."""
    out = tmp_path_factory.mktemp("run") / "freed"
    settings = Settings(
        method="random", pattern="rows", budget=7, verify=1, batch=7, workers=1,
        simulator=COARSE, verifier=COARSE, baffle_cost=0.02,
        placement={
            "max_volume": 0.016, "freeboard": 0.29,
            "vary": {"height": (0.15, 0.3), "number": (2, 3)},
        },
    )  # fmt: skip
    scene = small_flume.replace(duration=0.2)
    return scene, out, settings, optimise(scene, out, settings)


def test_a_run_says_what_it_chose_and_what_it_keeps(done):
    _, out, _, summary = done
    best = summary["best"]
    saved = Scene.from_toml(out / "layouts" / "best.toml")
    np.testing.assert_allclose([b.center for b in saved.baffles], best["layout"], atol=1e-6)
    assert {b.size for b in saved.baffles} == {saved.baffles[0].size}
    assert list(saved.baffles[0].size) == pytest.approx(best["size"], abs=1e-6)
    constraints = {c["name"]: c for c in summary["constraints"]}
    assert constraints["max_volume"]["holds"]
    height = best["size"][1]
    assert constraints["freeboard"]["value"] == pytest.approx(
        height - best["verified"]["upstream_depth"], abs=1e-6
    )
    assert not constraints["freeboard"]["holds"]
    assert constraints["freeboard"]["by"] == "solver"
    assert summary["verdict"] == "infeasible"
    assert any("freeboard is to blame" in note for note in summary["notes"])
    with (out / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    numbers = {sum(bool(row[f"x{k}"]) for k in (1, 2, 3)) for row in rows}
    assert numbers <= {2, 3}
    assert all(0.15 <= float(row["height"]) <= 0.3 for row in rows)
    assert json.loads((out / "summary.json").read_text()) == summary


def test_its_page_shows_the_form_and_the_constraint_that_is_broken(done):
    _, out, _, summary = done
    page = (out / "report.html").read_text()
    assert "What it has to keep" in page
    assert "breaks a limit" in page
    assert f"{summary['best']['size'][1]:.4g} m high" in page
    (out / "summary.json").rename(out / "kept.json")
    try:
        again = RunResults(out)  # of a run without its summary, the trials tell the form
        best = again.design("best")
        assert 0.15 <= best.size[1] <= 0.3
        assert len(best.placed(again.scene).baffles) in (2, 3)
    finally:
        (out / "kept.json").rename(out / "summary.json")


def test_a_study_of_other_variables_is_refused_on_resume(done):
    scene, out, settings, summary = done
    other = {**settings.placement, "vary": {"height": (0.15, 0.25), "number": (2, 3)}}
    for change in ({"placement": other}, {"pattern": "free"}, {"baffle_cost": 0.0}):
        values = {**vars(settings), "resume": True, **change}
        with pytest.raises((StudyError, GnsError), match="another"):
            optimise(scene, out, Settings(**values))
    assert json.loads((out / "summary.json").read_text()) == summary
