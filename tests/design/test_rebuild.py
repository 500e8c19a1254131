"""`gns-design report RUN`: the same page again, and nothing touched that is no run."""

import json

import pytest

from design.cli import app
from design.report import write_report
from gns_model import console

from .fake_run import write_run


def run_report(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        console.main(app, "gns-design", ["report", *map(str, arguments), "--quiet"])
    return left.value.code


def test_the_page_is_the_same_again(tmp_path, capsys):
    folder = write_run(tmp_path / "run")
    page = write_report(folder, gif=False).read_text()
    (folder / "report.html").unlink()
    assert run_report(folder, "--no-gif") == 0
    assert capsys.readouterr().out.strip() == str(folder / "report.html")
    assert (folder / "report.html").read_text() == page


def test_the_page_follows_the_folder(tmp_path):
    folder = write_run(tmp_path / "run", trials=10)
    summary = json.loads((folder / "summary.json").read_text())
    summary["notes"] = ["a note that was added by hand"]
    (folder / "summary.json").write_text(json.dumps(summary))
    assert run_report(folder, "--no-gif") == 0
    assert "a note that was added by hand" in (folder / "report.html").read_text()


def test_a_run_cut_off_gives_a_partial_page(tmp_path):
    folder = write_run(tmp_path / "run", verified=False, trials=10)
    (folder / "summary.json").write_text('{"status": ')
    assert run_report(folder, "--no-gif") == 0
    page = (folder / "report.html").read_text()
    assert "What is missing" in page
    assert "summary.json cannot be read" in page


def test_what_is_no_run_is_left_alone(tmp_path, capsys):
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "me.jpg").write_bytes(b"")
    for path in (folder, tmp_path / "none", folder / "me.jpg"):
        assert run_report(path) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"error: {path}: no ")
        assert error.count("\n") == 1
    assert [p.name for p in folder.iterdir()] == ["me.jpg"]
