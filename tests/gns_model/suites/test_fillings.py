"""Columns from starts off their lattice, both simulators from the same points."""

from pathlib import Path

import numpy as np
import pytest

from gns_model import measures, paper
from gns_model.errors import SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.suites import columns, fillings, friction
from gns_model.suites.fillings import JITTER, filling_columns, simulate_fillings
from gns_model.suites.setup import Setup

SPACING = 0.05
COLUMN = paper.column_scene(paper.COLUMNS[2]).replace(duration=0.4)


def test_runouts_are_means_over_the_fillings(tiny, shared: Path):
    simulator = tiny(solver_steps=2)
    setup = Setup(shared, spacing=SPACING, fillings=3)
    [pairs] = simulate_fillings(simulator, [COLUMN], setup)
    row = filling_columns(pairs)
    solved, learned = [], []
    for k in (1, 2, 3):
        solver = MpmSimulator(spacing=SPACING, frame_interval=0.02, jitter=JITTER, filling=k)
        solved.append(measures.normalised_runout(solver.rollout([COLUMN])[0]))
        learned.append(
            measures.normalised_runout(simulator.refilled(JITTER, k).rollout([COLUMN])[0])
        )
    assert len(set(solved)) == len(set(learned)) == 3
    assert row["fillings_mpm"] == pytest.approx(np.mean(solved))
    assert row["fillings_mpm_sd"] == pytest.approx(np.std(solved, ddof=1))
    assert row["fillings"] == pytest.approx(np.mean(learned))
    assert row["fillings_error"] == pytest.approx(np.mean(learned) / np.mean(solved) - 1)
    went = [
        np.mean([t.positions[-1][:, 0].mean() - t.positions[0][:, 0].mean() for t in some])
        for some in ([p.predicted for p in pairs], [p.reference for p in pairs])
    ]
    assert row["fillings_centroid_error"] == pytest.approx(went[0] / went[1] - 1, rel=1e-4)
    for pair in pairs:  # from the same points
        np.testing.assert_array_equal(pair.predicted.positions[0], pair.reference.positions[0])
    assert simulator.jitter == 0.0  # the one that was given is as it was


@pytest.mark.parametrize("suite", [columns, friction])
def test_the_solver_agrees_with_itself_from_every_filling(
    suite, shared: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(paper, "COLUMNS", paper.COLUMNS[1:4])  # a = 0.8, 1, 2
    monkeypatch.setattr(paper, "FRICTION_ANGLES", (30.0,))
    monkeypatch.setattr(columns, "FRAMED", (0.8,))
    solver = MpmSimulator(spacing=SPACING)
    result = suite.run(solver, Setup(shared, spacing=SPACING, fillings=2))
    for row in result.rows:
        assert row["fillings_error"] == 0.0
        assert row["fillings_mpm_sd"] > 0
        assert row["fillings_mpm"] != row["runout_mpm"]
    assert [aim.met for aim in result.aims] == [True] * 4
    assert "2 fillings" in result.aims[2].name
    assert result.shown[-len(fillings.SHOWN) :] == fillings.SHOWN
    assert len(result.cells()[0]) == len(result.shown) < len(suite.SHOWN) + len(fillings.SHOWN)
    # Without, the table is as it was.
    usual = suite.run(solver, Setup(shared, spacing=SPACING))
    assert len(usual.aims) == 2
    assert "fillings" not in usual.rows[0]


def test_one_filling_has_no_deviation(shared: Path):
    setup = Setup(shared, spacing=SPACING, fillings=1)
    [pairs] = simulate_fillings(MpmSimulator(spacing=SPACING), [COLUMN], setup)
    assert filling_columns(pairs)["fillings_mpm_sd"] is None


def test_a_simulator_of_ones_own_may_know_no_fillings(shared: Path):
    class Own:
        name = "own"

    with pytest.raises(SimulatorError, match="own cannot start from another filling"):
        simulate_fillings(Own(), [COLUMN], Setup(shared, fillings=2))
    assert simulate_fillings(Own(), [COLUMN], Setup(shared)) == [()]
