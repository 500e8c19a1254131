"""Several workers on one study: a budget for all, and nothing lost when one is killed."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import optuna
import pytest

from design import ledger
from design.campaign import Campaign
from design.cli import app
from design.evaluators import InProcess
from design.folder import claim, release
from design.methods import METHODS
from design.parameters import to_centres
from design.storage import StudyError, public, sqlite_url
from design.trials import TrialLog
from gns_env.layout import LayoutSpace
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model import console
from gns_model.scene import Scene

from . import postgres
from .search_kit import FormulaSimulator, formula_scene

#: Seconds without a sign of life; more than a busy machine may hold a process up.
GRACE = 8


@pytest.fixture(scope="module")
def server():
    """Port of a PostgreSQL server."""
    if postgres.programs() is None:
        pytest.skip("no PostgreSQL here: apt-get install postgresql, pip install psycopg[binary]")
    with postgres.server() as port:
        yield port


@pytest.fixture(params=["sqlite", "postgresql"])
def storage(request, tmp_path):
    """Address of an empty database of either kind."""
    if request.param == "sqlite":
        return sqlite_url(tmp_path / "shared.db")
    return new_database(request.getfixturevalue("server"))


def new_database(port):
    import psycopg

    address = f"gns:{postgres.PASSWORD}@127.0.0.1:{port}"
    name = f"d{time.time_ns()}"
    with psycopg.connect(f"postgresql://{address}/postgres", autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return f"postgresql://{address}/{name}"


class SlowFormula(FormulaSimulator):
    """A rollout takes a while, so that there is a middle of it."""

    def rollout(self, scenes, *, progress=None):
        time.sleep(0.1 * sum(bool(scene.baffles) for scene in scenes))
        return super().rollout(scenes)


def worker(storage, method, budget, salt, until):
    """One worker: a search on the shared study, to its end."""
    task = BaffleTask(
        formula_scene(), SlowFormula(), n_baffles=2, objective=Objective(depth_weight=0.0)
    )
    log = TrialLog.open(
        storage, "test", task.space, {"n": 2}, resume=False, owned=False, grace=GRACE
    )
    until.wait(300)
    campaign = Campaign(log, InProcess(task), budget, batch=4, salt=salt)
    METHODS[method](campaign)
    while campaign.wait():
        METHODS[method](campaign)
    log.close()


def study_of(storage, name, processes):
    """The study that workers make, once they have made it."""
    address = storage.replace("postgresql:", "postgresql+psycopg:")
    backend = None
    for _ in while_they_run(processes):
        with suppress(Exception):  # it is being made
            # One storage for all tries: each keeps its connection, and a server has so many.
            backend = backend or optuna.storages.RDBStorage(address)
            return optuna.load_study(study_name=name, storage=backend)
    raise AssertionError("no worker made a study")


def while_they_run(processes):
    """Looks, twenty in a second, until all processes have ended."""
    end = time.monotonic() + 300
    while time.monotonic() < end and not all(ended(p) for p in processes):
        yield
        time.sleep(0.05)


def ended(process):
    popen = isinstance(process, subprocess.Popen)
    return (process.poll() if popen else process.exitcode) is not None


def kill_within_a_trial(study, processes, after=0):
    """End the first of some workers that runs trials, once so many are told: the trials' numbers,
    and which worker it was."""
    pids = [p.pid for p in processes]
    for _ in while_they_run(processes):
        trials = study.get_trials(deepcopy=False)
        busy = [k for k, pid in enumerate(pids) if runs(trials, pid)]
        if sum(t.state.name == "COMPLETE" for t in trials) < after or not busy:
            continue
        pid = pids[busy[0]]
        os.kill(pid, signal.SIGSTOP)  # so that it is in the middle when it is looked at
        time.sleep(0.2)
        try:
            asked = runs(study.get_trials(deepcopy=False), pid)
        except optuna.exceptions.StorageInternalError:  # it was stopped while it wrote
            asked = set()
        os.kill(pid, signal.SIGKILL if asked else signal.SIGCONT)
        if asked:
            return asked, busy[0]
    raise AssertionError("the workers ended before one was met within a trial")


def runs(trials, pid):
    """Numbers of the trials that a process was let run, and runs."""
    mine = [t for t in trials if t.state.name == "RUNNING"]
    return {t.number for t in mine if t.user_attrs.get(ledger.WORKER, "").endswith(f"-{pid}")}


# One asks the study for layouts, the other gives it layouts and takes their gradients.
@pytest.mark.parametrize("method", ["tpe", "gradient"])
def test_workers_share_a_budget_and_one_is_killed(storage, method):
    """Three at once; one gets SIGKILL while its batch runs. Every layout it had asked for is run
    by the others, the budget is spent to the last pass and no further, no row is tried twice."""
    budget = 40
    context = multiprocessing.get_context("forkserver")  # pays for the imports once
    context.set_forkserver_preload([__name__, "optuna", "design.methods", "cvxpy", "psycopg"])
    start = context.Barrier(4)  # three workers and who looks on: their search takes seconds
    workers = [
        context.Process(target=worker, args=(storage, method, budget, salt, start))
        for salt in (1, 2, 3)
    ]
    for process in workers:
        process.start()
    study = study_of(storage, "test", workers)
    start.wait(300)
    asked, killed = kill_within_a_trial(study, workers, after=6)
    dead = workers.pop(killed)
    for process in (dead, *workers):
        process.join(300)
    assert [p.exitcode for p in (dead, *workers)] == [-signal.SIGKILL, 0, 0]

    trials = study.get_trials()
    states = Counter(t.state.name for t in trials)
    assert states["RUNNING"] == 0
    told = [t for t in trials if t.state.name == "COMPLETE"]
    records = [t.user_attrs[ledger.RECORD] for t in told]
    spent = sum(r["rollouts"] + r["backwards"] for r in records)
    assert budget - 1 <= spent <= budget  # a gradient takes two
    # The killed worker's trials: failed, and complete as another trial of the same layout.
    lost = [t for t in trials if t.user_attrs.get(ledger.LOST)]
    assert asked
    assert asked <= {t.number for t in lost}
    log = TrialLog(study, LayoutSpace(formula_scene(), 2))

    def layout(trial):
        """What is built of its parameters: a sampler asks for what cannot stand, too."""
        return pytest.approx(log.buildable(to_centres(log.space, trial.params)), abs=1e-5)

    for t in lost:
        if ledger.WORKER not in t.user_attrs:
            continue  # asked for, and not yet let run: there may have been no room for it
        tried = [a for a in told if a.user_attrs.get(ledger.RETRY_OF) == t.number]
        # Two workers' chains may meet: then the other's own trial of that layout is the retry.
        tried += [
            a
            for a in told
            if not tried
            and a.user_attrs.get(ledger.ORIGIN) == t.user_attrs.get(ledger.ORIGIN) == "gradient"
            and np.array(a.user_attrs[ledger.RECORD]["centres"]) == layout(t)
        ]
        (again,) = tried
        assert np.array(again.user_attrs[ledger.RECORD]["centres"]) == layout(t)
        assert not again.user_attrs[ledger.RECORD]["worker"].endswith(f"-{dead.pid}")
    assert len({r["worker"] for r in records}) >= 2
    given = [
        (t.user_attrs[ledger.ORIGIN], tuple(np.round(sorted(t.params.values()), 5)))
        for t in told
        if ledger.ORIGIN in t.user_attrs
    ]
    assert len(given) == len(set(given))


# -- the command -----------------------------------------------------------------------------------

#: The command without its pictures, which take most of the time of so short a run.
COMMAND = """
import design.report
design.report.write_report = lambda folder: None
from design.cli import main
main()
"""


@pytest.fixture
def scene_file(tmp_path):
    """A plane flow of which the solver makes a rollout in half a second."""
    scene = Scene.from_dict(
        {
            "name": "plane",
            "duration": 0.4,
            "section": 0.6,
            "domain": {"lower": [0.0, 0.0], "upper": [1.2, 0.4]},
            "release": [{"lower": [0.0, 0.0], "upper": [0.2, 0.2], "velocity": [1.0, 0.0]}],
            "baffle": [{"center": [0.5], "size": [0.05, 0.1]}],
            "placement": {"lower": [0.3], "upper": [1.0], "gap": 0.05},
        }
    )
    scene.to_toml(tmp_path / "plane.toml")
    return tmp_path / "plane.toml"


def options(storage, out, *more):
    return [
        "--simulator", "mpm", "--spacing", "0.01", "--verify", "0", "--workers", "1",
        "--grace", str(GRACE), "--storage", storage, "--out", str(out), *map(str, more),
    ]  # fmt: skip


def refused(capsys, *arguments):
    """The one line with which the command refuses `arguments`."""
    with pytest.raises(SystemExit) as left:
        console.main(app, "gns-design", ["optimize", *map(str, arguments), "--quiet"])
    captured = capsys.readouterr()
    assert left.value.code == 2
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


@pytest.mark.slow
def test_the_command_on_two_machines_of_which_one_dies(server, scene_file, tmp_path, capsys):
    """`gns-design optimize --storage postgresql://…` twice; one is killed within a rollout."""
    storage = new_database(server)
    more = ["--budget", "14", "--batch", "4", "--method", "random"]
    names = ["first", "second"]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", COMMAND, "optimize", scene_file]
            + options(storage, tmp_path / name, *more),
            cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )
        for name in names
    ]  # fmt: skip
    study = study_of(storage, "gns-design", processes)
    asked, killed = kill_within_a_trial(study, processes)
    processes.pop(killed).communicate()
    dead, alive = names.pop(killed), names[0]
    out, err = processes[0].communicate(timeout=300)
    assert processes[0].returncode == 0, err
    assert postgres.PASSWORD.encode() not in out + err
    summary = json.loads((tmp_path / alive / "summary.json").read_text())
    assert summary["status"] == "complete"
    assert summary["rollouts"] == 14
    assert postgres.PASSWORD not in json.dumps(summary)
    assert not (tmp_path / dead / "summary.json").exists()
    trials = study.get_trials()
    assert not [t for t in trials if t.state.name in ("RUNNING", "WAITING")]
    lost = {t.number for t in trials if t.user_attrs.get(ledger.LOST)}
    again = [t for t in trials if ledger.RETRY_OF in t.user_attrs]
    assert {t.user_attrs[ledger.RETRY_OF] for t in again if t.state.name == "COMPLETE"} == lost
    assert asked <= lost

    # What is another's, or of another problem, is refused; nothing is touched.
    held = claim(tmp_path / alive)
    line = refused(capsys, scene_file, *options(storage, tmp_path / alive, "--resume"))
    assert "--out of its own" in line
    release(held)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    line = refused(capsys, scene_file, *options(storage, tmp_path / "third", "--baffles", "2"))
    assert "another number of baffles (1, now 2)" in line
    assert "--study" in line
    wrong = storage.replace(postgres.PASSWORD, "sesame-open")
    line = refused(capsys, scene_file, *options(wrong, tmp_path / "third"))
    assert "password authentication failed" in line
    assert "sesame" not in line
    port = storage.rsplit(":", 1)[1].split("/")[0]
    line = refused(capsys, scene_file, *options(storage.replace(port, "1"), tmp_path / "third"))
    assert "127.0.0.1:1" in line
    assert postgres.PASSWORD not in line
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before


def test_a_folder_of_another_scene_is_refused(scene_file, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    other = Scene.from_toml(scene_file)
    other.replace(duration=0.3).to_toml(out / "scene.toml")
    (out / "summary.json").write_text("{}")
    before = {p: p.read_bytes() for p in out.iterdir()}
    url = sqlite_url(tmp_path / "s.db")
    line = refused(capsys, scene_file, *options(url, out, "--resume"))
    assert "another scene" in line
    assert {p: p.read_bytes() for p in out.iterdir()} == before


def test_addresses_are_shown_without_what_is_secret():
    for address in ("postgresql://u:secret@h:5/d?password=secret", "mysql://secret:secret@h:5/d"):
        assert "secret" not in public(address)
        assert "h:5/d" in public(address)
    assert "secret" not in public("nonsense:secret@h:x/d")


def test_a_missing_driver_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    space = LayoutSpace(formula_scene(), 1)
    with pytest.raises(StudyError, match=r"gns-baffles\[postgres\]"):
        TrialLog.open("postgresql://u:secret@h/d", "x", space, {}, resume=False, owned=False)
