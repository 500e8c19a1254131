from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from gns_model import measures, paper
from gns_model.errors import SceneError, SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.suites import flume, friction, registry, upscaled
from gns_model.suites.reference import FOLDER
from gns_model.suites.registry import SUITES, chosen, run_suite, run_suites
from gns_model.suites.result import Aim, SuiteResult
from gns_model.suites.setup import Setup, stride
from gns_model.trajectory import DIVERGED, OK, Trajectory

SPACING = 0.05


def read(file: Path) -> list[dict[str, str]]:
    with open(file, newline="") as opened:
        return list(csv.DictReader(opened))


def is_png(file: Path) -> bool:
    content = file.read_bytes()
    return content[:8] == b"\x89PNG\r\n\x1a\n" and content.endswith(b"IEND\xaeB`\x82")


@pytest.fixture(scope="module")
def solver_on_columns(shared: Path) -> SuiteResult:
    """The suite of the columns with the solver itself as the model."""
    return run_suite("columns", MpmSimulator(spacing=SPACING), Setup(shared, spacing=SPACING))


def test_the_solver_agrees_with_itself_on_columns(solver_on_columns: SuiteResult):
    rows = solver_on_columns.rows
    assert [row["aspect"] for row in rows] == [0.5, 0.8, 1.0, 2.0, 3.0, 4.0]
    for row in rows:
        assert row["runout_error"] == 0.0
        assert row["position_mse"] == row["position_mse_peak"] == 0.0
        assert row["points"] == row["points_mpm"]
        assert row["status"] == "ok"
    assert [aim.value for aim in solver_on_columns.aims] == [0.0, 0.0]
    assert all(aim.met for aim in solver_on_columns.aims)
    # The paper's own errors, which stand beside ours.
    assert rows[3]["paper_error"] == pytest.approx(3.682 / 3.892 - 1)


def test_columns_leave_tables_and_figures(solver_on_columns: SuiteResult, shared: Path):
    for name in solver_on_columns.files:
        file = shared / name
        assert is_png(file) if name.endswith(".png") else file.stat().st_size > 100, name
    table = read(shared / "columns.csv")
    for row, written in zip(solver_on_columns.rows, table, strict=True):
        assert float(written["runout_mpm"]) == row["runout_mpm"]
    curves = read(shared / "columns-curves.csv")
    assert len(curves) == 6 * 101
    for row in solver_on_columns.rows:
        mine = [r for r in curves if float(r["aspect"]) == row["aspect"]]
        assert float(mine[-1]["runout"]) == pytest.approx(row["runout"])
        assert float(mine[-1]["height_mpm"]) == pytest.approx(row["height_mpm"])
        tau = np.sqrt(row["height_0"] / 9.81)
        assert float(mine[-1]["t_over_tau"]) == pytest.approx(1.0 / tau)
        for who in ("", "_mpm"):
            shares = [float(mine[50][f"{e}{who}"]) for e in ("potential", "kinetic", "dissipated")]
            assert sum(shares) == pytest.approx(1.0)


def test_a_learned_model_is_measured_as_by_hand(tiny, shared: Path):
    simulator = tiny()
    result = upscaled.run(simulator, Setup(shared, spacing=SPACING))
    scene = paper.column_scene(paper.UPSCALED).replace(duration=1.25)
    ours = simulator.rollout([scene])[0]
    theirs = MpmSimulator(spacing=SPACING, frame_interval=0.02).rollout([scene])[0]
    row = result.rows[0]
    assert row["case"] == "up-scaled"
    assert row["runout"] == pytest.approx(measures.normalised_runout(ours))
    assert row["runout_mpm"] == pytest.approx(measures.normalised_runout(theirs))
    assert row["runout_error"] == pytest.approx(row["runout"] / row["runout_mpm"] - 1)
    mse = measures.position_error(ours, theirs)
    assert row["position_mse"] == pytest.approx(mse[-1], rel=1e-5)
    assert row["position_mse_peak"] == pytest.approx(mse.max(), rel=1e-5)
    # A net of random weights is no simulator, and the suite says so.
    (aim,) = result.aims
    assert aim.value == abs(row["runout_error"])
    assert aim.value > upscaled.RUNOUT_AIM
    assert not aim.met
    assert result.facts["mass_ratio"] == pytest.approx(2.25)
    assert is_png(shared / "upscaled.png")
    assert is_png(shared / "upscaled-frames.png")
    assert len(result.curves["upscaled-curves"]) == 63 + 51


def test_friction_is_answered_by_the_solver_and_not_by_a_blind_model(tiny, shared: Path):
    setup = Setup(shared, spacing=SPACING)
    blind = friction.run(tiny(), setup)
    assert [(row["friction_angle"], row["aspect"]) for row in blind.rows] == [
        (angle, aspect) for angle in paper.FRICTION_ANGLES for aspect in friction.ASPECTS
    ]
    first = blind.rows[:3]
    for row, like in zip(blind.rows, first * 5, strict=True):
        assert row["runout"] == pytest.approx(like["runout"])
    assert blind.facts["runout_falls_with_friction"] is False
    assert any("does not see the friction angle" in note for note in blind.notes)
    short = [row["runout_mpm"] for row in blind.rows if row["aspect"] == 1.0]
    assert short[0] > 1.5 * short[-1]
    assert is_png(shared / "friction.png")


def test_a_model_with_the_material_feature_sees_friction(tiny, shared: Path):
    seeing = tiny(material_features=("tan_friction_angle",))
    assert friction.blind(seeing) is None
    assert friction.blind(MpmSimulator()) is None
    rows = friction.run(seeing, Setup(shared, spacing=SPACING)).rows
    runouts = [row["runout"] for row in rows if row["aspect"] == 2.0]
    assert len(set(runouts)) == len(runouts)


def test_no_flow_of_the_friction_suite_reaches_the_wall():
    """In the paper's box of 1 m the front at 15 degrees would, and would say nothing."""
    column = next(c for c in paper.COLUMNS if c.aspect == 1.0)
    scene = paper.column_scene(column, friction_angle=15.0)
    solver = MpmSimulator(spacing=0.025, frame_interval=0.1)
    short, long = solver.rollout(
        [scene, scene.replace(domain={"lower": (0.0, 0.0), "upper": friction.DOMAIN})]
    )
    fronts = [measures.front_over_time(trajectory)[-1] for trajectory in (short, long)]
    assert fronts[0] > 0.95
    assert 1.05 < fronts[1] < friction.DOMAIN[0] - 0.1


@pytest.fixture
def short_flume(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """The flume for the half second in which it meets both rows."""
    scene = paper.flume_scene().replace(duration=0.5)
    monkeypatch.setattr(paper, "flume_scene", lambda: scene)
    return scene


def test_the_flume_of_the_solver_and_of_a_coarser_one(short_flume, tmp_path: Path):
    setup = Setup(tmp_path, spacing=0.05)
    same = flume.run(MpmSimulator(spacing=0.05), setup)
    assert all(row["error"] == row["most_off"] == 0.0 for row in same.rows)
    assert [aim.met for aim in same.aims] == [True] * 5
    assert same.facts["points_inside_baffles"] == 0
    assert same.facts["row_1_arrival"] < same.facts["row_2_arrival"]
    assert is_png(tmp_path / "flume.png")
    assert is_png(tmp_path / "flume-frames.png")
    coarse = flume.run(MpmSimulator(spacing=0.0625), setup)
    rows = {row["measure"]: row for row in coarse.rows}
    assert rows["centroid"]["mpm"] == {r["measure"]: r for r in same.rows}["centroid"]["mpm"]
    assert 0 < abs(rows["centroid"]["error"]) < 0.2
    assert rows["depth row 1"]["mpm"] > rows["depth row 2"]["mpm"] > 0
    assert rows["dissipated energy"]["learned"] == pytest.approx(
        1
        - rows["potential energy"]["learned"]
        - float(coarse.curves["flume-curves"][-1]["kinetic"])
    )
    assert len(list((tmp_path / FOLDER).iterdir())) == 1


def test_a_rollout_that_diverges_misses_its_aims(shared: Path):
    class Broken(MpmSimulator):
        def rollout(self, scenes, *, progress=None) -> list[Trajectory]:
            trajectories = super().rollout(scenes, progress=progress)
            trajectories[0].status = DIVERGED
            return trajectories

    result = upscaled.run(Broken(spacing=SPACING), Setup(shared, spacing=SPACING))
    assert [row["status"] for row in result.rows] == [DIVERGED, OK]
    assert result.rows[0]["runout_error"] == 0.0
    assert [aim.met for aim in result.aims] == [False]
    assert "not measured" in str(result.aims[0])


def test_aims():
    assert Aim("x", 0.05, 0.05).met
    assert not Aim("x", 0.051, 0.05).met
    assert not Aim("x", None, 0.05).met
    assert str(Aim("x", 0.021, 0.05)) == "met     x: 2.1%, aim 5%"


def test_stride_of_a_simulator(tiny):
    assert stride(tiny()) == 0.02
    assert stride(MpmSimulator(frame_interval=0.03)) == 0.03


# -- which suites ----------------------------------------------------------------------------------


def test_all_means_those_that_fit(tiny):
    names, left_out = chosen("all", tiny())
    assert names == ["columns", "upscaled", "speed", "training"]
    assert "does not see the friction angle" in left_out["friction"]
    assert "its scenes are 3D and tiny is a 2D model" in left_out["flume"]
    names, left_out = chosen("all", tiny(3))
    assert names == ["flume", "speed", "training"]
    assert set(left_out) == {"columns", "upscaled", "friction"}
    assert chosen("all", MpmSimulator()) == (list(SUITES), {})


def test_suites_that_do_not_fit_are_refused(tiny, tmp_path: Path):
    with pytest.raises(SimulatorError, match="'columns' does not fit: its scenes are 2D"):
        run_suites(tiny(3), "columns", Setup(tmp_path))
    with pytest.raises(SimulatorError, match="no suite named 'colums': give columns, "):
        run_suites(tiny(), "colums", Setup(tmp_path))
    # Asked for by name, a suite that can say little still runs.
    assert chosen("friction", tiny()) == (["friction"], {})


@pytest.fixture
def quick_suites(monkeypatch: pytest.MonkeyPatch) -> None:
    """Suites that cost nothing: one that works and one that its simulator cannot run."""

    def works(simulator, setup: Setup) -> SuiteResult:
        rows = [{"n": 1, "gone": float("nan")}]
        return SuiteResult("speed", "Speed", rows, (("n", "n", "d"),))

    def fails(simulator, setup: Setup) -> SuiteResult:
        raise SceneError("release[0] is thinner than the spacing")

    monkeypatch.setattr(
        registry, "SUITES", {"columns": registry.Suite(fails), "speed": registry.Suite(works)}
    )


def test_all_goes_on_where_one_suite_cannot_run(quick_suites, tiny, tmp_path: Path):
    seen: list[SuiteResult] = []
    report = run_suites(tiny(), "all", Setup(tmp_path), finished=seen.append)
    assert [result.suite for result in seen] == ["speed"]
    assert report["left_out"] == {"columns": "release[0] is thinner than the spacing"}
    assert report["suites"]["speed"]["rows"] == [{"n": 1, "gone": None}]
    assert json.loads((tmp_path / registry.RESULTS).read_text())["model"] == "tiny"
    with pytest.raises(SceneError):
        run_suites(tiny(), "columns", Setup(tmp_path))


def test_results_keep_earlier_suites_of_the_same_model_only(quick_suites, tiny, tmp_path: Path):
    file = tmp_path / registry.RESULTS
    run_suites(tiny(), "speed", Setup(tmp_path))
    content = json.loads(file.read_text())
    content["suites"]["flume"] = {"rows": []}
    file.write_text(json.dumps(content))
    run_suites(tiny(), "speed", Setup(tmp_path))
    assert set(json.loads(file.read_text())["suites"]) == {"speed", "flume"}
    other = tiny()
    other.name = "other"
    run_suites(other, "speed", Setup(tmp_path))
    assert set(json.loads(file.read_text())["suites"]) == {"speed"}
    file.write_text("{")
    run_suites(other, "speed", Setup(tmp_path))
    assert set(json.loads(file.read_text())["suites"]) == {"speed"}
