from __future__ import annotations

import inspect
import json
from pathlib import Path

import pytest

from gns_model import console, paper
from gns_model.cli import app
from gns_model.learned import LearnedModel, ModelConfig
from gns_model.learned.checkpoint import save_model
from gns_model.learned.simulator import LearnedSimulator
from gns_model.mpm import MpmSimulator
from gns_model.mpm.torch_solver import TorchMpmSimulator
from gns_model.suites.command import simulator_options


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `gns-model evaluate ...`."""
    with pytest.raises(SystemExit) as left:
        console.main(app, "gns-model", ["evaluate", *map(str, arguments)])
    captured = capsys.readouterr()
    return int(left.value.code or 0), captured.out, captured.err


@pytest.fixture
def plane_model(tmp_path: Path) -> Path:
    """A checkpoint of a 2D model that was trained on short columns at 30 degrees."""
    config = ModelConfig(
        dim=2, spacing=0.05, radius=0.08, dt=0.05, latent=8, blocks=1,
        limits={"friction_angle": (30.0, 30.0), "release_height": 0.25},
    )  # fmt: skip
    return save_model(tmp_path / "plane-model", LearnedModel(config))


def test_one_suite_by_the_command_line(capsys, tmp_path: Path):
    code, out, err = run(
        capsys, "mpm", "--suite", "upscaled", "--out", tmp_path, "--spacing", 0.06, "--json",
        "--workers", 1, "--quiet",
    )  # fmt: skip
    assert code == 0, err
    report = json.loads(out)
    assert report["model"] == "mpm"
    (suite,) = report["suites"].values()
    assert suite["rows"][0]["runout_error"] == 0.0
    assert suite["aims"][0]["met"] is True
    assert json.loads((tmp_path / "results.json").read_text()) == report
    assert {file.name for file in tmp_path.iterdir()} == {
        "reference", "results.json", "upscaled.csv", "upscaled-curves.csv", "upscaled.png",
        "upscaled-frames.png",
    }  # fmt: skip


@pytest.mark.parametrize("model", ["mpm", "column-2d"])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_every_simulator_takes_the_options_of_the_command(model: str, device: str):
    simulators = {
        ("mpm", "cpu"): MpmSimulator,
        ("mpm", "cuda"): TorchMpmSimulator,
    }
    simulator = simulators.get((model, device), LearnedSimulator)
    options = simulator_options(model, device, 3, 0.02 if model == "mpm" else None)
    assert options.pop("device") == device
    taken = inspect.signature(simulator.__init__).parameters
    assert options.keys() <= taken.keys()
    assert ("threads" in options) == ("threads" in taken)  # --workers is heard where it can be
    assert ("spacing" in options) == (model == "mpm")


def test_tables_and_warnings_for_a_person(capsys, plane_model: Path, tmp_path: Path):
    arguments = ("--out", tmp_path, "--spacing", 0.06, "--workers", 1, "--quiet")
    code, out, err = run(capsys, plane_model, "--suite", "upscaled", *arguments, "--fillings", 0)
    assert code == 0, err
    assert "The up-scaled column: plane-model beside our MPM and the paper" in out
    assert "MISSED  runout error, up-scaled" in out
    assert f"tables and figures in {tmp_path}" in out
    (warning,) = (line for line in err.splitlines() if line.startswith("warning: "))
    assert "'column-upscaled' is outside what plane-model was trained on" in warning
    assert "release_height = 0.36" in warning


def test_means_of_eight_fillings_are_judged(capsys, plane_model: Path, tmp_path: Path):
    arguments = ("--out", tmp_path, "--spacing", 0.12, "--workers", 1, "--quiet")
    code, out, err = run(capsys, plane_model, "--suite", "upscaled", *arguments)
    assert code == 0, err
    assert "up-scaled, means of 8 fillings: " in out
    assert "jitter = 0.25, but trained on starts moved by 0 spacings" in err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["mpm"], "either --suite or --data"),
        (["mpm", "--suite", "columns", "--data", "."], "either --suite or --data"),
        (["mpm", "--suite", "columns"], "--out DIR"),
        (["mpm", "--suite", "colums", "--out", "x"], "colums"),
        (["mpm", "--suite", "columns", "--out", "x", "--spacing", "-1"], "--spacing"),
        (["baffle-lite", "--suite", "columns", "--out", "x"], "its scenes are 2D and baffle-lite"),
        (["no-such-model", "--suite", "columns", "--out", "x"], "no simulator named"),
        (["mpm", "--data", "no-such-folder"], "no trajectory files"),
        (["mpm", "--data", ".", "--fillings", "2"], "--fillings"),
        (["mpm", "--suite", "flume", "--out", "x", "--fillings", "2"], "--fillings"),
    ],
)
def test_bad_input_is_one_line(capsys, monkeypatch, tmp_path: Path, arguments, says):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *arguments, "--quiet")
    assert code == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1, err
    assert says in err
    assert not list(tmp_path.iterdir())


def test_a_plane_model_has_no_flume(capsys, plane_model: Path, tmp_path: Path):
    code, _, err = run(capsys, plane_model, "--suite", "flume", "--out", tmp_path / "x", "--quiet")
    assert code == 2
    assert "its scenes are 3D and plane-model is a 2D model" in err


def test_a_folder_of_trajectories_still_does(capsys, tmp_path: Path):
    scene = paper.column_scene(paper.COLUMNS[2]).replace(duration=0.3)
    solver = MpmSimulator(frame_interval=0.05)
    solver.rollout([scene])[0].save(tmp_path / "data" / "one.h5")
    out = tmp_path / "out"
    code, text, err = run(
        capsys, "mpm", "--data", tmp_path / "data", "--out", out, "--json", "--workers", 1,
        "--quiet",
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(text)
    assert result["scenes"] == 1
    assert result["aggregate"]["centroid_travel.error"] < 1e-3
    assert {file.name for file in out.iterdir()} == {
        "results.json", "results.csv", "scatter.png", "deposits.png",
    }  # fmt: skip
