from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from gns_model import measures
from gns_model.errors import SceneError, SimulatorError
from gns_model.evaluation import (
    AIMS,
    JUDGED,
    compare,
    deposit_error,
    deposit_map,
    point_rmse,
    rank_correlation,
)
from gns_model.evaluation_figures import deposit_figure, scatter_figure
from gns_model.gradient_check import gradient_check
from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig
from gns_model.mpm import MpmSimulator
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.simulator import load_simulator
from gns_model.trajectory import Trajectory

LAYOUTS = [[[0.70, z], [1.0, z + 0.4], [1.3, 1.0]] for z in (0.3, 0.45, 0.7, 0.9, 1.2)]


class Slide:
    """A flow with a known answer: the block slides out by a length that the layout sets.

    Every point moves along x by `gain` times 0.4 + 0.3 (mean z - 0.8) times its own stretch, so the
    measures of two gains differ by a known factor. It is differentiable in the centres.
    """

    def __init__(self, gain: float = 1.0, spacing: float = 0.05, follow: float = 1.0) -> None:
        self.name = f"slide-{gain:g}"
        self.gain, self.spacing, self.follow = gain, spacing, follow

    def check(self, scene: Scene) -> None:
        if scene.dim != 3:
            raise SimulatorError("slide needs 3D")

    def rollout_tensor(
        self,
        scenes: Sequence[Scene],
        centres: Sequence[torch.Tensor],
        *,
        frames: int | None = None,
        limit: float | None = None,
        smoothing: float = 0.0,
    ) -> list[torch.Tensor]:
        out = []
        for scene, where in zip(scenes, centres, strict=True):
            start = torch.tensor(fill(scene, self.spacing).positions, dtype=where.dtype)
            # `follow` scales only the derivative: -1 is a net whose gradient has the wrong sign.
            mean = where[:, 1].mean() if len(where) else where.new_tensor(0.8)
            mean = self.follow * mean + (1 - self.follow) * mean.detach()
            length = self.gain * (0.4 + 0.3 * (mean - 0.8))
            stretch = (start[:, 0] - scene.domain.lower[0]) / scene.releases[0].size[0]
            steps = torch.linspace(0, 1, frames or 11, dtype=where.dtype)
            travel = steps[:, None] * length * stretch
            direction = start.new_tensor([1.0, 0.0, 0.0])
            out.append(start + travel[:, :, None] * direction)
        return out

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Callable[[float], None] | None = None
    ) -> list[Trajectory]:
        centres = [
            torch.tensor([b.center for b in s.baffles], dtype=torch.float64).reshape(-1, 2)
            for s in scenes
        ]
        rolled = self.rollout_tensor(scenes, centres)
        return [
            Trajectory(
                positions=positions.numpy(),
                time=np.linspace(0, scene.duration, len(positions)),
                particle_type=np.full(positions.shape[1], MOVING, np.int8),
                scene=scene,
                point_volume=self.spacing**3,
                simulator=self.name,
                settings={"seconds": 30.0},
            )
            for scene, positions in zip(scenes, rolled, strict=True)
        ]


@pytest.fixture(scope="module")
def scenes(flume: Scene) -> list[Scene]:
    layouts = [flume.with_baffles(c) for c in LAYOUTS]
    # At x = 0.7 some of the sliding block is past the section.
    return [s.replace(name=f"layout-{k}", section=0.7) for k, s in enumerate(layouts)]


@pytest.fixture(scope="module")
def references(scenes: list[Scene]) -> list[Trajectory]:
    return Slide().rollout(scenes)


def test_a_simulator_agrees_with_itself(scenes, references):
    comparison = compare(Slide(), references, batch=2)
    numbers = comparison.aggregate()
    for name in JUDGED:
        assert numbers[f"{name}.error"] == 0.0
        assert numbers[f"{name}.bias"] == 0.0
    assert numbers["centroid_travel.slope"] == pytest.approx(1.0)
    assert numbers["centroid_travel.spearman"] == pytest.approx(1.0)
    assert numbers["point_rmse"] == 0.0
    assert numbers["deposit_error"] == pytest.approx(0.0)
    assert numbers["diverged"] == 0.0
    assert numbers["speedup"] > 1
    assert [r.scene for r in comparison.results] == scenes


def test_a_known_error_is_reported_as_it_is(references):
    numbers = compare(Slide(gain=1.1), references).aggregate()
    assert numbers["centroid_travel.error"] == pytest.approx(0.1)
    assert numbers["centroid_travel.bias"] == pytest.approx(0.1)
    assert numbers["centroid_travel.slope"] == pytest.approx(1.1)
    assert numbers["centroid_travel.spearman"] == pytest.approx(1.0)
    ratio = numbers["centroid_travel.spread"] / numbers["centroid_travel.spread_true"]
    assert ratio == pytest.approx(1.1)
    # Every point is off by a tenth of its travel, at most 0.52 m * 0.1 for the front.
    assert 0.01 < numbers["point_rmse"] < 0.052


def test_bias_keeps_the_sign_and_error_does_not(references):
    numbers = compare(Slide(gain=0.9), references).aggregate()
    assert numbers["centroid_travel.error"] == pytest.approx(0.1)
    assert numbers["centroid_travel.bias"] == pytest.approx(-0.1)


def test_a_simulator_that_does_not_answer_to_the_layout_is_found_out(references, scenes):
    """Right on average, the same for every layout: the mean error is small and the slope is 0."""

    class Deaf(Slide):
        def rollout(self, scenes, *, progress=None):
            (one,) = super().rollout([scenes[0].with_baffles([])])
            return [Trajectory(**{**vars(one), "scene": scene}) for scene in scenes]

    numbers = compare(Deaf(), references).aggregate()
    assert numbers["centroid_travel.error"] < 0.2
    assert numbers["centroid_travel.slope"] == pytest.approx(0.0, abs=1e-12)
    assert numbers["centroid_travel.spearman"] is None
    assert numbers["centroid_travel.spread"] == pytest.approx(0.0)
    verdicts = compare(Deaf(), references).verdicts()
    assert verdicts["centroid_travel.slope"] is False
    assert verdicts["centroid_travel.spearman"] is None


def test_scenes_without_baffles_are_not_held_to_the_aims_for_layouts(scenes):
    bare = compare(Slide(1.3), Slide().rollout([s.with_baffles([]) for s in scenes]))
    assert bare.verdicts() == {}
    assert bare.to_dict()["aims"] == {}
    console = Console(width=90, record=True, file=io.StringIO())
    console.print(bare.table())
    text = console.export_text()
    assert "aim" not in text
    assert "30.0%" in text


def test_verdicts_follow_the_aims(references):
    good, bad = compare(Slide(1.005), references), compare(Slide(1.3), references)
    assert set(good.verdicts()) == set(AIMS)
    assert good.verdicts()["centroid_travel.error"] is True
    assert good.verdicts()["centroid_travel.slope"] is True
    assert bad.verdicts()["centroid_travel.error"] is False
    assert bad.verdicts()["centroid_travel.slope"] is False
    # All layouts of `references` lie clear of the sliding block, except where it runs into them.
    inside = sum(r.points_inside for r in bad.results)
    assert inside > 0
    assert bad.verdicts()["points_inside"] is False


def test_a_coarser_filling_can_be_judged(references):
    comparison = compare(Slide(spacing=0.07), references)
    numbers = comparison.aggregate()
    # A lattice of 5 x 3 x 20 for one of 7 x 5 x 28, over the same box.
    assert comparison.results[0].points == 300
    assert references[0].positions.shape[1] == 980
    assert numbers["centroid_travel.error"] == pytest.approx(0.0, abs=1e-9)
    # The nearest point at the start is off by at most 2.5 cm in x of 35, and so in travel.
    assert 0 < numbers["point_rmse"] < 0.025 / 0.35 * 0.6
    assert 0 < numbers["deposit_error"] < 1


def test_rollouts_start_where_their_references_did(plane_scene: Scene):
    """Each from its own filling, be it of a lattice or not, whatever the simulator would choose."""
    shaken = [MpmSimulator(spacing=0.05, jitter=0.3, filling=k) for k in (1, 2)]
    solvers = [*shaken, MpmSimulator(spacing=0.05)]
    references = [solver.rollout([plane_scene])[0] for solver in solvers]
    comparison = compare(MpmSimulator(spacing=0.05), references, batch=2)
    assert [result.point_rmse for result in comparison.results] == [0.0] * 3


@pytest.mark.parametrize(("spacing", "jitter"), [(0.05, 0.3), (0.1, 0.0)])
def test_a_model_starts_likewise_if_its_points_are_as_far_apart(plane_scene, spacing, jitter):
    scene = plane_scene.with_baffles([])
    [reference] = MpmSimulator(spacing=0.05, jitter=0.3, filling=1).rollout([scene])
    config = ModelConfig(
        dim=2, spacing=spacing, radius=0.15, dt=0.02, history=1, latent=8, blocks=1, solver_steps=1
    )
    simulator = LearnedSimulator(LearnedModel(config))
    expected = simulator.refilled(jitter, 1).rollout([scene])[0]
    [result] = compare(simulator, [reference]).results
    assert result.point_rmse == pytest.approx(point_rmse(expected, reference), rel=1e-6)


def test_one_scene_defines_errors_and_no_slope(references):
    numbers = compare(Slide(1.1), references[:1]).aggregate()
    assert numbers["centroid_travel.error"] == pytest.approx(0.1)
    assert numbers["centroid_travel.slope"] is None
    assert numbers["centroid_travel.spearman"] is None


def test_nothing_to_compare_or_a_scene_it_cannot_run_is_an_input_error(plane_scene, trajectory_of):
    with pytest.raises(SimulatorError, match="at least one reference"):
        compare(Slide(), [])
    reference = trajectory_of(np.zeros((2, 3, 2)), plane_scene)
    with pytest.raises(SimulatorError, match="needs 3D"):
        compare(Slide(), [reference])


def test_progress_ends_at_one(references):
    seen: list[float] = []
    compare(Slide(), references, batch=2, progress=seen.append)
    assert seen == pytest.approx([0.4, 0.8, 1.0])


# -- deposits and points ---------------------------------------------------------------------------


def test_deposit_map_keeps_the_volume_and_the_centre(flume: Scene, trajectory_of):
    points = fill(flume, 0.03)
    trajectory = trajectory_of(points.positions[None], flume, point_volume=points.volume)
    deposit = deposit_map(trajectory)
    assert deposit.shape == (36, 36)
    assert deposit.sum() * 0.05**2 == pytest.approx(points.volume * len(points.positions))
    # Inside the block, away from its edges, it is as deep as the filling: 8 layers of 3 cm.
    assert deposit[2:5, 8:28].mean() == pytest.approx(0.24, rel=0.05)
    np.testing.assert_allclose(deposit[2:5, 8:28], 0.24, rtol=0.2)
    assert deposit[8:].max() == 0.0
    z = 0.1 + 0.05 * (np.arange(36) + 0.5)
    assert (deposit.sum(axis=0) * z).sum() / deposit.sum() == pytest.approx(1.0)


def test_deposit_map_holds_points_beyond_the_walls(flume: Scene, trajectory_of):
    corners = np.array([[[-1.0, 0.2, -1.0], [5.0, 0.2, 5.0]]])
    deposit = deposit_map(trajectory_of(corners, flume))
    assert deposit[0, 0] == deposit[-1, -1] == pytest.approx(1e-3 / 0.05**2)


def test_deposit_map_of_a_plane_flow_is_a_profile(plane_scene: Scene, trajectory_of):
    points = fill(plane_scene, 0.01)
    trajectory = trajectory_of(points.positions[None], plane_scene, point_volume=points.volume)
    deposit = deposit_map(trajectory)
    assert deposit.shape == (20,)
    np.testing.assert_allclose(deposit[:3], 0.3, rtol=1e-6)
    assert deposit.sum() * 0.05 == pytest.approx(0.06)


def test_deposit_error_is_the_share_of_mass_elsewhere():
    a = np.array([[1.0, 1.0], [1.0, 1.0]])
    b = np.array([[2.0, 1.0], [1.0, 0.0]])
    assert deposit_error(a, a) == 0.0
    assert deposit_error(a, b) == deposit_error(b, a) == pytest.approx(0.25)
    assert deposit_error(a, 3 * a) == pytest.approx(0.0)
    assert deposit_error(np.array([1.0, 0.0]), np.array([0.0, 2.0])) == pytest.approx(1.0)


def test_point_rmse_compares_displacements(flume: Scene, trajectory_of):
    coarse, fine = fill(flume, 0.06).positions, fill(flume, 0.02).positions
    a = trajectory_of(np.stack([coarse, np.add(coarse, [0.5, 0, 0])]), flume)
    b = trajectory_of(np.stack([fine, np.add(fine, [0.47, 0.04, 0])]), flume)
    assert point_rmse(a, b) == pytest.approx(0.05)
    assert point_rmse(b, b) == 0.0


# -- what leaves the building ----------------------------------------------------------------------


def test_results_as_json_csv_and_table(references, tmp_path: Path):
    comparison = compare(Slide(1.1), references)
    comparison.save(tmp_path / "c.json")
    content = json.loads((tmp_path / "c.json").read_text())
    assert content == comparison.to_dict()
    assert content["scenes"] == 5
    assert content["aims"]["centroid_travel.error"] == [0.0, 0.01]
    comparison.to_csv(tmp_path / "c.csv")
    with open(tmp_path / "c.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    for row, result in zip(rows, comparison.results, strict=True):
        assert json.loads(row["layout"]) == [list(b.center) for b in result.scene.baffles]
        assert float(row["centroid_travel.true"]) == result.true["centroid_travel"]
        assert float(row["runout_p99.predicted"]) == result.predicted["runout_p99"]
    console = Console(width=90, record=True, file=io.StringIO())
    console.print(comparison.table())
    text = console.export_text()
    assert "slide-1.1 against slide-1 over 5 scenes" in text
    (row,) = (line for line in text.splitlines() if "centroid_travel" in line)
    cells = [cell.strip() for cell in row.split("│")[1:-1]]
    assert cells[:6] == ["centroid_travel", "10.0%", "1.0%", "+10.0%", "1.10", "1.00"]


def test_figures_are_written_whole(references, plane_scene: Scene, trajectory_of, tmp_path: Path):
    comparison = compare(Slide(1.1), references)
    scatter_figure(comparison, tmp_path / "scatter.png")
    deposit_figure(comparison, tmp_path / "deposits.png")
    for name in ("scatter.png", "deposits.png"):
        content = (tmp_path / name).read_bytes()
        assert content[:8] == b"\x89PNG\r\n\x1a\n"
        assert content.endswith(b"IEND\xaeB`\x82")
    assert len(list(tmp_path.iterdir())) == 2


def test_figures_of_a_plane_flow(plane_scene: Scene, tmp_path: Path):
    mpm = MpmSimulator(spacing=0.02, frame_interval=0.05)
    comparison = compare(mpm, mpm.rollout([plane_scene]))
    scatter_figure(comparison, tmp_path / "scatter.png")
    deposit_figure(comparison, tmp_path / "deposits.png")
    assert comparison.aggregate()["centroid_travel.error"] == 0.0


def test_the_solver_against_itself_at_half_the_spacing(small_flume: Scene):
    """Real flows: a coarser filling is a few percent off and leaks no point into the baffle."""
    layouts = [small_flume.with_baffles([[0.55, z]]) for z in (0.12, 0.3, 0.42)]
    references = MpmSimulator(spacing=0.02, frame_interval=0.02).rollout(layouts)
    comparison = compare(MpmSimulator(spacing=0.04, frame_interval=0.02), references)
    numbers = comparison.aggregate()
    assert numbers["points_inside"] == 0.0
    assert numbers["diverged"] == 0.0
    assert numbers["centroid_travel.error"] < 0.15
    assert numbers["deposit_error"] < 0.25
    assert numbers["point_rmse"] < 0.12
    assert all(0 < r.true["upstream_depth"] < 0.3 for r in comparison.results)
    assert all(r.true["energy_dissipated"] > 0 for r in comparison.results)
    assert numbers["speedup"] is not None


def test_a_rank_correlation_knows_ranks_only_and_needs_three():
    a = np.random.default_rng(0).normal(size=12)
    assert rank_correlation(a, np.exp(a)) == pytest.approx(1)
    assert rank_correlation(a, -(a**3)) == pytest.approx(-1)
    assert rank_correlation(np.arange(4), np.array([0, 1, 3, 2])) == pytest.approx(0.8)
    assert rank_correlation(a[:2], a[:2]) is None
    assert rank_correlation(a, np.ones(12)) is None


# -- gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize("measure", ["centroid_travel", "runout_p99", "mass_past_section"])
def test_the_gradient_of_a_smooth_flow_equals_its_differences(scenes, measure: str):
    check = gradient_check(Slide(), scenes[2], measure=measure, dtype=torch.float64, step=1e-4)
    assert check.autograd.shape == check.differences.shape == (3, 2)
    assert check.cosine == pytest.approx(1.0, abs=1e-6)
    assert check.ratio == pytest.approx(1.0, abs=1e-3)
    assert check.value == pytest.approx(
        measures.summary(Slide().rollout([scenes[2]])[0])[measure], abs=0.05
    )


def test_known_derivative_of_the_centroid(scenes):
    check = gradient_check(Slide(), scenes[2], dtype=torch.float64)
    # Mean stretch of a lattice of 7 columns in 0.35 m is a half; a third of 0.3 falls to each z.
    np.testing.assert_allclose(check.autograd, [[0, 0.05]] * 3, atol=1e-9)
    np.testing.assert_allclose(check.differences, [[0, 0.05]] * 3, atol=1e-9)


def test_a_gradient_of_the_wrong_sign_or_size_is_found_out(scenes):
    assert gradient_check(Slide(follow=-1.0), scenes[0]).cosine == pytest.approx(-1.0, abs=1e-3)
    half = gradient_check(Slide(follow=0.5), scenes[0], dtype=torch.float64)
    assert half.cosine == pytest.approx(1.0)
    assert half.ratio == pytest.approx(0.5)
    assert gradient_check(Slide(follow=0.0), scenes[0]).cosine == 0.0


def test_gradient_check_refuses_what_it_cannot_do(scenes, flume: Scene):
    with pytest.raises(SimulatorError, match="'mpm' is not differentiable"):
        gradient_check(MpmSimulator(), scenes[0])
    with pytest.raises(SimulatorError, match="no baffle"):
        gradient_check(Slide(), flume.with_baffles([]))
    with pytest.raises(SceneError, match="overlaps"):
        gradient_check(Slide(), flume.with_baffles([[0.8, 1.0], [0.955, 1.0]]))


def test_the_gradient_of_an_untrained_net_is_checked_too(small_flume: Scene):
    """The real network in float64, random weights, over the frames that reach the baffle."""
    torch.manual_seed(0)
    config = ModelConfig(dim=3, spacing=0.05, dt=0.02, radius=0.11, latent=8, blocks=2)
    simulator = LearnedSimulator(LearnedModel(config).double(), name="random")
    check = gradient_check(
        simulator,
        small_flume,
        measure="upstream_depth",
        step=2e-5,
        frames=12,
        temperature=0.03,
        limit=None,
        smoothing=0.0,
    )
    assert np.abs(check.autograd).max() > 1e-6
    np.testing.assert_allclose(check.autograd, check.differences, rtol=1e-3, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["baffle-lite"])  # the one that layouts are chosen with
def test_a_shipped_model_knows_which_way_to_move_a_baffle(name: str, flume: Scene):
    """Over the whole flow; the paper's way of baffles had a cosine of -0.6 here, and our own exact
    gradient 0.26. Measured: 0.78. The aim of 0.9 is not met yet (docs/layouts.md)."""
    simulator = load_simulator(name)
    layout = flume.with_baffles([[0.775, 0.5], [0.80, 1.4], [1.2, 0.95]])
    check = gradient_check(simulator, layout)
    assert check.cosine >= 0.75, (check.autograd, check.differences)
