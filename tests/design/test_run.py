"""Whole runs on real simulators: the coarse solver and a learned simulator with random weights."""

import csv
import json

import numpy as np
import pytest

from design import run as run_module
from design.evaluators import InWorkers, SimulatorSpec
from design.measure import measure
from design.run import optimise
from design.settings import SettingError, Settings
from design.storage import StudyError
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError, SimulatorError
from gns_model.measures import UNITS
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

from .short_runs import COARSE, short_flume, tiny_model

FINER = SimulatorSpec("mpm", options=(("spacing", 0.05),))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return short_flume()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A tiny learned simulator that has learnt nothing."""
    return tiny_model(tmp_path_factory.mktemp("model") / "tiny")


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    """A run of the coarse solver, verified by a finer one."""
    out = tmp_path_factory.mktemp("run") / "coarse"
    settings = Settings(budget=14, verify=2, simulator=COARSE, verifier=FINER, workers=2)
    return out, optimise(scene, out, settings, command=["gns-design", "optimize"])


def test_a_run_leaves_everything_that_was_promised(done, scene):
    out, summary = done
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert {
        "summary.json", "scene.toml", "trials.csv", "study.db", "report.html", "layouts/best.toml",
        "layouts/rank-2.toml", "layouts/best.stl", "layouts/best.glb",
    } <= names  # fmt: skip
    assert {
        f"trajectories/{layout}-{role}.h5"
        for layout in ("best", "paper", "none")
        for role in ("mpm", "learned")
    } <= names
    assert not [n for n in names if n.split("/")[-1].startswith(".")]  # no temporary file
    assert json.loads((out / "summary.json").read_text()) == summary
    assert summary["status"] == "complete"
    assert Scene.from_toml(out / "scene.toml") == scene


def test_its_summary_is_that_of_its_trajectories(done, scene):
    out, summary = done
    assert set(summary["best"]["verified"]) == set(summary["best"]["surrogate"]) == set(UNITS)
    for key in ("paper_layout", "no_baffles"):
        assert set(UNITS) <= set(summary[key])
    best = Trajectory.load(out / "trajectories" / "best-mpm.h5")
    assert best.settings["spacing"] == 0.05
    layout = np.array([b.center for b in best.scene.baffles])
    np.testing.assert_allclose(layout, summary["best"]["layout"], atol=1e-6)
    saved = Scene.from_toml(out / "layouts" / "best.toml")
    np.testing.assert_allclose([b.center for b in saved.baffles], layout, atol=1e-9)
    again = measure(saved, FINER)
    assert again["measures"] == pytest.approx(summary["best"]["verified"], rel=1e-9)
    assert again["no_baffles"]["centroid_travel"] == summary["no_baffles"]["centroid_travel"]
    assert again["cost"] == pytest.approx(summary["best"]["verified_cost"])
    paper = Trajectory.load(out / "trajectories" / "paper-learned.h5")
    assert [b.center for b in paper.scene.baffles] == [b.center for b in scene.baffles]
    assert Trajectory.load(out / "trajectories" / "none-mpm.h5").scene.baffles == ()


def test_its_best_is_the_best_verified_and_its_verdict_true(done):
    summary = done[1]
    costs = [entry["verified_cost"] for entry in summary["ranked"]]
    assert len(costs) == 2
    assert costs == sorted(costs)
    assert summary["ranked"][0] == summary["best"]
    better = summary["best"]["verified_cost"] < summary["paper_layout"]["verified_cost"]
    assert summary["verdict"] == ("better" if better else "not better")
    assert better  # the scene's own layout stands far downstream and at the walls
    assert summary["gap"]["cost"]["spearman"] is not None


def test_all_its_trials_are_buildable_and_counted(done, scene):
    out, summary = done
    with (out / "trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == summary["rollouts"] == 14
    assert summary["backwards"] == 0
    assert {"scene", "row", "staggered", "bayes"} == {row["origin"] for row in rows}
    space = LayoutSpace(scene, 2)
    for row in rows:
        centres = [[float(row[f"x{k}"]), float(row[f"z{k}"])] for k in (1, 2)]
        assert space.check(centres) == []
        assert row["status"] == "ok"


def test_a_rerun_reuses_what_was_simulated_and_goes_on(done, scene, monkeypatch, no_report):
    out, before = done
    started = []

    class Counting(run_module.RolloutStore):
        def start(self, spec, scene, **options):
            pending = super().start(spec, scene, **options)
            started.append(pending.job is not None)
            return pending

    monkeypatch.setattr(run_module, "RolloutStore", Counting)
    with pytest.raises(StudyError, match="--resume"):
        optimise(scene, out, Settings(simulator=COARSE, verifier=FINER, workers=1))
    same = Settings(budget=14, verify=2, simulator=COARSE, verifier=FINER, workers=1, resume=True)
    again = optimise(scene, out, same)
    assert len(started) == 8
    assert not any(started)
    for key in ("best", "paper_layout", "no_baffles", "ranked", "rollouts", "gap"):
        assert again[key] == before[key]
    more = Settings(budget=18, verify=2, simulator=COARSE, verifier=FINER, workers=1, resume=True)
    assert optimise(scene, out, more)["rollouts"] == 18


def test_another_task_is_not_mixed_into_a_run(done, scene):
    other = scene.replace(duration=0.25)
    settings = Settings(budget=2, verify=0, simulator=COARSE, workers=1, resume=True)
    with pytest.raises(StudyError, match="another scene"):
        optimise(other, done[0], settings)
    with pytest.raises(StudyError, match="another simulator"):
        optimise(scene, done[0], Settings(simulator=FINER, verifier=FINER, workers=1, resume=True))


@pytest.mark.slow
def test_the_hybrid_search_on_a_learned_simulator(scene, checkpoint, tmp_path, no_report):
    settings = Settings(
        budget=20, verify=1, simulator=SimulatorSpec(str(checkpoint)), verifier=COARSE, workers=1
    )
    summary = optimise(scene, tmp_path, settings)
    assert summary["settings"]["method"] == "hybrid"
    assert summary["backwards"] >= 1
    assert summary["rollouts"] + summary["backwards"] in (19, 20)
    assert summary["settings"]["simulator"]["weights"]
    assert Trajectory.load(tmp_path / "trajectories" / "best-learned.h5").simulator == "tiny"


def test_a_device_runs_batches_in_this_process(scene, checkpoint, tmp_path, no_report):
    # "cpu:0" takes the way of a GPU: one process, whole batches.
    spec = SimulatorSpec(str(checkpoint), device="cpu:0")
    settings = Settings(budget=10, verify=0, simulator=spec, workers=1)
    summary = optimise(scene, tmp_path, settings)
    assert summary["rollouts"] + summary["backwards"] in (9, 10)
    alone = SimulatorSpec(str(checkpoint))
    again = measure(Scene.from_toml(tmp_path / "layouts" / "best.toml"), alone)
    expected = summary["best"]["surrogate"]["centroid_travel"]
    assert again["measures"]["centroid_travel"] == pytest.approx(expected, rel=1e-3)


def test_an_interrupt_leaves_a_summary_and_the_next_run_goes_on(
    scene, tmp_path, monkeypatch, no_report
):
    evaluate = InWorkers.evaluate
    calls = []

    def stop_in_the_second_batch(self, layouts):
        calls.append(len(layouts))
        for n, result in enumerate(evaluate(self, layouts)):
            if len(calls) == 2 and n == 2:
                raise KeyboardInterrupt
            yield result

    settings = Settings(budget=14, verify=1, simulator=COARSE, verifier=COARSE, workers=1, batch=6)
    with monkeypatch.context() as patched:
        patched.setattr(InWorkers, "evaluate", stop_in_the_second_batch)
        with pytest.raises(KeyboardInterrupt):
            optimise(scene, tmp_path, settings)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert summary["rollouts"] == 1 + 6 + 2  # the own layout, a batch, and two of the next
    assert summary["best"]["verified"] is None
    assert (tmp_path / "layouts" / "best.toml").exists()
    resumed = optimise(scene, tmp_path, Settings(**{**vars(settings), "resume": True}))
    assert resumed["status"] == "complete"
    assert resumed["rollouts"] == 14


def test_no_verification_is_said_plainly(plane_scene, tmp_path, no_report):
    plane = SimulatorSpec("mpm", options=(("spacing", 0.025),))
    settings = Settings(baffles=2, budget=5, verify=0, simulator=plane, workers=1)
    summary = optimise(plane_scene, tmp_path, settings)
    assert summary["verdict"] == "unverified"
    assert summary["best"]["verified"] is None
    assert np.shape(summary["best"]["layout"]) == (2, 1)
    assert not list((tmp_path / "trajectories").glob("*-mpm.h5"))


def test_what_cannot_be_is_refused_before_anything_is_written(scene, checkpoint, tmp_path):
    out = tmp_path / "run"
    with pytest.raises(LayoutError):
        optimise(scene, out, Settings(baffles=60, simulator=COARSE))
    with pytest.raises(SimulatorError, match="no gradient"):
        optimise(scene, out, Settings(method="gradient", simulator=COARSE, verifier=COARSE))
    with pytest.raises(SimulatorError):
        optimise(scene, out, Settings(simulator=SimulatorSpec("no-such-model")))
    for wrong in ({"budget": 0}, {"verify": -1}, {"workers": 0}, {"method": "guess"}):
        with pytest.raises(SettingError):
            Settings(**wrong)
    assert not out.exists()


def test_measuring_a_scene_without_baffles_is_relative_to_itself(scene):
    result = measure(scene.with_baffles([]), COARSE)
    assert result["measures"] == result["no_baffles"]
    assert result["cost"] == pytest.approx(result["cost_no_baffles"])
    assert result["baffles"] == 0
