"""Inverse problems: what made the deposit is found again, and other units are refused."""

import csv
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from design import inverse
from design.cli import app
from design.inverse import calibrate, default_method
from design.target import LEVELS, Deposit, Runout, TargetError, quantiles, read_deposit, read_runout
from design.unknowns import FrictionAngle, ReleaseVelocity, unknown
from gns_model import console
from gns_model.errors import FileFormatError, SceneError, SimulatorError
from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig
from gns_model.learned.checkpoint import save_model
from gns_model.mpm import MpmSimulator


@pytest.fixture(scope="module")
def learned():
    """A small model with random weights that answers to velocity and friction."""
    torch.manual_seed(0)
    config = ModelConfig(
        spacing=0.05, radius=0.08, dt=0.02, history=2, latent=16, blocks=2,
        material_features=("tan_friction_angle", "base_friction"),
    )  # fmt: skip
    model = LearnedModel(config)
    ones = torch.ones(3)
    model.set_normalisation(
        velocity_mean=0 * ones, velocity_std=ones, acceleration_mean=0 * ones,
        acceleration_std=8 * ones,
    )  # fmt: skip
    return LearnedSimulator(model, "small")


@pytest.fixture
def scene(small_flume):
    """Eight steps of the model, which do not reach the far wall."""
    return small_flume.replace(duration=0.16)


def deposit_of(simulator, scene, tmp_path):
    path = tmp_path / "deposit.h5"
    simulator.rollout([scene])[0].save(path)
    return path


# -- the distance ----------------------------------------------------------------------------------


@given(shift=st.tuples(*[st.floats(-0.5, 0.5)] * 3), more=st.integers(1, 4))
def test_distance_of_a_shifted_cloud_is_the_shift(shift, more):
    """Whatever the number of points in either; and zero of a cloud to itself."""
    cloud = torch.from_numpy(np.random.default_rng(0).normal(size=(400, 3)))
    target = Deposit(quantiles(cloud).numpy(), len(cloud), "cloud")
    assert float(target.residuals(cloud[None]).square().sum()) == 0
    repeated = cloud.repeat(more, 1) + torch.tensor(shift)
    expected = sum(s * s for s in shift)
    assert float(target.residuals(repeated[None]).square().sum()) == pytest.approx(
        expected, abs=2e-3
    )


def test_quantiles_are_numpys():
    cloud = np.random.default_rng(0).normal(size=(57, 2))
    levels = (np.arange(LEVELS) + 0.5) / LEVELS
    expected = np.quantile(cloud, levels, axis=0, method="hazen")
    np.testing.assert_allclose(quantiles(torch.from_numpy(cloud)), expected, atol=1e-12)


# -- recovery --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["gradient", "differences"])
def test_velocity_is_recovered(learned, scene, tmp_path, method):
    truth = ReleaseVelocity([0, 2]).put(scene, np.array([1.1, 0.2]))
    target, time = read_deposit(deposit_of(learned, truth, tmp_path), scene)
    assert time == pytest.approx(0.16)
    found = calibrate(scene, learned, target, "velocity", method=method)
    assert found.value == pytest.approx([1.1, 0.2], abs=0.01)
    assert found.distance < 0.005 < 0.03 < found.start_distance
    assert found.start.tolist() == [1.5, 0.0]
    if method == "gradient":
        assert found.backwards == found.rollouts == found.evaluations
        assert found.rollouts_by_differences == 3 * found.evaluations
    else:
        assert found.rollouts == found.rollouts_by_differences
        assert found.backwards == 0


def test_a_gradient_that_leads_nowhere_gives_way_to_differences(
    learned, scene, tmp_path, monkeypatch
):
    right = inverse._Measure._by_gradient

    def wrong(self, value):
        squared, slope = right(self, value)
        return squared, -slope

    monkeypatch.setattr(inverse._Measure, "_by_gradient", wrong)
    truth = ReleaseVelocity([0]).put(scene, np.array([1.2]))
    target, _ = read_deposit(deposit_of(learned, truth, tmp_path), scene)
    found = calibrate(scene, learned, target, "velocity", budget=20)
    assert found.method == "differences"
    assert found.backwards > 0
    assert found.value[0] == pytest.approx(1.2, abs=0.02)


def test_friction_is_recovered_by_gradient(learned, scene, tmp_path):
    truth = FrictionAngle().put(scene, np.array([24.0]))
    target, _ = read_deposit(deposit_of(learned, truth, tmp_path), scene)
    found = calibrate(scene, learned, target, "friction")
    assert found.method == "gradient"
    assert found.value[0] == pytest.approx(24.0, abs=0.7)


def test_friction_is_recovered_by_the_solver(plane_scene, tmp_path):
    solver = MpmSimulator(spacing=0.025, threads=1)
    scene = plane_scene.with_baffles([])
    truth = FrictionAngle().put(scene, np.array([22.0]))
    target, _ = read_deposit(deposit_of(solver, truth, tmp_path), scene)
    found = calibrate(scene, solver, target, "friction", budget=8)
    assert found.method == "differences"
    assert found.value[0] == pytest.approx(22.0, abs=1.0)


def test_runout_tells_the_velocity_along_the_flow(learned, scene):
    truth = ReleaseVelocity([0]).put(scene, np.array([1.2]))
    (track,) = learned.rollout_tensor([truth])
    travel = float(Runout(0.0).residuals(track))
    found = calibrate(scene, learned, read_runout(travel, scene), "velocity")
    assert found.value == pytest.approx([1.2], abs=0.02)


def test_a_budget_is_kept_and_what_there_is_is_told(learned, scene, tmp_path):
    truth = ReleaseVelocity([0]).put(scene, np.array([0.6]))
    target, _ = read_deposit(deposit_of(learned, truth, tmp_path), scene)
    found = calibrate(scene, learned, target, "velocity", budget=2)
    assert (found.status, found.rollouts) == ("budget", 2)
    assert found.distance < found.start_distance

    def interrupt(done, *_):
        if done == 2:
            raise KeyboardInterrupt

    found = calibrate(scene, learned, target, "velocity", progress=interrupt)
    assert (found.status, found.evaluations) == ("interrupted", 2)


# -- what cannot be --------------------------------------------------------------------------------


def test_simulators_that_cannot(scene):
    config = ModelConfig(spacing=0.05, radius=0.08, latent=8, blocks=1)
    blind = LearnedSimulator(LearnedModel(config), "blind")
    with pytest.raises(SimulatorError, match=r"blind does not see the friction.*mpm or"):
        default_method(blind, "friction", None)
    with pytest.raises(SimulatorError, match="no gradient"):
        default_method(MpmSimulator(spacing=0.05), "velocity", "gradient")
    config = config.model_copy(update={"solver_steps": 5})
    begun = LearnedSimulator(LearnedModel(config), "begun")
    assert default_method(begun, "velocity", None) == "differences"
    with pytest.raises(SimulatorError, match="first steps"):
        default_method(begun, "velocity", "gradient")
    release = scene.releases[0]
    above = release.model_copy(
        update={"lower": (0.0, 0.25, 0.1), "upper": (0.2, 0.4, 0.5), "velocity": (1.0, -1.0, 0.0)}
    )
    with pytest.raises(SceneError, match="not looked for"):
        unknown("velocity", scene.replace(releases=(release, above)), Runout(0.1))


def write_points(path, points, names="xyz"):
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(names)
        rows.writerows(points.tolist())
    return path


@pytest.fixture
def points(scene):
    """A deposit's body in the scene's domain [m]."""
    return np.random.default_rng(0).uniform([0.1, 0.0, 0.1], [0.6, 0.1, 0.5], (200, 3))


def test_tables_of_points(scene, points, tmp_path):
    found, time = read_deposit(write_points(tmp_path / "d.csv", points), scene)
    assert time is None
    assert found.points == 200
    np.testing.assert_allclose(found.quantiles, quantiles(torch.from_numpy(points)), atol=1e-12)
    other = write_points(tmp_path / "d.csv", points[:, [2, 0, 1]], names=["Z", " x", "y"])
    np.testing.assert_array_equal(read_deposit(other, scene)[0].quantiles, found.quantiles)


@pytest.mark.parametrize(
    ("scale", "word"), [(1000, "millimetres"), (100, "centimetres"), (1e-3, "kilometres")]
)
def test_other_units_are_named(scene, points, tmp_path, scale, word):
    path = write_points(tmp_path / "d.csv", points * scale)
    with pytest.raises(TargetError, match=f"is it in {word}"):
        read_deposit(path, scene)
    if scale > 1:
        with pytest.raises(TargetError, match=f"is it in {word}"):
            read_runout(0.4 * scale, scene)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("x,y\n1,2\n", "no column 'z'"),
        ("x_mm,y_mm,z_mm\n1,2,3\n", "is it in metres"),
        ("x,y,z\n" + "0.1,0.1,0.1\n" * 9, "9 points are no deposit"),
        ("x,y,z\n0.1,0.1\n", "line 2 is no point"),
        ("x,y,z\n0.1,0.1,high\n", "line 2 is no point"),
        ("x,y,z\n" + "0.1,nan,0.1\n" * 20, "not finite"),
        ("x,y,z\n" + "0.1,0.1,0.1\n" * 20, "no deposit in the domain"),
        ("", "no column 'x'"),
    ],
)
def test_tables_that_are_no_deposits(scene, tmp_path, content, words):
    path = tmp_path / "d.csv"
    path.write_text(content)
    with pytest.raises((FileFormatError, TargetError), match=words) as refused:
        read_deposit(path, scene)
    assert str(path) in str(refused.value)


def test_flows_of_other_scenes(scene, trajectory_of, tmp_path):
    path = tmp_path / "d.h5"
    for other, word in (
        (scene.with_baffles([]), "baffle"),
        (scene.replace(gravity=(0.0, -5.0, 0.0)), "gravity"),
        (scene.replace(domain={"lower": (0, 0, 0), "upper": (1.0, 0.6, 0.6)}), "domain"),
    ):
        trajectory_of(np.full((2, 50, 3), 0.2), other).save(path)
        with pytest.raises(TargetError, match=f"another {word}"):
            read_deposit(path, scene)
    trajectory_of(np.full((2, 50, 3), 0.2), scene, status="diverged").save(path)
    with pytest.raises(TargetError, match="diverged"):
        read_deposit(path, scene)


def test_runouts_that_cannot_be(scene):
    for runout in (-1.0, math.nan, 7.0):
        with pytest.raises(TargetError, match="runout"):
            read_runout(runout, scene)


def run_calibrate(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        console.main(app, "gns-design", ["calibrate", *map(str, arguments), "--quiet"])
    return left.value.code


def test_the_command(learned, scene, tmp_path, capsys):
    scene.to_toml(tmp_path / "scene.toml")
    save_model(tmp_path / "model", learned.model)
    truth = ReleaseVelocity([0, 2]).put(scene, np.array([1.1, 0.0]))
    common = [tmp_path / "scene.toml", "--parameter", "velocity", "--simulator", tmp_path / "model"]
    target = ["--target", deposit_of(learned, truth, tmp_path)]
    out = ["--out", tmp_path / "found.toml"]
    assert run_calibrate(*common, *target, "--json", "--budget", "3", *out) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["found"]["velocity along x"] == pytest.approx(1.1, abs=0.1)
    assert values["rollouts_by_differences"] == 3 * values["rollouts"]
    written = type(scene).from_toml(tmp_path / "found.toml")
    assert written.releases[0].velocity[0] == values["found"]["velocity along x"]
    assert written.duration == scene.duration
    assert run_calibrate(*common, *target, "--budget", "2") == 0
    out = capsys.readouterr().out
    assert "2 rollouts and 2 backward passes; finite differences take 6 rollouts" in out


def test_the_command_refuses_in_one_line(scene, points, tmp_path, capsys):
    scene.to_toml(tmp_path / "scene.toml")
    millimetres = write_points(tmp_path / "mm.csv", 1000 * points)
    metres = write_points(tmp_path / "m.csv", points)
    friction = ["--parameter", "friction"]
    for arguments, words in (
        (["--target", millimetres, *friction], "millimetres"),
        (
            ["--target", metres, *friction, "--simulator", "baffle-lite"],
            "does not see the friction",
        ),
        (["--target", tmp_path / "none.h5", *friction], "no such file"),
        (["--target", tmp_path / "scene.toml", *friction], "trajectory file"),
        (["--target", metres, "--runout", "0.1", *friction], "--runout"),
        (friction, "--target"),
        (["--target", metres], "--parameter"),
        (["--target", metres, "--parameter", "cohesion"], "cohesion"),
        (["--target", metres, *friction, "--budget", "0"], "--budget"),
    ):
        before = sorted(tmp_path.iterdir())
        assert run_calibrate(tmp_path / "scene.toml", *arguments) == 2
        captured = capsys.readouterr()
        assert captured.err.startswith("error: ")
        assert captured.err.count("\n") == 1, captured.err
        assert words in captured.err
        assert captured.out == ""
        assert sorted(tmp_path.iterdir()) == before
