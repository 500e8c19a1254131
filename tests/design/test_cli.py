"""The command as a user runs it: what it prints, what it leaves, how it ends."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from design.cli import app
from gns_model import console
from gns_model.measures import UNITS
from gns_model.scene import Scene

COMMAND = [sys.executable, "-m", "design.cli"]
ROOT = Path(__file__).parents[2]
COARSE = ["--simulator", "mpm", "--spacing", "0.0625", "--verify-spacing", "0.0625"]


@pytest.fixture
def scene_file(small_flume: Scene, tmp_path: Path) -> Path:
    """The small flume as a file."""
    path = tmp_path / "small.toml"
    small_flume.replace(duration=0.2).to_toml(path)
    return path


def refused(capsys, *arguments: object) -> str:
    """The one line with which the command refuses `arguments`."""
    with pytest.raises(SystemExit) as left:
        console.main(app, "gns-design", [str(a) for a in arguments])
    captured = capsys.readouterr()
    assert left.value.code == 2
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    return captured.err


@pytest.mark.slow
def test_optimize_and_evaluate_end_to_end(scene_file, tmp_path, small_flume):
    out = tmp_path / "run"
    options = ["--budget", "8", "--verify", "1", "--workers", "2", "--out", str(out)]
    done = subprocess.run(
        [*COMMAND, "optimize", str(scene_file), *COARSE, *options],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "complete"
    assert summary["command"][1:3] == ["optimize", str(scene_file)]
    assert f"{summary['best']['verified']['centroid_travel']:.4g}" in done.stdout
    assert summary["verdict_text"] in done.stdout
    assert str(out / "report.html") in done.stdout
    assert (out / "report.html").stat().st_size > 1000

    layout = out / "layouts" / "best.toml"
    measured = subprocess.run(
        [*COMMAND, "evaluate", str(layout), "--spacing", "0.0625", "--json"],
        capture_output=True, text=True, cwd=ROOT, check=True,
    )  # fmt: skip
    values = json.loads(measured.stdout)
    assert set(values["measures"]) == set(UNITS)
    assert values["measures"] == pytest.approx(summary["best"]["verified"])
    travel = values["measures"]["centroid_travel"] / values["no_baffles"]["centroid_travel"]
    assert values["relative"]["centroid_travel"] == pytest.approx(travel)


def test_evaluate_prints_a_table(scene_file, capsys):
    with pytest.raises(SystemExit) as left:
        console.main(
            app, "gns-design", ["evaluate", str(scene_file), "--spacing", "0.0625", "--quiet"]
        )
    assert left.value.code == 0
    out = capsys.readouterr().out
    for name, unit in UNITS.items():
        assert f"{name} [{unit}]" in out


def test_scenes_that_cannot_be_read(capsys, tmp_path, scene_file):
    missing = tmp_path / "missing.toml"
    assert str(missing) in refused(capsys, "optimize", missing)
    assert str(missing) in refused(capsys, "evaluate", missing)
    bad = tmp_path / "bad.toml"
    bad.write_text("[domain\n")
    assert "not a TOML file" in refused(capsys, "optimize", bad)
    bad.write_text(scene_file.read_text().replace("duration", "durration"))
    assert "durration" in refused(capsys, "optimize", bad)
    bad.write_bytes(b"\xff\xfe\x00")
    assert str(bad) in refused(capsys, "evaluate", bad)


def test_simulators_that_are_not_there(capsys, scene_file, tmp_path):
    line = refused(capsys, "optimize", scene_file, "--simulator", "baffle-huge")
    assert "baffle-huge" in line
    assert "mpm" in line
    folder = tmp_path / "model"
    folder.mkdir()
    assert str(folder) in refused(capsys, "optimize", scene_file, "--simulator", folder)
    (folder / "card.json").write_text('{"format": "gns-model"')
    assert str(folder) in refused(capsys, "evaluate", scene_file, "--simulator", folder)
    assert "verify" not in refused(capsys, "optimize", scene_file, *COARSE, "--verify-with", "x")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--baffles", "80"], "80 baffles"),
        (["--baffles", "0"], "baffles must be 1 or more"),
        (["--budget", "0"], "budget must be 1 or more"),
        (["--budget", "many"], "--budget"),
        (["--verify", "-1"], "verify must be 0 or more"),
        (["--workers", "0"], "workers must be 1 or more"),
        (["--method", "guess"], "random, rows, bayes"),
        (["--method", "gradient"], "no gradient"),
        (["--method", "hybrid", "--objectives", "runout,depth"], "no gradient"),
        (["--objectives", "runout"], "two or more"),
        (["--objectives", "runout,height"], "no objective 'height'"),
        (["--objectives", "runout,p99"], "one of them"),
        (["--scenarios", "0"], "scenarios must be 1 to"),
        (["--scenarios", "4", "--budget", "3"], "budget must be 4 or more"),
        (["--scenarios", "2", "--speed", "fast"], "--speed must be a range"),
        (["--scenarios", "2", "--speed", "3:1"], "speed must be a range"),
        (["--scenarios", "2", "--volume", "0.8:9"], "volume is relative to the scene's"),
        (["--scenarios", "2", "--friction", "20:89"], "friction_angle"),
        (["--scenarios", "2", "--risk", "worst"], "mean or cvar"),
        (["--scenarios", "2", "--risk", "cvar", "--cvar-level", "1"], "below 1"),
        (["--scenarios", "2", "--cvar-level", "0.5"], "--risk cvar"),
        (["--speed", "1:2"], "--scenarios N"),
        (["--risk", "cvar"], "--scenarios N"),
        (["--depth-weight", "-1"], "depth_weight"),
        (["--spacing", "-1"], "spacing must be positive"),
        (["--verify-spacing", "0.5"], "spacing"),
        (["--storage", "nonsense"], "storage"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_bad_options(capsys, scene_file, tmp_path, arguments, words):
    out = tmp_path / "out"
    line = refused(capsys, "optimize", scene_file, *COARSE, "--out", out, *arguments)
    assert words in line
    assert not (out / "summary.json").exists()


def test_devices(capsys, scene_file):
    for device in ("toaster", "cuda:99"):
        for simulator in ("x", "mpm"):
            asked = ["--simulator", simulator, "--device", device]
            assert device in refused(capsys, "evaluate", scene_file, *asked)


def test_an_out_that_cannot_be_written(capsys, scene_file, tmp_path):
    (tmp_path / "file").write_text("")
    assert "file" in refused(
        capsys, "optimize", scene_file, *COARSE, "--out", tmp_path / "file" / "run"
    )


@pytest.mark.slow
def test_ctrl_c_keeps_what_there_is(scene_file, tmp_path):
    out = tmp_path / "run"
    process = subprocess.Popen(
        [*COMMAND, "optimize", str(scene_file), *COARSE, "--budget", "4000", "--batch", "2",
         "--workers", "1", "--verify", "1", "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        start_new_session=True,
    )  # fmt: skip
    try:
        # Ctrl-C of a terminal reaches the whole group, workers too.
        deadline = time.monotonic() + 240
        while not _trials(out) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.3)
        os.killpg(process.pid, signal.SIGINT)
        told, err = process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "error: interrupted; what was finished is kept"
    assert "Traceback" not in err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert summary["rollouts"] >= 3
    assert (out / "layouts" / "best.toml").exists()
    # A report of what there is.
    assert f"{summary['best']['cost']:.4f}" in told
    assert f"Open {out / 'report.html'}" in told
    assert "Not verified yet" in (out / "report.html").read_text()
    resumed = subprocess.run(
        [*COMMAND, "optimize", str(scene_file), *COARSE, "--budget", str(summary["rollouts"] + 1),
         "--workers", "1", "--verify", "1", "--out", str(out), "--resume", "--quiet"],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout == ""
    after = json.loads((out / "summary.json").read_text())
    assert after["rollouts"] == summary["rollouts"] + 1
    assert after["status"] == "complete"


def _trials(out: Path) -> bool:
    """Whether the study holds three trials that were told."""
    import sqlite3

    if not (out / "study.db").exists():
        return False
    try:
        connection = sqlite3.connect(f"file:{out / 'study.db'}?mode=ro", uri=True)
        count = connection.execute("SELECT count(*) FROM trial_values").fetchone()[0]
        connection.close()
    except sqlite3.Error:
        return False
    return count >= 3


def test_a_disk_that_is_full_is_one_line_and_loses_nothing(scene_file, tmp_path):
    """Files may not grow beyond a limit that the fine verification exceeds."""
    out = tmp_path / "run"
    options = ["--budget", "4", "--verify", "1", "--workers", "1", "--out", str(out), "--quiet"]
    fine = ["--simulator", "mpm", "--spacing", "0.0625", "--verify-spacing", "0.02"]

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))

    done = subprocess.run(
        [*COMMAND, "optimize", str(scene_file), *fine, *options],
        capture_output=True, text=True, cwd=ROOT, check=False, preexec_fn=limit,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    errors = [line for line in done.stderr.splitlines() if line]
    assert len(errors) == 1, done.stderr
    assert re.match(r"error: .*(too large|errno = 27|No space)", errors[0]), errors
    assert json.loads((out / "summary.json").read_text())["rollouts"] == 4
    left = [p.name for p in (out / "rollouts").iterdir()]
    assert not [name for name in left if name.startswith(".")]
