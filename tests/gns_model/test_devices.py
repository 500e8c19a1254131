"""On a GPU every tensor has to be made where the model is, and there is none here to try it on.

So the roles are changed: the model is on the CPU and torch's default device is "meta", whose
tensors hold nothing. Whoever forgets to say where a tensor belongs makes one there, and the first
sum of it with one that is on the CPU fails, as it would between CPU and GPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest
import torch

from gns_model.data.windows import WindowIndex
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.mpm.torch_solver import TorchMpmSimulator
from gns_model.scene import Scene
from gns_model.smooth_measures import smooth_measures
from gns_model.training.batches import collate
from gns_model.training.flows import flow_gradient
from gns_model.training.loss import Emphasis, unrolled_loss

MODELS = {
    "as baffle-lite": {},
    "the paper's": {"baffles": "points", "types": 9, "walls": "clip", "envelope": False},
    "depth and material": {"depth_range": 0.1, "material_features": ("tan_friction_angle",)},
    "strain": {"strain_unit": 0.3},
    "solver first": {"solver_steps": 2},
    "crowding": {"crowding_limit": 1.2},
}


@contextmanager
def default_elsewhere() -> Iterator[None]:
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device("cpu")


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


def model(dim: int, options: dict) -> LearnedModel:
    torch.manual_seed(0)
    return LearnedModel(
        ModelConfig(dim=dim, spacing=0.05, radius=0.08, latent=8, blocks=2, **options)
    )


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_rollout_says_where(dim, name, precision):
    simulator = LearnedSimulator(model(dim, MODELS[name]), precision=precision)
    here = simulator.rollout([scene(dim)] * 2)[1].positions
    with default_elsewhere():
        there = simulator.rollout([scene(dim)] * 2)[1].positions
    np.testing.assert_array_equal(there, here)


@pytest.mark.parametrize("name", [name for name in MODELS if name != "solver first"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_gradient_through_a_rollout_says_where(dim, name):
    simulator = LearnedSimulator(model(dim, MODELS[name]))
    flow = scene(dim)
    centres = torch.tensor([flow.baffles[0].center], requires_grad=True)
    speed = torch.tensor(flow.releases[0].velocity, requires_grad=True)
    with default_elsewhere():
        [positions] = simulator.rollout_tensor(
            [flow], [centres], velocities=[speed], frames=5, limit=6.0, smoothing=0.2
        )
        found = smooth_measures(positions, flow, centres, flow.baffles[0].size)
        sum(found.values()).backward()
    assert torch.isfinite(centres.grad).all()
    assert speed.grad.abs().sum() > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_one_step_from_arrays_says_where(dim):
    options = {"baffles": "none", "types": 9, "bounds": ((0.0, 1.0),) * dim,
               "material_features": ("tan_friction_angle",)}  # fmt: skip
    simulator = LearnedSimulator(model(dim, options))
    history = np.random.default_rng(0).uniform(0.4, 0.6, (20, 4, dim)).astype(np.float32)
    with default_elsewhere():
        assert simulator.predict_positions(history, material=0.5).shape == (20, dim)


@pytest.fixture(scope="module")
def flows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flows")
    solver = TorchMpmSimulator(spacing=0.05, frame_interval=0.02)
    for k, flow in enumerate(solver.rollout([scene(3)] * 2)):
        flow.save(folder / f"{k}.h5")
    return folder


@pytest.mark.parametrize("backprop", [False, True])
def test_a_training_loss_says_where(backprop, flows):
    net = model(3, {"depth_range": 0.1, "dt": 0.02})
    windows = WindowIndex([flows], spacing=0.05, dt=0.02, history=3, unroll=2)
    with default_elsewhere():
        batch = collate(
            [windows.read(0, 0), windows.read(1, 2)],
            noise_std=1e-4,
            rng=np.random.default_rng(0),
            device=torch.device("cpu"),
        )
        emphasis = Emphasis(
            linear_beyond=0.25, momentum_weight=0.5, front_weight=1.0, scenes_alike=True
        )
        loss = unrolled_loss(net, batch, emphasis, steps=2, backprop=backprop, return_steps=8)
        loss.backward()
    assert loss.item() > 0


def test_the_error_of_a_whole_flow_says_where(flows):
    net = model(3, {"depth_range": 0.1, "dt": 0.02})
    windows = WindowIndex([flows], spacing=0.05, dt=0.02, history=3)
    assert windows.sources[0].scene.baffles
    with default_elsewhere():
        found = flow_gradient(
            net, [windows.read(k, 0, unroll=2) for k in (0, 1)], list(net.parameters()),
            clip_norm=1.0, context=nullcontext(), device=torch.device("cpu"),
        )  # fmt: skip
    assert found.item() > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_the_torch_solver_says_where(dim):
    solver = TorchMpmSimulator(spacing=0.05, frame_interval=0.02)
    flow = scene(dim).replace(duration=0.04)
    here = solver.rollout([flow] * 2)[1].positions
    with default_elsewhere():
        there = solver.rollout([flow] * 2)[1].positions
    np.testing.assert_array_equal(there, here)
