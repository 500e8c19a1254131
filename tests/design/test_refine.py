"""A whole run with `--refine`, on the coarse solver and a tiny model, and what it refuses."""

import json
import os
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from design import lessons
from design.evaluators import SimulatorSpec
from design.run import Run, optimise
from design.settings import SettingError, Settings
from gns_model.errors import FileFormatError, SimulatorError
from gns_model.learned.checkpoint import load_model, read_card
from gns_model.scene import Scene
from gns_model.training.state import read_position

from .short_runs import COARSE, baffle_at, short_flume, tiny_model


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The short flume, shorter still, with one baffle."""
    return short_flume(
        duration=0.2,
        section=0.6,
        domain={"lower": [0.1, 0.1, 0.1], "upper": [1.3, 0.7, 0.9]},
        release=[{"lower": [0.1, 0.1, 0.2], "upper": [0.4, 0.3, 0.7], "velocity": [2, 0, 0]}],
        baffle=[baffle_at(0.9, 0.5)],
        placement={"lower": [0.45, 0.1], "upper": [1.2, 0.9], "gap": 0.1},
    )


tiny = partial(tiny_model, dt=0.02, limits={"max_speed": 1.0})


@pytest.fixture(scope="module")
def refined(scene, tmp_path_factory):
    """A run with one short round, and a second member that its model's card names."""
    place = tmp_path_factory.mktemp("refine")
    tiny(place / "other", seed=1)
    model = tiny(place / "tiny", ensemble=["../other"], ensemble_limits={"cost": 0.0})
    settings = Settings(
        method="random",
        budget=5,
        verify=2,
        simulator=SimulatorSpec(str(model)),
        verifier=COARSE,
        workers=1,
        refine=1,
        refine_minutes=0.05,
    )
    out = place / "run"
    real = lessons.launch

    def with_ctrl_c(file, folder, ranks, *, log, watch):
        def watch_and_stop():
            watch()
            if (folder / "recipe.json").exists() and not stopped:
                stopped.append(True)
                os.kill(os.getpid(), signal.SIGINT)

        return real(file, folder, ranks, log=log, watch=watch_and_stop)

    stopped: list[bool] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("design.report.write_report", lambda folder: None)  # seconds of pictures
        patch.setattr(lessons, "launch", with_ctrl_c)
        with pytest.raises(KeyboardInterrupt):
            optimise(scene, out, settings)
        interrupted = json.loads((out / "summary.json").read_text())
        trained = read_position(out / "refined-1" / "training" / "state.safetensors")
        patch.setattr(lessons, "launch", real)
        summary = optimise(scene, out, replace(settings, resume=True))
    return SimpleNamespace(
        out=out, settings=settings, summary=summary, interrupted=interrupted, trained=trained
    )


def test_ctrl_c_in_training_keeps_what_there_is_and_resume_goes_on(refined):
    assert refined.interrupted["status"] == "interrupted"
    known = [e for e in refined.interrupted["ranked"] if e["verified_cost"] is not None]
    assert len(known) == 2
    assert refined.trained.seconds < 60 * refined.settings.refine_minutes
    after = refined.summary["refined"][0]
    assert after["minutes"] >= refined.settings.refine_minutes
    assert after["steps"] > refined.trained.step
    first = [e for e in refined.summary["ranked"] if not e.get("model")]
    assert first == known


def test_the_refined_model_is_a_checkpoint_that_says_what_it_learnt(refined, scene):
    out, settings, summary = refined.out, refined.settings, refined.summary
    card = read_card(out / "refined-1")
    assert card["refined"]["from"] == settings.simulator.describe()
    taught = card["refined"]["layouts"]
    assert len(taught) == 4  # two verified, the scene's own, no baffles
    first = [e["layout"] for e in summary["ranked"] if not e.get("model")]
    assert sorted(taught) == sorted([*first, [[0.9, 0.5]], []])
    before = load_model(settings.simulator.name).model.state_dict()
    model = load_model(out / "refined-1").model
    assert any(not torch.equal(v, before[k]) for k, v in model.state_dict().items())
    for name, value in model.named_buffers():  # scales stay what it was trained with
        assert torch.equal(value, before[name])
    assert model.config.limits.max_speed == 2.0  # wider by what it has seen
    assert not (out / "refined-1" / "lessons").exists()


def test_a_round_searches_from_the_verified_and_verifies_new_layouts(refined):
    out, summary = refined.out, refined.summary
    inner = json.loads((out / "refined-1" / "summary.json").read_text())
    assert inner["status"] == summary["status"] == "complete"
    trials = (out / "refined-1" / "trials.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in trials[1:4]] == ["scene", "verified", "verified"]
    assert len(summary["ranked"]) == 4
    found = [e for e in summary["ranked"] if e.get("model") == "refined-1"]
    assert len(found) == 2
    assert len({json.dumps(e["layout"]) for e in summary["ranked"]}) == 4
    costs = [e["verified_cost"] for e in summary["ranked"]]
    assert costs == sorted(costs)
    assert summary["best"] == summary["ranked"][0]


def test_the_gap_is_told_apart_for_taught_and_for_new_layouts(refined):
    summary = refined.summary
    (told,) = summary["refined"]
    assert told["same"]["layouts"] == 3
    assert told["new"]["layouts"] == 2
    for part in ("same", "new"):
        for when in ("before", "after"):
            assert told[part][when]["centroid_travel"]["mean_relative"] >= 0
    # Before: what summary.json says of the layouts that the given model had found.
    first = [e for e in summary["ranked"] if not e.get("model")] + [summary["paper_layout"]]
    gaps = [abs(e["cost"] - e["verified_cost"]) / e["verified_cost"] for e in first]
    assert told["same"]["before"]["cost"]["mean_relative"] == pytest.approx(np.mean(gaps))
    assert told["same"]["before"] != told["same"]["after"]
    assert told["new"]["before"] != told["new"]["after"]
    assert told["steps"] > 0
    assert any(f"trained for {told['steps']} steps only" in note for note in summary["notes"])
    assert summary["rollouts"] == 5 + told["rollouts"]


def test_the_ensemble_judges_what_is_verified(refined):
    settings, summary = refined.settings, refined.summary
    members = summary["ensemble"]["members"]
    assert members[0] == settings.simulator.name
    assert members[1].endswith("/other")
    assert "spread" in summary["paper_layout"]
    for entry in summary["ranked"]:
        assert 0 < entry["spread"]["cost"] < 1
        assert "objective" in entry["marks"][0]  # the limit on the card is 0
        # The refined model has been trained on this speed, the other one has not.
        assert any("max_speed" in mark for mark in entry["marks"]) == ("model" not in entry)


def test_a_resumed_run_trains_and_simulates_nothing_again(refined, scene, monkeypatch, no_report):
    out, settings, before = refined.out, refined.settings, refined.summary
    monkeypatch.setattr(lessons, "launch", lambda *a, **k: pytest.fail("trained again"))

    def written():
        return {p.name: p.stat().st_mtime_ns for p in (out / "rollouts").iterdir()}

    rolled = written()
    again = optimise(scene, out, replace(settings, resume=True))
    assert written() == rolled
    assert again["ranked"] == before["ranked"]
    assert again["refined"] == before["refined"]


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"simulator": COARSE}, SimulatorError, "only a learned model"),
        ({"verifier": SimulatorSpec("mpm", options=(("spacing", 0.05),))}, SimulatorError, "0.05"),
        ({"refine_data": Path("no/such/folder")}, FileFormatError, "no trajectory files"),
        ({"ensemble": ("nobody",)}, SimulatorError, "nobody"),
        ({"ensemble": ("column-2d",)}, SimulatorError, "2D model"),
        ({"ensemble": ("mpm",)}, SimulatorError, "of learned models"),
    ],
)
def test_what_cannot_be_refined_or_judged_is_refused_at_once(
    changes, error, words, scene, tmp_path
):
    model = tiny(tmp_path / "tiny")
    settings = {"simulator": SimulatorSpec(str(model)), "verifier": COARSE, "refine": 1, **changes}
    with pytest.raises(error, match=words):
        Run(scene, tmp_path / "run", Settings(**settings))
    assert not (tmp_path / "run").exists()


def test_settings_of_a_refinement_are_checked():
    with pytest.raises(SettingError, match="verify must be 1"):
        Settings(refine=1, verify=0)
    with pytest.raises(SettingError, match="one objective"):
        Settings(refine=1, objectives=("runout", "depth"))
    with pytest.raises(SettingError, match="refine_minutes"):
        Settings(refine=1, refine_minutes=0.0)


def test_half_of_the_training_is_on_what_must_not_be_forgotten(scene, tmp_path):
    model = SimulatorSpec(str(tiny(tmp_path / "tiny")))
    old = tmp_path / "old"
    old.mkdir()
    for k in range(12):
        (old / f"{k}.h5").touch()
    lesson = lessons.Lesson(tmp_path / "refined-1", model, (), ())
    recipe = lessons.recipe_of(lesson, [scene] * 4, minutes=1.0, data=old)
    assert recipe.train == (str(tmp_path / "refined-1" / "lessons"),) * 3 + (str(old),)
    assert recipe.flow_share == 1
    assert recipe.flow_steps == 10  # to the end of the flow
    with pytest.raises(FileFormatError, match="no trajectory files"):
        lessons.recipe_of(lesson, [scene], minutes=1.0, data=tmp_path / "tiny")
