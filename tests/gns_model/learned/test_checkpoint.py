from __future__ import annotations

import json
import pickle
import warnings

import numpy as np
import pytest
import torch

from gns_model.errors import FileFormatError, GnsError, SimulatorError
from gns_model.learned import load_model, read_card, save_model, shipped_models
from gns_model.learned.checkpoint import CARD, WEIGHTS
from gns_model.simulator import load_simulator


@pytest.fixture
def saved(make_model, tmp_path):
    return save_model(
        tmp_path / "tiny", make_model(), {"scores": {"centroid": 0.01}, "config": "ignored"}
    )


def test_round_trip(make_model, make_scene, saved):
    simulator = load_simulator(saved)
    assert (simulator.name, simulator.card["scores"]) == ("tiny", {"centroid": 0.01})
    model = make_model()
    assert simulator.config == model.config
    for name, value in model.state_dict().items():
        assert torch.equal(simulator.model.state_dict()[name], value)
    assert np.isfinite(simulator.rollout([make_scene()])[0].positions).all()
    assert simulator.card["parameters"] == sum(p.numel() for p in model.parameters())
    assert simulator.card["normalisation"]["acceleration_std"] == [4.0] * 3
    assert load_model(saved, workers=2, precision="bfloat16").workers == 2


def test_saving_again_replaces_and_leaves_nothing_else(make_model, saved):
    save_model(saved, make_model(seed=9), {"name": "other"})
    assert sorted(p.name for p in saved.iterdir()) == [CARD, WEIGHTS]
    assert load_model(saved).name == "other"


def test_a_card_that_is_not_json_is_refused_before_anything_is_written(make_model, tmp_path):
    with pytest.raises((TypeError, ValueError)):
        save_model(tmp_path / "x", make_model(), {"scores": {"loss": float("nan")}})
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.99, None])
def test_truncated_or_missing_files_are_named(saved, name, keep):
    content = (saved / name).read_bytes()
    (saved / name).unlink()
    if keep is not None:
        (saved / name).write_bytes(content[: int(keep * len(content))])
    with pytest.raises(FileFormatError, match=name) as error:
        load_model(saved)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "not the card"),
        ({"version": 2}, "version 2"),
        ({"version": None}, "version None"),
        ({"config": None}, "config"),
    ],
)
def test_foreign_cards(saved, change, message):
    card = {**read_card(saved), **change}
    (saved / CARD).write_text(json.dumps(card))
    with pytest.raises(FileFormatError, match=message):
        load_model(saved)


def test_weights_whose_card_was_not_written_any_more_bring_their_own(make_model, saved):
    """A process that is killed between the two files leaves new weights beside an old card."""
    old = (saved / CARD).read_bytes()
    model = make_model(seed=9)
    save_model(saved, model, {"name": "new"})
    (saved / CARD).write_bytes(old)
    simulator = load_model(saved)
    assert simulator.name == "new"
    for a, b in zip(model.parameters(), simulator.model.parameters(), strict=True):
        assert torch.equal(a, b)
    weights = bytearray((saved / WEIGHTS).read_bytes())
    weights[-3] ^= 1
    (saved / WEIGHTS).write_bytes(weights)
    with pytest.raises(FileFormatError, match="not the weights"):
        load_model(saved)


def test_unknown_setting_and_misfit_are_named(saved):
    card = read_card(saved)
    for config, message in (({"wings": 2}, "config.wings"), ({"latent": 8}, "do not fit")):
        changed = {**card, "config": {**card["config"], **config}}
        (saved / CARD).write_text(json.dumps(changed))
        with pytest.raises(FileFormatError, match=message):
            load_model(saved)


def test_other_things_at_the_path(tmp_path):
    file = tmp_path / "model.pt"
    file.write_bytes(pickle.dumps({"a": 1}))
    for path in (tmp_path, file):
        with pytest.raises(GnsError):
            load_model(path)
    (tmp_path / CARD).write_text("[1]")
    with pytest.raises(FileFormatError, match="not the card"):
        load_model(tmp_path)
    with pytest.raises(SimulatorError, match="no simulator named"):
        load_simulator(tmp_path / "nowhere")


def test_unusable_device(saved):
    for device in ("cuda:99", "toaster"):
        with pytest.raises(SimulatorError, match="device"):
            load_model(saved, device=device)


def test_shipped_models_can_be_loaded_by_name():
    for name in shipped_models():
        assert load_simulator(name).name == name


def test_a_model_that_misses_its_aims_says_so_when_it_is_loaded(make_model, tmp_path):
    model = make_model()
    save_model(tmp_path / "poor", model, {"verdict": "misses its aims"})
    with pytest.warns(UserWarning, match="poor: misses its aims"):
        load_model(tmp_path / "poor")
    save_model(tmp_path / "good", model)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_model(tmp_path / "good")
