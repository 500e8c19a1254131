"""What is promised of the database whatever happens to the process; see test_sharing.py too."""

import sqlite3

import optuna

from design.storage import open_storage, sqlite_url
from tests.interrupt import Interrupt


def test_an_interrupt_at_any_line_leaves_no_lock(tmp_path):
    """Whoever comes next would wait for it, this process too."""
    storage = open_storage(sqlite_url(tmp_path / "study.db"), None)
    study = optuna.create_study(storage=storage)
    trial = study.ask()
    other = sqlite3.connect(tmp_path / "study.db", timeout=0.0, isolation_level=None)
    line, interrupted = 1, True
    while interrupted:
        try:
            with Interrupt(line):
                study._storage.set_trial_user_attr(trial._trial_id, "line", line)
            interrupted = False
        except KeyboardInterrupt:
            line += 3
        other.execute("BEGIN IMMEDIATE")
        other.execute("ROLLBACK")
    assert line > 1000
    storage.engine.dispose()
