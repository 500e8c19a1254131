"""The commands as a user meets them: one line and exit code 2 for every mistake."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from gns_model import console, load_simulator
from gns_model.cli import app

REFERENCE = Path(__file__).parent / "reference"
MODEL, METADATA = str(REFERENCE / "model-0.pt"), str(REFERENCE / "metadata.json")


class Calls:
    def __reduce__(self):
        return os.system, ("touch was-run",)


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        console.main(app, "gns-model", list(arguments))
    out, err = capsys.readouterr()
    return end.value.code, out, err


def test_import_and_predict(tmp_path, capsys):
    folder = str(tmp_path / "model")
    code, out, _ = run(
        capsys, "import", MODEL, "--metadata", METADATA, "--edge-update", "residual",
        "--noise-std", "6.7e-4", "--out", folder,
    )  # fmt: skip
    assert code == 0
    assert "2D, 16,202 parameters, 3 blocks, latent 16, 9 types" in out
    case = np.load(REFERENCE / "case.npz")
    after = load_simulator(folder).predict_positions(
        case["position_sequence"], case["particle_types"], None
    )
    assert np.abs(after - case["predicted_next_positions"]).max() <= 1e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"MODEL": "nowhere.pt"}, "no such file"),
        ({"MODEL": METADATA}, "cannot be read safely"),
        ({"--metadata": "nowhere.json"}, "cannot be read"),
        ({"--metadata": MODEL}, "not JSON"),
        ({"--edge-update": "tripled"}, "tripled"),
        ({"--edge-update": None}, "--edge-update"),
        ({"--noise-std": None}, "--noise-std"),
        ({"--noise-std": "-1"}, "--noise-std"),
        ({"--spacing": "0.5"}, "must exceed the spacing"),
        ({"--spacing": "nan"}, "spacing"),
        ({"--dt": "nan"}, "--dt"),
    ],
)
def test_a_wrong_import_is_one_line(tmp_path, monkeypatch, capsys, change, words):
    monkeypatch.chdir(tmp_path)
    options = {
        "MODEL": MODEL, "--metadata": METADATA, "--edge-update": "residual",
        "--noise-std": "6.7e-4", "--out": "out", **change,
    }  # fmt: skip
    model = options.pop("MODEL")
    given = [part for key, value in options.items() if value is not None for part in (key, value)]
    code, _, err = run(capsys, "import", str(model), *given)
    assert code == 2
    assert err.count("\n") == 1
    assert words in err
    assert not Path("out").exists()


def npz(path: Path, *parts: object) -> str:
    array = np.empty(len(parts), dtype=object)
    for k, part in enumerate(parts):
        array[k] = part
    np.savez(path, simulation_trajectory_0=array)
    return str(path)


def test_datasets_in_and_out(tmp_path, capsys):
    case = np.load(REFERENCE / "case.npz")
    path = npz(tmp_path / "train.npz", case["trajectory"], case["particle_types"])
    code, out, err = run(
        capsys, "import-dataset", path, "--metadata", METADATA, "--out", str(tmp_path / "ours"),
        "--quiet",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert out == f"1 trajectories in {tmp_path / 'ours'}\n"
    code, out, _ = run(
        capsys, "export-dataset", str(tmp_path / "ours"), "--quiet",
        "--out", str(tmp_path / "theirs" / "train.npz"),
    )  # fmt: skip
    assert code == 0
    with np.load(tmp_path / "theirs" / "train.npz", allow_pickle=True) as file:
        positions, kinds = file["simulation_trajectory_0"]
    np.testing.assert_array_equal(positions, case["trajectory"])
    np.testing.assert_array_equal(kinds, case["particle_types"])


def test_wrong_datasets_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    case = np.load(REFERENCE / "case.npz")
    long = json.loads(Path(METADATA).read_text()) | {"sequence_length": 400}
    Path("long.json").write_text(json.dumps(long))
    good = npz(tmp_path / "good.npz", case["trajectory"], case["particle_types"])
    evil = npz(tmp_path / "evil.npz", case["trajectory"], Calls())
    for path, about, words in (
        (good, "long.json", "sequence_length = 400"),
        (evil, METADATA, "posix.system, which is no array"),
        ("nowhere.npz", METADATA, "cannot be read"),
        (METADATA, METADATA, "not an npz"),
        (good, "nowhere.json", "cannot be read"),
    ):
        code, _, err = run(
            capsys, "import-dataset", path, "--metadata", about, "--out", "out", "--quiet"
        )
        assert code == 2
        assert err.count("\n") == 1
        assert words in err
    assert not Path("was-run").exists()
    code, _, err = run(capsys, "export-dataset", "out", "--out", "t.npz", "--quiet")
    assert code == 2
    assert "no trajectory files" in err
