"""Judging by rollout: what is measured in which scene, and that the ranks' shares add up."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gns_model import measures
from gns_model.data.windows import WindowIndex
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.training.distributed import Ranks
from gns_model.training.judging import AIMS, Facts, energy_error, errors, judged_by
from gns_model.training.validation import Interrupted, Validator
from gns_model.trajectory import DIVERGED, Trajectory

COLUMN = ("runout_max", "centroid_travel", "energy")
SPACING, DT = 0.0625, 0.02


def column(length: float = 0.25) -> Scene:
    return Scene.from_dict(
        {
            "name": "column",
            "duration": 0.2,
            "domain": {"lower": [0.0, 0.0], "upper": [1.0, 0.5]},
            "release": [
                {"lower": [0.0, 0.0], "upper": [length, 0.25], "velocity": [0.0, 0.0]},
            ],
        }
    )


def spread(scene: Scene, rate: float = 1.0, frames: int = 21, interval: float = 0.01) -> Trajectory:
    """A made-up collapse, from rest to rest: points run as far from the wall as they were high."""
    points = fill(scene, SPACING / 2)
    time = np.arange(frames) * interval
    positions = np.repeat(points.positions[None], frames, axis=0)
    share = 0.5 * (1 - np.cos(np.pi * time / time[-1]))[:, None]
    positions[:, :, 0] += rate * share * points.positions[:, 1]
    positions[:, :, 1] *= 1 - 0.4 * share
    return Trajectory(
        positions=positions.astype(np.float32),
        time=time,
        particle_type=np.full(len(points.positions), MOVING, np.int8),
        scene=scene,
        point_volume=points.volume,
        lattice=points.lattice,
    )


@pytest.fixture(scope="module")
def columns(tmp_path_factory):
    folder = tmp_path_factory.mktemp("columns")
    for k in range(4):
        spread(column(0.125 + 0.0625 * k), 1 + 0.3 * k).save(folder / f"{k}.h5")
    return folder


def plane_model() -> LearnedModel:
    torch.manual_seed(0)
    return LearnedModel(
        ModelConfig(dim=2, spacing=SPACING, dt=DT, radius=0.1, latent=8, blocks=1, history=2)
    )


def test_a_column_is_judged_by_runout_and_a_flow_among_barriers_by_depth_too(flume):
    assert judged_by(column()) == COLUMN
    assert {"upstream_depth", "runout_p99", "energy"} <= set(judged_by(flume))
    assert set(judged_by(flume)) | set(COLUMN) == set(AIMS)


def test_the_truth_makes_no_error_and_a_longer_runout_makes_one():
    scene = column()
    truth = Facts.of(spread(scene))
    assert errors(COLUMN, truth, spread(scene)) == dict.fromkeys(COLUMN, 0.0)
    far = spread(scene, rate=1.1)
    found = errors(COLUMN, truth, far)
    assert found["runout_max"] == pytest.approx(0.1, rel=1e-4)
    assert found["centroid_travel"] == pytest.approx(0.1, rel=1e-4)
    # The normalised runout of the paper's table is off by as much, but for half a spacing.
    table = measures.normalised_runout(far) / measures.normalised_runout(spread(scene)) - 1
    assert found["runout_max"] == pytest.approx(table, abs=0.02)
    assert 0 < found["energy"] < 0.2


def test_energy_is_compared_by_the_kilogram_at_the_same_interval():
    scene = column()
    fine = spread(scene)
    coarse = spread(scene, frames=11, interval=0.02)
    every_other = Facts.of(fine, stride=2)
    np.testing.assert_allclose(every_other.energies, Facts.of(coarse).energies, rtol=1e-4)
    # Every other point of a checkerboard weighs half and holds as much energy a kilogram.
    board = fine.lattice.sum(axis=1) % 2 == 0
    half = Trajectory(
        fine.positions[:, board], fine.time, fine.particle_type[board], scene, fine.point_volume
    )
    np.testing.assert_allclose(Facts.of(half).energies, Facts.of(fine).energies, rtol=0.02)


def test_energy_error_is_relative_to_what_is_dissipated():
    truth = np.array([[2.0, 0.0], [1.5, 0.3], [1.0, 0.0]])
    assert energy_error(truth, truth) == 0
    assert energy_error(truth + [[0, 0], [0.1, -0.1], [0, 0]], truth) == pytest.approx(0.2 / 3)
    # Where potential energy is counted from does not matter.
    shift = np.array([5.0, 0.0])
    found = truth + [[0.1, 0.0]]
    assert energy_error(found + shift, truth + shift) == pytest.approx(0.1)


def test_a_rollout_that_diverged_counts_one_in_everything():
    truth = spread(column())
    bad = spread(column())
    bad.status = DIVERGED
    assert errors(COLUMN, Facts.of(truth), bad) == dict.fromkeys(COLUMN, 1.0)


def scores(columns, ranks, rollouts=4):
    index = WindowIndex([columns], spacing=SPACING, dt=DT, history=2)
    return Validator(index, ranks, rollouts, 6)(plane_model(), lambda: False)


def test_columns_are_scored_without_depth_and_section(columns):
    result = scores(columns, Ranks(0, 1, torch.device("cpu")))
    assert tuple(result.errors) == COLUMN
    assert result.complete
    assert all(0 < error <= 1 for error in result.errors.values())
    wanted = np.mean([result.errors[name] / AIMS[name][0] for name in COLUMN])
    assert result.score == pytest.approx(wanted, rel=1e-5)
    assert np.isfinite(result.slope)


def test_the_drive_is_how_much_of_the_acceleration_a_model_gives(columns):
    """A model that gives all points the same push; the flows are pushed by different ones."""
    index = WindowIndex([columns], spacing=SPACING, dt=DT, history=2)
    model = plane_model()
    for parameter in model.network.decode.parameters():
        torch.nn.init.zeros_(parameter)
    drives = []
    for push in (0.0, 2.0, 4.0):
        model.acceleration_mean[0] = push
        alone = Ranks(0, 1, torch.device("cpu"))
        drives.append(Validator(index, alone, 1, 24)(model, lambda: False).drive)
    # What they are asked for: windows are drawn as the validator draws them.
    rng, asked = np.random.default_rng(0), []
    for _ in range(24):
        source = int(rng.integers(len(index.sources)))
        window = index.read(source, int(rng.random() * index.starts(source, 1)), mixture=0)
        path = np.concatenate([window.history[:, -2:], window.future], axis=1)[..., 0]
        asked.append(float(np.diff(path, 2, axis=1).mean()) / DT**2)
    wanted = np.sum(asked) / np.sum(np.square(asked))
    assert drives == pytest.approx([0.0, 2 * wanted, 4 * wanted], rel=0.02, abs=1e-4)


def test_what_the_ranks_find_adds_up_to_what_one_finds(columns):
    """Two ranks in turn, each adding to a table that the other left: the same scores."""

    class Relay(Ranks):
        def sum(self, values):
            tables.append(values)
            return torch.stack(tables).sum(0)

    whole = scores(columns, Ranks(0, 1, torch.device("cpu")))
    tables: list[torch.Tensor] = []
    scores(columns, Relay(0, 2, torch.device("cpu")))
    shared = scores(columns, Relay(1, 2, torch.device("cpu")))
    assert shared.row() == pytest.approx(whole.row(), rel=1e-5)


def test_scenes_of_two_kinds_are_averaged_each_by_its_own_measures(columns, tmp_path, plane_scene):
    for path in columns.iterdir():
        Trajectory.load(path).save(tmp_path / f"a-{path.name}")
    wide = plane_scene.replace(duration=0.2)
    spread(wide, rate=0.5).save(tmp_path / "b.h5")
    result = scores(tmp_path, Ranks(0, 1, torch.device("cpu")), rollouts=5)
    assert set(result.errors) == set(AIMS)
    alone = scores(columns, Ranks(0, 1, torch.device("cpu")))
    assert result.errors["runout_max"] == pytest.approx(alone.errors["runout_max"], rel=1e-6)


def test_a_stop_in_the_middle_of_a_rollout_is_reported(columns):
    index = WindowIndex([columns], spacing=SPACING, dt=DT, history=2)
    asked = []

    def stop() -> bool:
        asked.append(True)
        return len(asked) > 3

    result = Validator(index, Ranks(0, 1, torch.device("cpu")), 4, 6)(plane_model(), stop)
    assert not result.complete
    assert len(asked) == 4
    assert issubclass(Interrupted, Exception)
