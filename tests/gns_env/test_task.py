"""Evaluation on the real solver: batches, memory, failures as data."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gns_env.cache import RolloutCache
from gns_env.objective import Objective, ObjectiveError
from gns_env.task import BaffleTask
from gns_model.errors import LayoutError, SceneError, SimulatorError
from gns_model.measures import summary
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.simulator import Simulator

ONE = [[0.55, 0.3]]
TWO = [[0.45, 0.2], [0.6, 0.4]]


def test_evaluations_are_the_simulators_measures(site: Scene, simulator: Simulator) -> None:
    task = BaffleTask(site, simulator)
    paper = [b.center for b in site.baffles]
    evaluation = task.evaluate([paper], trajectories=True)[0]
    trajectory = simulator.rollout([task.scene.with_baffles(paper)])[0]
    expected, reference = summary(trajectory), summary(simulator.rollout([task.scene])[0])
    assert evaluation.status == "ok"
    assert evaluation.measures == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert task.reference == pytest.approx(reference, rel=1e-4, abs=1e-6)
    assert evaluation.cost == pytest.approx(Objective().cost(expected, reference), rel=1e-4)
    assert evaluation.trajectory is not None
    assert evaluation.trajectory.scene.baffles != ()
    # Three baffles hold the flow back: less travel than without.
    assert evaluation.measures["centroid_travel"] < task.reference["centroid_travel"]


def test_one_batch_and_no_layout_twice(small_flume: Scene, faulty: type) -> None:
    simulator = faulty("not at all")
    task = BaffleTask(small_flume, simulator, n_baffles=2)
    first = task.evaluate([TWO, ONE, TWO[::-1], np.array(TWO) + 1e-9])
    assert simulator.batches == [3]  # two, one and, by itself, none
    assert task.rollouts == 3
    assert first[0].measures == first[2].measures == first[3].measures
    np.testing.assert_array_equal(first[2].centres, TWO[::-1])
    again = task.evaluate([ONE, TWO])
    assert simulator.batches == [3]
    assert [e.cost for e in again] == [first[1].cost, first[0].cost]
    assert again[0].trajectory is None
    task.evaluate([ONE], trajectories=True)  # its trajectory was not kept, so it runs again
    assert simulator.batches == [3, 1]
    assert task.evaluate([ONE], trajectories=True)[0].trajectory is not None
    assert simulator.batches == [3, 1]


def test_the_order_of_baffles_does_not_matter_at_all(
    small_flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    costs = [
        BaffleTask(small_flume, coarse_mpm, n_baffles=2).evaluate([layout])[0].cost
        for layout in (TWO, TWO[::-1])
    ]
    assert costs[0] == costs[1]


def test_what_is_returned_is_the_callers(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    task = BaffleTask(small_flume, coarse_mpm, n_baffles=1)
    mine = task.evaluate([ONE])[0]
    mine.measures["centroid_travel"] = -1.0
    mine.centres[:] = 0.0
    again = task.evaluate([ONE])[0]
    assert again.measures["centroid_travel"] > 0
    np.testing.assert_array_equal(again.centres, ONE)
    task.reference.clear()
    assert task.reference != {}


def test_the_flow_without_baffles_is_never_forgotten(
    small_flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    cache = RolloutCache(remembered=2)
    task = BaffleTask(small_flume.replace(duration=0.15), coarse_mpm, n_baffles=1, cache=cache)
    task.evaluate([[[x, 0.3]] for x in np.linspace(0.45, 0.7, 5)])
    assert len(cache) == 2
    before = task.rollouts
    assert task.reference["centroid_travel"] > 0
    assert task.rollouts == before == 6


@pytest.mark.parametrize(
    ("how", "status"),
    [
        ("says so", "diverged"),
        ("nan", "diverged"),
        ("explodes", "diverged"),
        ("one flies", "diverged"),
        ("leaks", "leaked"),
        ("sinks", "leaked"),
    ],
)
def test_a_failed_rollout_is_data(small_flume: Scene, faulty: type, how: str, status: str) -> None:
    objective = Objective()
    task = BaffleTask(small_flume, faulty(how, at_least=2), n_baffles=2, objective=objective)
    good, bad = task.evaluate([ONE, TWO])
    assert not good.failed
    assert bad.failed
    assert bad.status == status
    assert bad.cost == objective.failure_cost > good.cost
    assert all(math.isfinite(v) for v in bad.measures.values())
    assert task.failures == 1
    assert task.rollouts == 3


def test_a_reference_that_fails_is_an_error(small_flume: Scene, faulty: type) -> None:
    task = BaffleTask(small_flume, faulty("nan", at_least=0), n_baffles=1)
    with pytest.raises(ObjectiveError, match="without baffles ended as 'diverged'"):
        task.evaluate([ONE])


def test_a_flow_that_arrives_nowhere_is_an_error(
    small_flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    task = BaffleTask(small_flume.replace(duration=0.02), coarse_mpm, n_baffles=1)
    with pytest.raises(ObjectiveError, match="does not get that far"):
        task.evaluate([ONE])


def test_several_objectives(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    task = BaffleTask(small_flume, coarse_mpm, n_baffles=1, objective=Objective.pareto())
    evaluation = task.evaluate([ONE])[0]
    reference = task.reference
    travel, depth = (
        evaluation.measures[k] / reference[k] for k in ("centroid_travel", "upstream_depth")
    )
    assert evaluation.costs == pytest.approx((travel, max(depth, 1.0)))
    assert evaluation.cost == pytest.approx(travel + max(depth, 1.0))


def test_a_row_in_the_flow_beats_baffles_out_of_its_way(
    flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    task = BaffleTask(flume, coarse_mpm)
    row, staggered, away = (
        e.cost
        for e in task.evaluate(
            [
                [[0.775, 0.75], [0.775, 1.0], [0.775, 1.25]],
                [b.center for b in flume.baffles],
                [[1.425, 0.2], [1.425, 1.0], [1.425, 1.8]],
            ]
        )
    )
    assert row < staggered < away <= task.objective.baseline + 1e-3


def test_a_plane_scene(plane_scene: Scene) -> None:
    task = BaffleTask(plane_scene, MpmSimulator(spacing=0.02), n_baffles=1)
    near, far = task.evaluate([[[0.35]], [[0.9]]])
    assert near.measures["centroid_travel"] < far.measures["centroid_travel"]


def test_the_scene_of_a_task_is_explicit_and_empty(plane_scene: Scene) -> None:
    task = BaffleTask(plane_scene, MpmSimulator(spacing=0.02), n_baffles=1)
    assert task.scene.baffles == ()
    assert task.scene.placement is not None
    assert task.scene_with([[0.6]]).baffles == plane_scene.baffles


def test_what_cannot_stand_is_refused(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    task = BaffleTask(small_flume, coarse_mpm, n_baffles=2)
    with pytest.raises(SceneError, match=r"overlaps baffle\[0\]"):
        task.evaluate([[[0.55, 0.3], [0.56, 0.3]]])
    with pytest.raises(LayoutError, match="finite"):
        task.evaluate([[[math.nan, 0.3]]])
    assert task.evaluate([]) == []
    assert task.rollouts == 0


def test_an_unknown_simulator_is_refused(small_flume: Scene) -> None:
    with pytest.raises(SimulatorError, match="'oracle'"):
        BaffleTask(small_flume, "oracle")
    with pytest.raises(ObjectiveError, match="at least"):
        BaffleTask(small_flume, "mpm", objective=())
