"""The torch solver is the numba solver: same motion, same statuses, alone or in a batch."""

from dataclasses import is_dataclass, replace

import numpy as np
import pytest
import torch

from gns_model import paper
from gns_model.data.scenes import draw
from gns_model.errors import SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.mpm.problem import Discretisation, pose
from gns_model.mpm.torch_batch import Batch, State
from gns_model.mpm.torch_solver import TorchMpmSimulator
from gns_model.mpm.torch_transfer import advance
from gns_model.mpm.transfer import COLUMNS, NODE_COLUMNS, STRAIN, advance_serial
from gns_model.scene import Scene
from gns_model.simulator import Simulator, load_simulator

CPU = torch.device("cpu")
ON_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

COLUMN = paper.column_scene(paper.COLUMNS[2]).replace(name="column", duration=0.1)
FLYING = Scene.from_dict(
    {
        "name": "two squares that fly against each other, a floor, a wall and a baffle",
        "domain": {"lower": (0.2, -0.3), "upper": (1.37, 0.8)},
        "release": [
            {"lower": (0.3, -0.2), "upper": (0.5, 0.0), "velocity": (2.0, -1.5)},
            {"lower": (0.6, -0.28), "upper": (0.85, -0.1), "velocity": (-1.0, 0.4)},
        ],
        "baffle": [{"center": (1.0,), "size": (0.1, 0.2)}],
        "friction": {"base": 0.4, "walls": 0.2, "baffles": 0.5},
        "material": {"friction_angle": 20.0, "youngs_modulus": 1e6},
        "duration": 0.3,
    }
)
BLOCK = Scene.from_dict(
    {
        "name": "a block that hits two touching baffles and one that is flush with a rough wall",
        "domain": {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 0.5, 0.6)},
        "release": [
            {"lower": (0.05, 0.0, 0.0), "upper": (0.35, 0.3, 0.6), "velocity": (2.5, 0.0, -0.3)}
        ],
        "baffle": [
            {"center": (0.45, 0.35), "size": (0.1, 0.3, 0.1)},
            {"center": (0.45, 0.25), "size": (0.1, 0.2, 0.1)},
            {"center": (0.55, 0.05), "size": (0.2, 0.2, 0.1)},
        ],
        "friction": {"base": 0.6, "walls": 0.3, "baffles": 0.7},
        "duration": 0.2,
    }
)
TURNED = BLOCK.replace(
    name="a block that hits two turned baffles and one along the axes between them",
    baffles=(
        {"center": (0.45, 0.15), "size": (0.08, 0.3, 0.2), "yaw": 30.0},
        {"center": (0.5, 0.3), "size": (0.1, 0.2, 0.06)},
        {"center": (0.45, 0.45), "size": (0.15, 0.2, 0.1), "yaw": -50.0},
    ),
)
TOSSED = draw("barriers", 2, 1).replace(duration=0.12)
SPACING = {2: 0.025, 3: 0.04}


def posed(scene, **chosen):
    return pose(scene, Discretisation(spacing=SPACING[scene.dim], **chosen))


def by_numba(problem, substeps):
    """Position, velocity, stress and strain of the points, float64, after so many substeps."""
    dim, friction = problem.scene.dim, problem.scene.friction
    points, ids = np.zeros((problem.count, COLUMNS)), np.arange(problem.count)
    points[:, :dim] = problem.start.positions
    points[:, 3 : 3 + dim] = problem.start.velocities
    points, ids, _, _ = advance_serial(
        points, ids, np.empty_like(points), np.empty_like(ids),
        np.zeros((len(problem.solid), NODE_COLUMNS)), problem.lattice,
        (0, 1, 2) if dim == 3 else (0,), problem.solid, problem.boxes, problem.turned,
        problem.turns, problem.gravity, problem.constants, problem.point_mass,
        problem.start.volume, friction.base, friction.walls, friction.baffles, problem.lower,
        problem.upper, problem.keep, problem.dt, substeps,
    )  # fmt: skip
    points = points[np.argsort(ids)]
    return points[:, :dim], points[:, 3 : 3 + dim], points[:, 15:21], points[:, STRAIN]


def by_torch(problems, substeps, device=CPU):
    """The same for every scene of a batch."""
    state, batch = State.start(problems, device), Batch.of(problems, device)
    with torch.no_grad():
        for _ in range(substeps):
            advance(state, batch)
    stress = state.stress.T[:, [0, 1, 2, 5, 3, 4]]
    values = (state.position, state.velocity, stress, state.strain)
    return [[v[part].cpu().numpy() for v in values] for part in batch.parts]


def assert_same(one, other, *, metres):
    np.testing.assert_allclose(one[0], other[0], rtol=0, atol=metres)
    np.testing.assert_allclose(one[1], other[1], rtol=0, atol=1e3 * metres)
    for a, b in zip(one[2:], other[2:], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(a).max())


@pytest.mark.parametrize("scene", [COLUMN, FLYING, BLOCK, TURNED, TOSSED], ids=lambda s: s.name)
def test_equals_numba_over_100_substeps_and_at_the_end(scene):
    problem = posed(scene)
    assert_same(by_numba(problem, 100), by_torch([problem], 100)[0], metres=1e-9)
    a = MpmSimulator(spacing=problem.start.spacing).rollout([scene])[0]
    b = TorchMpmSimulator(spacing=problem.start.spacing).rollout([scene])[0]
    np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(a.time, b.time)
    np.testing.assert_array_equal(a.lattice, b.lattice)
    assert (a.status, a.simulator, a.point_volume) == (b.status, b.simulator, b.point_volume)
    assert a.settings["substep"] == b.settings["substep"]
    moved = np.abs(b.positions[-1] - b.positions[0]).max()
    assert moved > 0.01, "nothing happened: the test would show nothing"


@pytest.mark.parametrize("boundary", ["base", "walls", "baffles"])
@pytest.mark.parametrize("scene", [BLOCK, FLYING], ids=["3d", "2d"])
def test_the_scenes_rub_on_every_boundary(scene, boundary):
    """Else the comparison above would not cover it."""
    friction = {**scene.friction.model_dump(), boundary: 0.0}
    simulator = MpmSimulator(spacing=SPACING[scene.dim])
    rough, smooth = simulator.rollout([scene, scene.replace(friction=friction)])
    assert np.abs(rough.positions[-1] - smooth.positions[-1]).max() > 1e-3


def test_starts_from_the_filling_that_numba_starts_from():
    chosen = {"spacing": SPACING[2], "jitter": 0.3, "filling": 4}
    [ours] = TorchMpmSimulator(**chosen).rollout([COLUMN])
    [theirs] = MpmSimulator(**chosen).rollout([COLUMN])
    np.testing.assert_allclose(ours.positions, theirs.positions, atol=1e-6)
    assert not np.array_equal(ours.positions[0], posed(COLUMN).start.positions)


@pytest.mark.parametrize("scenes", [(COLUMN, FLYING), (BLOCK, TOSSED, draw("flume", 4, 3))])
def test_a_batch_is_its_scenes_alone(scenes):
    problems = [posed(s) for s in scenes]
    assert len({p.dt for p in problems}) > 1, "substeps should differ"
    together = by_torch(problems, 60)
    for problem, one in zip(problems, together, strict=True):
        assert_same(by_torch([problem], 60)[0], one, metres=1e-12)


def test_scenes_of_any_dimension_and_duration_end_each_at_its_own_time():
    scenes = [BLOCK.replace(duration=0.06), COLUMN, TOSSED.replace(duration=0.03), FLYING]
    seen = []
    simulator = TorchMpmSimulator(spacing=0.05, batch=3)
    together = simulator.rollout(scenes, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    for scene, one in zip(scenes, together, strict=True):
        assert one.scene == scene
        assert len(one.time) == round(scene.duration / 0.01) + 1
        alone = simulator.rollout([scene])[0]
        np.testing.assert_allclose(alone.positions, one.positions, rtol=0, atol=1e-9)


def test_a_diverged_scene_is_marked_and_leaves_the_others_alone():
    # Three times the stable substep blows up a scene sooner or later: at its first contact with
    # the base, or after half a second of free fall, out of round-off.
    thrown = [
        Scene.from_dict(
            {
                "domain": {"lower": (0.0, 0.0), "upper": (4.0, 2.0)},
                "release": [{"lower": (1.0, y), "upper": (1.5, y + 0.8), "velocity": (3.0, v)}],
                "duration": t,
            }
        )
        for y, v, t in ((0.0, 0.0, 0.4), (0.0, -3.0, 0.4), (1.1, 0.0, 0.2))
    ]
    chosen = {"spacing": 0.05, "cfl": 3.0, "frame_interval": 0.05}
    theirs = MpmSimulator(**chosen).rollout(thrown)
    ours = TorchMpmSimulator(**chosen).rollout(thrown)
    for a, b, status in zip(theirs, ours, ["diverged", "diverged", "ok"], strict=True):
        assert a.status == b.status == status
        assert np.isfinite(b.positions).all()
        np.testing.assert_array_equal(
            (np.diff(a.positions, axis=0) == 0).all(axis=(1, 2)),
            (np.diff(b.positions, axis=0) == 0).all(axis=(1, 2)),
        )  # the last good frame is repeated from the same frame on
    np.testing.assert_allclose(ours[2].positions, theirs[2].positions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("poison", [float("nan"), 1e3, -1e300])
def test_nothing_that_a_scene_holds_reaches_its_neighbours(poison):
    problems = [posed(FLYING), posed(COLUMN), posed(FLYING)]
    state, batch = State.start(problems, CPU), Batch.of(problems, CPU)
    with torch.no_grad():
        state.position[batch.parts[1]] = poison
        state.velocity[batch.parts[1]] = poison
        for _ in range(20):
            advance(state, batch)
    alone = by_torch([problems[0]], 20)[0]
    for part in (batch.parts[0], batch.parts[2]):
        np.testing.assert_allclose(state.position[part].numpy(), alone[0], rtol=0, atol=1e-12)
    if np.isnan(poison):
        assert not (state.velocity[batch.parts[1]].abs() < problems[1].limit).all()


def without_values(part):
    """The same tensors on the meta device, which has shapes and no values."""
    if isinstance(part, torch.Tensor):
        return part.to("meta")
    if is_dataclass(part):
        fields = {key: without_values(value) for key, value in vars(part).items()}
        return replace(part, **fields)
    if isinstance(part, (list, tuple)):
        return type(part)(without_values(value) for value in part)
    return part


@pytest.mark.parametrize("scene", [BLOCK, FLYING], ids=["3d", "2d"])
def test_a_substep_never_waits_for_a_value_and_makes_nothing_on_another_device(scene):
    """What a GPU needs: on the meta device either one is an error."""
    problems = [posed(scene)]
    state, batch = State.start(problems, CPU), Batch.of(problems, CPU)
    state, batch = without_values(state), without_values(batch)
    with torch.no_grad():
        advance(state, batch)
    assert state.position.is_meta
    with pytest.raises((RuntimeError, NotImplementedError)):
        float(state.position.sum())


def test_an_interrupt_passes_through():
    def interrupt(fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TorchMpmSimulator(spacing=0.1).rollout([FLYING], progress=interrupt)


@pytest.mark.parametrize(
    "bad",
    [{"spacing": 0.0}, {"batch": 0}, {"device": "quantum"}, {"device": "meta"}, {"cuda_graph": 1}],
)
def test_options_that_make_no_sense_are_refused(bad):
    with pytest.raises(SimulatorError, match=next(iter(bad))):
        TorchMpmSimulator(**bad)
    with pytest.raises(SimulatorError, match="too large"):
        TorchMpmSimulator(spacing=0.0001).check(BLOCK)


def test_the_reference_solver_on_a_gpu_is_this_one():
    assert isinstance(load_simulator("mpm"), MpmSimulator)
    assert isinstance(TorchMpmSimulator(), Simulator)
    if torch.cuda.is_available():
        assert isinstance(load_simulator("mpm", device="cuda"), TorchMpmSimulator)
    else:
        with pytest.raises(SimulatorError, match="not there"):
            load_simulator("mpm", device="cuda")


@ON_GPU
@pytest.mark.parametrize("cuda_graph", [False, True])
def test_cuda_equals_numba(cuda_graph):
    scenes = [BLOCK, COLUMN, TOSSED, FLYING]
    theirs = MpmSimulator(spacing=0.04).rollout(scenes)
    simulator = TorchMpmSimulator(spacing=0.04, device="cuda", cuda_graph=cuda_graph)
    for a, b in zip(theirs, simulator.rollout(scenes), strict=True):
        assert a.status == b.status
        np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-6)


@ON_GPU
def test_cuda_equals_numba_over_100_substeps():
    for scenes in ((COLUMN, FLYING), (BLOCK, TOSSED)):
        problems = [posed(s) for s in scenes]
        for problem, one in zip(problems, by_torch(problems, 100, "cuda"), strict=True):
            assert_same(by_numba(problem, 100), one, metres=1e-9)
