"""What a GPU asks of the code, tried on a stand-in for one (`tests/faux_cuda.py`).

There is no GPU here. On the stand-in every tensor has to be where it is used, as on a GPU, and the
arithmetic is the CPU's: so what comes out is what comes out on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from typer.testing import CliRunner

from gns_model import load_simulator
from gns_model.cli import app
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.mpm.torch_solver import TorchMpmSimulator
from gns_model.scene import Scene
from gns_model.smooth_measures import smooth_measures
from gns_model.training import Recipe, train
from gns_model.trajectory import Trajectory
from tests.faux_cuda import FauxCuda, faux_cuda, on_both

MODELS: dict[str, dict[str, Any]] = {
    "as baffle-lite": {},
    "the paper's": {"baffles": "points", "types": 9, "walls": "clip", "envelope": False},
    "depth and material": {"depth_range": 0.1, "material_features": ("tan_friction_angle",)},
    "strain": {"strain_unit": 0.3},
    "solver first": {"solver_steps": 2},
    "crowding": {"crowding_limit": 1.2},
}
RECIPE: dict[str, Any] = {
    "steps": 2,
    "edges_per_batch": 800,
    "statistics_windows": 8,
    "valid_rollouts": 2,
    "valid_windows": 4,
    "model": {"spacing": 0.05, "dt": 0.02, "radius": 0.08, "latent": 8, "blocks": 2},
}
#: What a batch can be about and what can be asked of it.
PHASES: dict[str, dict[str, Any]] = {
    "windows": {
        "linear_beyond": 0.25, "momentum_weight": 0.5, "local_weight": 0.5, "front_weight": 1.0,
        "strain_weight": 0.5, "relative_to": 0.1, "scenes_alike": True, "acceleration_noise": 0.3,
    },
    "unrolled": {"unroll": 2, "unroll_fraction": 0.5, "return_steps": 8},
    "through the unrolled": {"unroll": 2, "unroll_fraction": 1, "backprop_through_unroll": True},
    "replay": {"replay": 2, "replay_memory": 8, "return_steps": 4, "unroll_fraction": 1},
    "whole flows": {
        "flow_share": 1, "flow_steps": 3, "flow_edges": 2000, "unroll_fraction": 1,
        "optimiser": "descent",
    },
}  # fmt: skip


def scene(dim: int) -> Scene:
    plan = [0.45, 0.25][: dim - 1]
    depth = {2: ([], []), 3: ([0.0], [0.5])}[dim]
    release = {2: ([], []), 3: ([0.1], [0.4])}[dim]
    return Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0, *depth[0]], "upper": [1.0, 0.5, *depth[1]]},
            "release": [
                {
                    "lower": [0.0, 0.0, *release[0]],
                    "upper": [0.25, 0.2, *release[1]],
                    "velocity": [1.5, 0.0, 0.0][:dim],
                }
            ],
            "baffle": [{"center": plan, "size": [0.1, 0.2, 0.1][:dim]}],
            "section": 0.4,
            "duration": 0.1,
        }
    )


def model(dim: int, options: dict[str, Any]) -> LearnedModel:
    torch.manual_seed(0)
    return LearnedModel(
        ModelConfig(dim=dim, spacing=0.05, radius=0.08, latent=8, blocks=2, **options)
    )


def refused(act: Callable[[], object]) -> bool:
    try:
        act()
    except (RuntimeError, TypeError):
        return True
    return False


def test_the_stand_in_refuses_what_cuda_refuses_and_nothing_else():
    here, index = torch.ones(3), torch.tensor([0, 2])
    with faux_cuda():
        there, far = here.to("cuda"), index.to("cuda")
        assert there.device.type == "cuda"
        assert refused(lambda: there + here)
        assert refused(lambda: torch.cat([there, here]))
        assert refused(lambda: here[far])
        assert refused(lambda: torch.zeros(3).index_add_(0, far, torch.ones(2)))
        assert refused(lambda: there.numpy())
        assert refused(lambda: np.asarray(there))
        assert refused(lambda: torch.nn.Linear(3, 2)(there))
        assert (there + torch.tensor(1.0)).tolist() == [2.0] * 3  # a number
        assert there[index].tolist() == there[[0, 2]].tolist() == [1.0] * 2
        assert there.cpu().numpy().sum() == float(there.sum()) == 3
        # views, gradients and weights that move there
        there[1:] = 5.0
        assert (here.tolist(), there.tolist()) == ([1.0] * 3, [1.0, 5.0, 5.0])
        layer = torch.nn.Linear(3, 1).to("cuda")
        layer(there[None]).sum().backward()
        assert isinstance(layer.weight.grad, FauxCuda)
        assert layer.weight.grad.tolist() == [[1.0, 5.0, 5.0]]
    if not torch.cuda.is_available():
        with pytest.raises((RuntimeError, AssertionError), match="CUDA"):
            here.to("cuda")


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_rollout(dim, name):
    def run(device: str) -> np.ndarray:
        simulator = LearnedSimulator(model(dim, MODELS[name]).to(device))
        return simulator.rollout([scene(dim), scene(dim).replace(duration=0.06)])[0].positions

    here, there = on_both(run)
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-6)


def test_a_rollout_in_bfloat16():
    def run(device: str) -> Trajectory:
        return load_simulator("baffle-lite", device=device, precision="bfloat16").rollout(
            [scene(3)]
        )[0]

    here, there = on_both(run)
    assert there.status == here.status == "ok"
    np.testing.assert_allclose(there.positions, here.positions, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", [name for name in MODELS if name != "solver first"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_gradient_through_a_rollout(dim, name):
    flow = scene(dim)

    def run(device: str) -> list[list[float]]:
        simulator = LearnedSimulator(model(dim, MODELS[name]).to(device))
        centres = torch.tensor([flow.baffles[0].center], device=device).requires_grad_()
        speed = torch.tensor(flow.releases[0].velocity, device=device).requires_grad_()
        [positions] = simulator.rollout_tensor(
            [flow], [centres], velocities=[speed], frames=5, limit=6.0, smoothing=0.2
        )
        found = smooth_measures(positions, flow, centres, flow.baffles[0].size)
        sum(found.values()).backward()
        return [*centres.grad.tolist(), speed.grad.tolist()]

    here, there = on_both(run)
    for one, two in zip(here, there, strict=True):
        np.testing.assert_allclose(two, one, rtol=1e-3, atol=1e-5)
    assert np.abs(here[-1]).sum() > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_one_step_from_arrays(dim):
    options = {"baffles": "none", "types": 9, "bounds": ((0.0, 1.0),) * dim,
               "material_features": ("tan_friction_angle",)}  # fmt: skip
    history = np.random.default_rng(0).uniform(0.4, 0.6, (20, 4, dim)).astype(np.float32)

    def run(device: str) -> np.ndarray:
        simulator = LearnedSimulator(model(dim, options).to(device))
        return np.asarray(simulator.predict_positions(history, material=0.5))

    here, there = on_both(run)
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_torch_solver(dim):
    flow = scene(dim).replace(duration=0.04)

    def run(device: str) -> np.ndarray:
        solver = TorchMpmSimulator(spacing=0.05, frame_interval=0.02, device=device)
        return solver.rollout([flow] * 2)[1].positions

    here, there = on_both(run)
    np.testing.assert_array_equal(there, here)


def test_generate_writes_the_same_flows(tmp_path):
    def run(device: str) -> list[Trajectory]:
        out = tmp_path / device
        arguments = ["generate", "--family", "columns", "--count", "2", "--solver", "torch",
                     "--spacing", "0.2", "--batch", "2", "--device", device]  # fmt: skip
        found = CliRunner().invoke(app, [*arguments, "--out", str(out)])
        assert found.exit_code == 0, found.output
        return [Trajectory.load(file) for file in sorted(out.glob("*.h5"))]

    here, there = on_both(run)
    assert len(here) == len(there) == 2
    for one, two in zip(here, there, strict=True):
        np.testing.assert_array_equal(two.positions, one.positions)


@pytest.fixture(scope="module")
def flows(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("flows")
    solver = TorchMpmSimulator(spacing=0.05, frame_interval=0.02)
    for k, flow in enumerate(solver.rollout([scene(3).replace(duration=0.2)] * 2)):
        flow.save(folder / f"{k}.h5")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", PHASES)
def test_training_makes_the_same_weights_and_goes_on_from_its_checkpoint(name, flows, tmp_path):
    held_out = [str(flows)] if name == "windows" else []
    values = {**RECIPE, "train": [str(flows)], "valid": held_out, **PHASES[name]}

    def run(device: str) -> dict[str, torch.Tensor]:
        out = tmp_path / device
        for steps in (1, 2):
            train(Recipe.from_dict({**values, "device": device, "steps": steps}), out)
        return load_file(out / "state.safetensors")

    here, there = on_both(run)
    assert here.keys() == there.keys()
    for key, value in here.items():
        torch.testing.assert_close(there[key], value, rtol=1e-3, atol=1e-5, msg=key)
