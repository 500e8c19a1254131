"""Columns from several fillings, both simulators from the same points."""

from pathlib import Path

import numpy as np
import pytest

from gns_model import measures, paper
from gns_model.errors import SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.simulator import can_refill
from gns_model.suites import columns, fillings, friction, upscaled
from gns_model.suites.fillings import JITTER, Starts, filling_columns
from gns_model.suites.setup import Setup

SPACING = 0.05
COLUMN = paper.column_scene(paper.COLUMNS[2]).replace(duration=0.4)


def test_runouts_are_means_over_the_fillings(tiny, shared: Path):
    simulator = tiny(solver_steps=2)
    setup = Setup(shared, spacing=SPACING, fillings=3)
    starts = Starts.simulate(simulator, [COLUMN], setup)
    [pairs] = starts.fillings
    row = starts.row(0)
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
    # What is judged are the means, of which a model of lattices is told that it never saw any.
    aims = starts.aims([row], "one column")
    assert [aim.value for aim in aims] == [pytest.approx(abs(row["fillings_error"]))] * 2
    assert any("jitter = 0.25, but trained on" in line for line in starts.warnings)


@pytest.mark.parametrize("suite", [columns, friction, upscaled])
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
    assert [aim.met for aim in result.aims] == [True] * (1 if suite is upscaled else 2)
    assert all("means of 2 fillings" in aim.name for aim in result.aims)
    assert set(fillings.SHOWN) < set(result.shown)
    assert len(result.cells()[0]) == len(result.shown)
    assert result.warnings == []
    # Without, one start is judged, and there is room for more columns.
    usual = suite.run(solver, Setup(shared, spacing=SPACING))
    assert len(usual.aims) == len(result.aims)
    assert not any("fillings" in aim.name for aim in usual.aims)
    assert not set(fillings.SHOWN) & set(usual.shown)
    assert "fillings" not in usual.rows[0]


def test_a_model_of_shaken_starts_is_held_against_the_same_start(tiny, shared: Path):
    simulator = tiny(solver_steps=2, jitter=0.25)
    starts = Starts.simulate(simulator, [COLUMN], Setup(shared, spacing=SPACING, fillings=1))
    (pair,) = starts.pairs
    np.testing.assert_array_equal(pair.predicted.positions[0], pair.reference.positions[0])
    solver = MpmSimulator(spacing=SPACING, jitter=0.25)
    expected = solver.rollout([COLUMN.replace(duration=0.02)])[0].positions[0]
    np.testing.assert_array_equal(pair.reference.positions[0], expected)
    assert not any("jitter" in line for line in starts.warnings)


def test_one_filling_has_no_deviation(shared: Path):
    setup = Setup(shared, spacing=SPACING, fillings=1)
    starts = Starts.simulate(MpmSimulator(spacing=SPACING), [COLUMN], setup)
    assert filling_columns(starts.fillings[0])["fillings_mpm_sd"] is None


def test_a_simulator_of_ones_own_may_know_no_fillings(shared: Path):
    class Own:
        name = "own"

        def __init__(self) -> None:
            self.solver = MpmSimulator(spacing=SPACING)
            self.check, self.rollout = self.solver.check, self.solver.rollout

    assert not can_refill(Own())
    with pytest.raises(SimulatorError, match="own cannot start from another filling"):
        Starts.simulate(Own(), [COLUMN], Setup(shared, spacing=SPACING, fillings=2))
    starts = Starts.simulate(Own(), [COLUMN], Setup(shared, spacing=SPACING))
    assert starts.count == 0
    assert starts.row(0)["runout_error"] == 0.0
