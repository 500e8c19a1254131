"""The network of Choi & Kumar at its own size: latent 128, ten blocks, five velocities."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig, World
from gns_model.learned.edge_kernel import add_messages
from gns_model.learned.network import Block
from gns_model.learned.world import baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY, fill
from gns_model.scene import Scene

DIMS = pytest.mark.parametrize("dim", [2, 3])
RULES = pytest.mark.parametrize("rule", ["residual", "doubled"])

#: Parameters of the paper, in its section on the network.
PAPER = {2: 1_591_826, 3: 1_592_979}


# -- size ----------------------------------------------------------------------------------------


def mlp(inputs: int, outputs: int, *, norm: bool = True, width: int = 128) -> int:
    """Weights and biases of two hidden layers and an output, gain and shift of a LayerNorm."""
    linear = (inputs + 1) * width + (width + 1) * width + (width + 1) * outputs
    return linear + 2 * outputs * norm


@DIMS
def test_the_choices_that_give_the_papers_number_exactly(dim):
    config = ModelConfig.paper(dim)
    vertex = 5 * dim + 2 * dim + 16  # five velocities, walls, and the embedding of the type
    edge = dim + 1  # displacement and its norm
    assert (config.vertex_inputs + config.type_embedding, config.edge_inputs) == (vertex, edge)
    count = (
        9 * 16  # a table of nine types, of which three occur
        + mlp(vertex, 128)
        + mlp(edge, 128)
        + 10 * (mlp(3 * 128, 128) + mlp(2 * 128, 128))  # every block has its own weights
        + mlp(128, dim, norm=False)
    )
    assert count == PAPER[dim]
    model = LearnedModel(config)
    assert sum(p.numel() for p in model.parameters()) == count
    assert len(list(model.parameters())) == 183
    # No running statistics, no shared weights, nothing else that is saved but the normalisation.
    assert {k for k, _ in model.named_buffers()} == {
        f"{a}_{b}" for a in ("velocity", "acceleration") for b in ("mean", "std")
    }


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"types": 0, "baffles": "none"}, -(9 * 16 + 16 * 128)),
        ({"types": 7}, -2 * 16),
        ({"material_features": ("tan_friction_angle",)}, 128),
        ({"relative_velocity": True}, 2 * 128),
        ({"history": 3}, -2 * 2 * 128),
        ({"self_edges": True, "edge_update": "doubled", "wall_clip": 2.0}, 0),
    ],
)
def test_other_choices_give_other_numbers(options, difference):
    config = ModelConfig.model_validate({**ModelConfig.paper(2).model_dump(), **options})
    count = sum(p.numel() for p in LearnedModel(config).parameters())
    assert count - PAPER[2] == difference


# -- message passing -----------------------------------------------------------------------------


class Product(nn.Module):
    """phi = (v_i + v_j) * e and gamma = aggregate, in place of a block's two MLPs."""

    def __init__(self, width: int, parts: tuple[float, ...]) -> None:
        super().__init__()
        self.weights = [part * torch.eye(width) for part in parts]
        self.layers = [nn.Linear(width, width, bias=False)]

    def split_first(self, *_widths: int) -> list[Tensor]:
        return self.weights

    def over_edges(self, edge, senders, receivers, _dtype, _first, terms, _envelope):
        message = (terms[0][receivers] + terms[1][senders]) * edge
        return edge + message, add_messages(torch.zeros_like(terms[0]), receivers, message)

    def after_first(self, hidden: Tensor) -> Tensor:
        return hidden


def test_worked_example_of_message_passing():
    vertex = torch.tensor([[1.0, 0, 2], [1, 3, 2], [1, 1, 1], [2, 1, 2]])
    senders, receivers = torch.tensor([1, 2, 3]), torch.tensor([0, 0, 0])
    e01 = torch.tensor([2.0, 1, 0])
    # Edges whose messages are those of the paper, [0, 3, 9] and [3, 4, 9].
    wanted = torch.tensor([[0.0, 3, 9], [3, 4, 9]])
    edge = torch.stack([e01, *(wanted / (vertex[0] + vertex[2:]))])
    block = Block(3, lambda *_sizes: Product(3, (1, 1, 1)))  # type: ignore[arg-type]
    block.vertex = Product(3, (0, 1))  # type: ignore[assignment]
    after, updated = block(vertex, edge, senders, receivers, None, torch.float32)
    messages = updated - edge
    assert messages[0].tolist() == [4, 3, 0]
    torch.testing.assert_close(messages[1:], wanted)
    torch.testing.assert_close(after[0] - vertex[0], torch.tensor([7.0, 10, 18]))
    torch.testing.assert_close(after[0], torch.tensor([8.0, 10, 20]))
    assert torch.equal(after[1:], vertex[1:])  # who sends does not receive


# -- the whole model -----------------------------------------------------------------------------


def paper_model(dim: int, rule: str, dtype: torch.dtype = torch.float32) -> LearnedModel:
    """Random weights that move points by some tenths of a millimetre a step."""
    torch.manual_seed(dim)
    config = ModelConfig.model_validate(
        {
            **ModelConfig.paper(dim).model_dump(),
            "edge_update": rule,
            "self_edges": rule == "doubled",
        }
    )
    model = LearnedModel(config)
    model.set_normalisation(
        velocity_mean=torch.zeros(dim),
        velocity_std=torch.ones(dim),
        acceleration_mean=torch.zeros(dim),
        acceleration_std=torch.full((dim,), 200.0),
    )
    return model.to(dtype)


def scene(dim: int, shift: float = 0.0, cells: int = 5, duration: float = 0.0125) -> Scene:
    """A small mass about to run into a small barrier; lengths in spacings of its points."""
    unit = ModelConfig.paper(dim).spacing  # type: ignore[arg-type]

    def at(*point: float) -> list[float]:
        return [unit * p + shift for p in point[:dim]]

    return Scene.from_dict(
        {
            "domain": {"lower": at(0, 0, 0), "upper": at(30, 20, 20)},
            "release": [
                {
                    "lower": at(2, 0, 6),
                    "upper": at(2 + cells, cells, 9),
                    "velocity": [2.0, 0.0, 0.5][:dim],
                }
            ],
            "baffle": [
                {"center": [at(10)[0], at(0, 0, 8)[-1]][: dim - 1], "size": [unit * 3] * dim}
            ],
            "duration": duration,
        }
    )


def state(model: LearnedModel, scene: Scene, seed: int = 0) -> tuple[Tensor, World]:
    """A disordered history of grains and barrier points, and its world."""
    config, dtype = model.config, model.velocity_std.dtype
    grains = torch.tensor(fill(scene, config.spacing).positions, dtype=dtype)
    fixed = baffle_points(baffle_boxes(scene, dtype=dtype), config.spacing)
    points = torch.cat([grains, fixed])
    kind = torch.tensor([MOVING] * len(grains) + [STATIONARY] * len(fixed))
    walk = torch.randn(
        len(points), config.history + 1, config.dim, dtype=torch.float64,
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip
    walk = 1e-3 * walk.cumsum(1).to(dtype) * (kind == MOVING)[:, None, None]
    world = World.from_scenes([scene], [len(points)], particle_type=kind, dtype=dtype)
    return points[:, None] + walk, world


@RULES
def test_edge_latents_change_from_block_to_block(rule):
    model = paper_model(2, rule)
    seen: list[tuple[Tensor, Tensor]] = []
    for block in model.network.blocks:
        block.register_forward_hook(lambda _m, args, out: seen.append((args[1], out[1])))
    with torch.no_grad():
        model.acceleration(*state(model, scene(2)))
    assert len(seen) == 10
    for before, after in seen:
        if rule == "doubled":  # weights of before December 2024 know nothing else
            assert torch.equal(after, 2 * before)
            continue
        message = after - before
        assert message.std() > 0.5  # that of a LayerNorm
        assert (message - before).std() > 0.5
        # A message of its own for every edge, not one for all.
        assert message.std(0).mean() > 0.1


@DIMS
@RULES
def test_permutation_and_translation(dim, rule):
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float64, 1e-9)):
        model, here = paper_model(dim, rule, dtype), scene(dim)
        history, world = state(model, here)
        order = torch.randperm(len(history), generator=torch.Generator().manual_seed(1))
        mixed = World.from_scenes(
            [here], [len(history)], particle_type=world.particle_type[order], dtype=dtype
        )
        shift = 0.375
        moved = World.from_scenes(
            [scene(dim, shift)], [len(history)], particle_type=world.particle_type, dtype=dtype
        )
        with torch.no_grad():
            after = model.step(history, world)
            permuted = model.step(history[order], mixed)
            translated = model.step(history + shift, moved)
            assert (after[order] - permuted).abs().max() <= tolerance
            assert (after + shift - translated).abs().max() <= tolerance
            moving = world.moving
            drift = 2 * history[:, -1] - history[:, -2]
            assert (after - drift)[moving].abs().max() > 1e-4  # the network has a say
            assert torch.equal(after[~moving], history[~moving, -1])


@DIMS
@RULES
def test_a_batch_equals_single_rollouts(dim, rule):
    simulator = LearnedSimulator(paper_model(dim, rule))
    scenes = [
        scene(dim),
        scene(dim, cells=4, duration=0.005),
        scene(dim, shift=0.25).with_baffles([]),
    ]
    together = simulator.rollout(scenes)
    for one, found in zip(scenes, together, strict=True):
        (alone,) = simulator.rollout([one])
        assert found.status == alone.status == "ok"
        assert found.positions.shape == alone.positions.shape
        assert np.abs(found.positions - alone.positions).max() <= 1e-5
    free = together[0].positions[0] + 0.0125 * np.array([2.0, 0.0, 0.5][:dim])
    assert np.abs(together[0].positions[-1] - free).max() > 1e-3


@RULES
def test_checkpointed_backward_equals_plain(rule):
    simulator = LearnedSimulator(paper_model(2, rule))
    scenes = [scene(2, cells=3), scene(2, shift=0.25, cells=4)]
    gradients = []
    for checkpoint in (True, False):
        centres = [torch.tensor([b.center for b in s.baffles], requires_grad=True) for s in scenes]
        tracks = simulator.rollout_tensor(scenes, centres, frames=4, checkpoint=checkpoint)
        sum(t[-1].square().sum() for t in tracks).backward()
        gradients.append(torch.cat([c.grad for c in centres]))
    assert gradients[0].abs().min() > 1e-6
    assert (gradients[0] - gradients[1]).abs().max() <= 1e-6 * gradients[1].abs().max()


@RULES
def test_gradients_against_central_differences(rule):
    model = paper_model(2, rule, torch.float64)
    history, world = state(model, scene(2, cells=4))
    leaves = [history.clone().requires_grad_(), *model.parameters()]
    generator = torch.Generator().manual_seed(6)
    weight = torch.randn(history[:, 0].shape, generator=generator).double()

    def objective() -> Tensor:
        return (model.acceleration(leaves[0], world) * weight).sum()

    gradients = torch.autograd.grad(objective(), leaves)
    # A kink of a ReLU between the two sides would show, so they are close together.
    step = 1e-10
    for chosen in ([0], range(1, len(leaves))):
        ways = {k: torch.randn(leaves[k].shape, generator=generator).double() for k in chosen}
        sides = []
        with torch.no_grad():
            for move in (step, -2 * step):
                for k, way in ways.items():
                    leaves[k] += move * way
                sides.append(objective())
            for k, way in ways.items():
                leaves[k] += step * way
        numeric = (sides[0] - sides[1]) / (2 * step)
        analytic = sum((gradients[k] * way).sum() for k, way in ways.items())
        assert abs(analytic) > 1
        assert abs(numeric - analytic) <= 1e-4 * abs(analytic)
