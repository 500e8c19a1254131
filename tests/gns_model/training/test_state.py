"""The state of a run: whole, or refused with its name."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from safetensors.torch import save_file

from gns_model.errors import FileFormatError
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.training.schedule import MovingAverage
from gns_model.training.state import Position, parse_state, read_position, restore, save_state
from gns_model.training.statistics import Statistics

STATISTICS = Statistics((1.0, 2.0, 0.0), 0.5, (0.0, 9.8, 0.0), 4.0, (15.0,) * 8)


def parts(latent=8, seed=0, steps=0):
    torch.manual_seed(seed)
    model = LearnedModel(ModelConfig(latent=latent, blocks=1))
    average = MovingAverage(model, 0.9)
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for k in range(steps):
        for p in model.parameters():
            p.grad = torch.randn_like(p)
        optimiser.step()
        average.update(model, k)
    return model, average, optimiser


def load_state(path, *into):
    """Read a state into model, average and optimiser, as a run that goes on does."""
    position, tensors = parse_state(path.read_bytes(), path)
    restore(tensors, *into, path)
    return position


@pytest.fixture
def saved(tmp_path):
    model, average, optimiser = parts(steps=3)
    STATISTICS.apply(model)
    position = Position(3, 12.5, 1.75, 10.0, 11.0, STATISTICS, {"latent": 8}, 0)
    path = tmp_path / "state.safetensors"
    save_state(path, position, model, average, optimiser)
    return path, position, model, average, optimiser


def test_a_state_comes_back_bit_for_bit(saved):
    path, position, *before = saved
    after = parts(seed=1)
    assert load_state(path, *after) == position == read_position(path)
    for a, b in zip(before[0].state_dict().values(), after[0].state_dict().values(), strict=True):
        assert torch.equal(a, b)
    for name, weights in before[1].weights.items():
        assert torch.equal(weights, after[1].weights[name])
    # The next step of the optimiser is the same, too.
    for model, _, optimiser in (before, after):
        for p in model.parameters():
            p.grad = torch.ones_like(p)
        optimiser.step()
    for a, b in zip(before[0].parameters(), after[0].parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("keep", [0, 6, 100, 0.5, 0.99])
def test_a_truncated_state_is_named(saved, keep):
    path = saved[0]
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    with pytest.raises(FileFormatError, match=r"state\.safetensors"):
        load_state(path, *parts())


def test_foreign_files_and_newer_versions_are_named(saved, tmp_path):
    other = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(1)}, other)
    with pytest.raises(FileFormatError, match=r"other\.safetensors"):
        read_position(other)
    metadata = {"format": "gns-training-state", "version": "99", "position": "{}"}
    save_file({"x": torch.zeros(1)}, other, metadata=metadata)
    with pytest.raises(FileFormatError, match="version 99"):
        read_position(other)


def test_the_state_of_another_architecture_is_refused(saved):
    with pytest.raises(FileFormatError, match="another architecture"):
        load_state(saved[0], *parts(latent=16))


def test_saving_leaves_no_other_file(saved):
    assert [p.name for p in saved[0].parent.iterdir()] == ["state.safetensors"]
    position = dataclasses.replace(saved[1], step=4)
    save_state(saved[0], position, *saved[2:])
    assert read_position(saved[0]).step == 4
