"""Imported weights predict what geoelements/gns predicted."""

from __future__ import annotations

import json
import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from gns_model import load_simulator
from gns_model.errors import FileFormatError, SimulatorError
from gns_model.interop.weights import import_model
from gns_model.learned import LearnedSimulator, radius_graph, save_model
from gns_model.learned.world import World
from gns_model.scene import Scene

from .geoelements import metadata, motion, predict, random_state

REFERENCE = Path(__file__).parent / "reference"
NOISE = 6.7e-4
RULES = pytest.mark.parametrize("rule", ["residual", "doubled"])


def expected(rule: str) -> dict[str, np.ndarray]:
    """The reference case, with what the old rule made of it in place of the new."""
    case = dict(np.load(REFERENCE / "case.npz"))
    if rule == "doubled":
        case.update(np.load(REFERENCE / "expected_legacy_pre94.npz"))
    return case


@pytest.fixture(scope="module", params=["residual", "doubled"])
def reference(request, tmp_path_factory):
    """The reference checkpoint, imported, saved and loaded again, and what it should say."""
    model, card = import_model(
        REFERENCE / "model-0.pt",
        REFERENCE / "metadata.json",
        edge_update=request.param,
        noise_std=NOISE,
    )
    folder = save_model(tmp_path_factory.mktemp("imported") / "reference", model, card)
    return load_simulator(folder), expected(request.param)


def test_next_positions_and_accelerations(reference):
    simulator, case = reference
    sequence, types = case["position_sequence"], case["particle_types"]
    after = simulator.predict_positions(sequence, types)
    assert isinstance(after, np.ndarray)
    assert np.abs(after - case["predicted_next_positions"]).max() <= 1e-6
    world = World.from_bounds(simulator.config.bounds, torch.from_numpy(types))
    acceleration = simulator.model.acceleration(torch.from_numpy(sequence), world).numpy()
    assert np.abs(acceleration - case["predicted_normalised_acceleration"]).max() <= 5e-5


def test_gradient(reference):
    simulator, case = reference
    sequence = torch.from_numpy(case["position_sequence"]).requires_grad_()
    after = simulator.predict_positions(sequence, torch.from_numpy(case["particle_types"]))
    moving = case["particle_types"] != 3
    (gradient,) = torch.autograd.grad(after[moving, 0].mean(), sequence)
    wanted = case["dnextx_dsequence"]
    assert np.linalg.norm(gradient.numpy() - wanted) <= 1e-3 * np.linalg.norm(wanted)


def test_rollout_with_stationary_points_put_back(reference):
    simulator, case = reference
    types, trajectory = case["particle_types"], case["trajectory"]
    sequence = trajectory[:6].transpose(1, 0, 2)
    for k, wanted in enumerate(case["rollout_predicted"]):
        after = simulator.predict_positions(sequence, types)
        after = np.where((types == 3)[:, None], trajectory[6 + k], after)
        assert np.abs(after - wanted).max() <= 5e-6
        sequence = np.concatenate([sequence[:, 1:], after[:, None]], axis=1)


def test_training_loss_and_its_gradients(reference):
    simulator, case = reference
    model = simulator.model.requires_grad_(True)
    noisy = torch.from_numpy(case["batch_position_sequence"] + case["batch_noise"])
    types = torch.from_numpy(case["batch_particle_types"])
    counts = case["batch_counts"].tolist()
    found = torch.cat(
        [
            model.acceleration(h, World.from_bounds(simulator.config.bounds, t))
            for h, t in zip(noisy.split(counts), types.split(counts), strict=True)
        ]
    )
    assert np.abs(found.detach().numpy() - case["batch_predicted_acc"]).max() <= 5e-5
    dt, last = simulator.config.dt, torch.from_numpy(case["batch_noise"][:, -1])
    following = torch.from_numpy(case["batch_next_positions"]) + last
    true = (following - 2 * noisy[:, -1] + noisy[:, -2]) / dt**2
    target = (true - model.acceleration_mean) / model.acceleration_std
    assert np.abs(target.numpy() - case["batch_target_acc"]).max() <= 5e-4
    square = (found - torch.from_numpy(case["batch_target_acc"])).square().sum(1)
    loss = square[types != 3].mean()
    assert float(loss.detach()) == pytest.approx(float(case["batch_loss"]), rel=1e-5)
    loss.backward()
    for ours, theirs in (
        (model.type_embedding.weight, "batch_grad_type_embedding"),
        (model.network.decode.layers[0].weight, "batch_grad_decoder_nn0_weight"),
    ):
        wanted = torch.from_numpy(case[theirs])
        assert (ours.grad - wanted).norm() <= 1e-3 * wanted.norm()
    total = torch.stack([p.grad.norm() for p in model.parameters() if p.grad is not None]).norm()
    assert float(total) == pytest.approx(float(case["batch_grad_norm"]), rel=1e-3)
    model.requires_grad_(False).zero_grad()


def test_graph_is_theirs():
    case = expected("residual")
    senders, receivers = radius_graph(
        torch.from_numpy(case["position_sequence"][:, -1]), 0.03, self_edges=True
    )
    ours = set(zip(senders.tolist(), receivers.tolist(), strict=True))
    assert ours == set(map(tuple, case["edge_index"].T.tolist()))


def written(folder: Path, state: object, about: dict) -> tuple[Path, Path]:
    torch.save(state, folder / "model-7.pt")
    (folder / "metadata.json").write_text(json.dumps(about))
    return folder / "model-7.pt", folder / "metadata.json"


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", [False, True])
@pytest.mark.parametrize(("types", "embedding"), [(9, 16), (1, 16), (4, 5)])
@RULES
def test_any_size_and_feature(tmp_path, dim, material, types, embedding, rule):
    state = random_state(dim, types=types, embedding=embedding, material=material)
    about = metadata(dim, boundary_augment=1.7)
    files = written(tmp_path, state, about)
    model, _ = import_model(*files, edge_update=rule, noise_std=3e-4)
    sequence, kinds, friction = motion(dim)
    kinds = kinds % types
    given = friction if material else None
    options = {"noise_std": 3e-4, "edge_update": rule}
    single = sequence.clone().requires_grad_()
    found = LearnedSimulator(model).predict_positions(single, kinds, given)
    (gradient,) = torch.autograd.grad(found[:, 0].sum(), single)
    exact = sequence.double().requires_grad_()
    wanted, normalised = predict(state, about, exact, kinds, given, **options)
    (slope,) = torch.autograd.grad(wanted[:, 0].sum(), exact)
    assert (found - wanted).abs().max() <= 1e-6
    assert (gradient - slope).norm() <= 1e-3 * slope.norm()
    # The network has a say: far more than the tolerance.
    drift = 2 * sequence[:, -1] - sequence[:, -2]
    assert (wanted - drift).abs().max() > 1e-4
    world = World.from_bounds(model.config.bounds, kinds, tan_friction=given)
    assert (model.acceleration(sequence, world) - normalised).abs().max() <= 5e-5


def test_textbook_of_these_tests_is_the_reference():
    case = expected("residual")
    state = torch.load(REFERENCE / "model-0.pt", weights_only=True)
    about = json.loads((REFERENCE / "metadata.json").read_text())
    after, _ = predict(
        state,
        about,
        torch.from_numpy(case["position_sequence"]),
        torch.from_numpy(case["particle_types"]),
        None,
        noise_std=NOISE,
        edge_update="residual",
    )
    assert np.abs(after.numpy() - case["predicted_next_positions"]).max() <= 1e-6


@pytest.mark.parametrize("dim", [2, 3])
def test_the_papers_network_has_the_papers_parameters(tmp_path, dim):
    state = random_state(dim, latent=128, hidden=128, blocks=10)
    assert len(state) == 183
    model, _ = import_model(
        *written(tmp_path, state, metadata(dim)), edge_update="doubled", noise_std=NOISE
    )
    count = sum(p.numel() for p in model.parameters())
    assert count == {2: 1_591_826, 3: 1_592_979}[dim]


def test_prefixes_and_wrappers_of_training_scripts(tmp_path):
    plain = random_state()
    ddp = {f"module.{k}": v for k, v in plain.items()}
    sequence, kinds, _ = motion(2)
    found = []
    for state in (plain, ddp, {"model_state_dict": plain, "step": 3, "loss": 0.5}):
        files = written(tmp_path, state, metadata())
        model, _ = import_model(*files, edge_update="residual", noise_std=NOISE)
        found.append(LearnedSimulator(model).predict_positions(sequence, kinds))
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_rollout_section_counts_and_dt_changes_nothing_but_the_units(tmp_path):
    about = metadata(bounds=[[0.1, 0.9], [0.1, 0.9]])
    split = {"train": metadata(), "rollout": about}
    sequence, kinds, _ = motion(2)
    found = []
    for content in (about, split, {**about, "dt": 0.02}, {k: about[k] for k in about if k != "dt"}):
        files = written(tmp_path, random_state(), content)
        model, card = import_model(*files, edge_update="residual", noise_std=NOISE)
        found.append(LearnedSimulator(model).predict_positions(sequence, kinds))
    assert torch.equal(found[0], found[1])
    assert (found[0] - found[2]).abs().max() <= 1e-6
    assert torch.equal(found[0], found[3])
    assert model.config.dt == 0.0025
    assert "dt" in card["imported"]["assumed"]
    model, _ = import_model(*files, edge_update="residual", noise_std=NOISE, dt=0.01, spacing=0.02)
    assert (model.config.dt, model.config.spacing) == (0.01, 0.02)


def changed(**changes: torch.Tensor | None) -> dict[str, torch.Tensor]:
    state = {**random_state(), **changes}
    return {k: v for k, v in state.items() if v is not None}


BLOCK = "_encode_process_decode._processor.gnn_stacks.1.edge_fn.0.NN-1.weight"
NORM = "_encode_process_decode._encoder.node_fn.1.bias"
ENTRY = "_encode_process_decode._encoder.node_fn.0.NN-0.weight"


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"weight": torch.zeros(3, 3)}, "no matrix"),
        (changed(**{BLOCK: None}), "gnn_stacks.1.edge_fn.0.NN-1.weight is missing"),
        (changed(**{BLOCK: torch.zeros(10, 11)}), r"has shape \(10, 11\)"),
        (changed(**{NORM: None}), "node_fn.1.bias is missing"),
        (changed(**{ENTRY: torch.zeros(10, 32)}), "sees 30 or 31 numbers of a vertex, this one 32"),
        (changed(extra=torch.zeros(1)), "extra is unknown"),
        (changed(**{NORM: torch.full((12,), torch.nan)}), "not finite"),
        ({"a": 1}, "not a state_dict"),
        ([1, 2], "not a state_dict"),
        (random_state(3), "dim = 2, but the weights"),
    ],
)
def test_another_architecture_is_one_clear_line(tmp_path, state, words):
    files = written(tmp_path, state, metadata())
    with pytest.raises(FileFormatError, match=words) as caught:
        import_model(*files, edge_update="residual", noise_std=NOISE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("about", "words"),
    [
        (metadata(vel_mean=[0.0]), "vel_mean has 1 numbers, but dim = 2"),
        (metadata(acc_std=[0.1, -0.1]), "acc_std must not be negative"),
        (metadata(bounds=[[0.1, 0.9]]), "bounds has 1 pairs"),
        (metadata(bounds=[[0.9, 0.1], [0, 1]]), "ordered"),
        (metadata(dim=4), "dim = 4"),
        (metadata(default_connectivity_radius=0), "default_connectivity_radius = 0"),
        (metadata(nnode_in=31), "nnode_in = 31, but the weights .* are for 30"),
        ({k: v for k, v in metadata().items() if k != "acc_std"}, "'acc_std' is missing"),
        ({"train": metadata()}, "no 'rollout'"),
        ({}, "missing"),
    ],
)
def test_metadata_that_does_not_fit_is_one_clear_line(tmp_path, about, words):
    files = written(tmp_path, random_state(), about)
    with pytest.raises(FileFormatError, match=words) as caught:
        import_model(*files, edge_update="residual", noise_std=NOISE)
    assert "\n" not in str(caught.value)
    assert "metadata.json" in str(caught.value)


def test_no_noise_and_no_deviation_is_refused(tmp_path):
    files = written(tmp_path, random_state(), metadata(vel_std=[0.0, 0.1]))
    with pytest.raises(FileFormatError, match="must exceed 0"):
        import_model(*files, edge_update="residual", noise_std=0.0)
    import_model(*files, edge_update="residual", noise_std=1e-4)
    with pytest.raises(FileFormatError, match="noise-std"):
        import_model(*files, edge_update="residual", noise_std=float("nan"))


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("was-run"),)


def test_nothing_in_a_checkpoint_is_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = written(tmp_path, {**random_state(), "bomb": Bomb()}, metadata())
    with pytest.raises(FileFormatError, match="cannot be read safely"):
        import_model(*files, edge_update="residual", noise_std=NOISE)
    files[0].write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(FileFormatError, match="cannot be read safely"):
        import_model(*files, edge_update="residual", noise_std=NOISE)
    assert not Path("was-run").exists()
    for content in (b"", b"PK\x03\x04", b"\x80\x02}q\x00."):
        files[0].write_bytes(content)
        with pytest.raises(FileFormatError, match="model-7"):
            import_model(*files, edge_update="residual", noise_std=NOISE)
    with pytest.raises(FileFormatError, match="no such file"):
        import_model("nowhere.pt", files[1], edge_update="residual", noise_std=NOISE)


# -- scenes --------------------------------------------------------------------------------------


def scene(**changes) -> Scene:
    return Scene.from_dict(
        {
            "domain": {"lower": [0.1, 0.1], "upper": [0.9, 0.5]},
            "release": [{"lower": [0.1, 0.1], "upper": [0.2, 0.2], "velocity": [1.0, 0.0]}],
            "baffle": [{"center": [0.25], "size": [0.05, 0.1]}],
            "duration": 0.0125,
            **changes,
        }
    )


def test_rolls_out_scenes_with_baffles_as_points(tmp_path):
    files = written(tmp_path, random_state(), metadata())
    model, _ = import_model(*files, edge_update="residual", noise_std=NOISE)
    simulator = LearnedSimulator(model, "imported")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, other = simulator.rollout([scene(), scene(baffle=[])])
    assert one.status == other.status == "ok"
    assert one.positions.shape == other.positions.shape == (6, 81, 2)
    assert np.abs(one.positions[-1] - other.positions[-1]).max() > 1e-5  # it feels the baffle


def test_a_scene_outside_its_limits_warns(tmp_path):
    files = written(tmp_path, random_state(), metadata())
    model, _ = import_model(*files, edge_update="residual", noise_std=NOISE)
    fast = {"lower": [0.1, 0.1], "upper": [0.2, 0.2], "velocity": [9.0, 0.0]}
    tilted = scene(gravity=[3.0, -9.0], release=[fast])
    with pytest.warns(UserWarning, match="imported was trained on") as caught:
        LearnedSimulator(model, "imported").check(tilted)
    said = " ".join(str(w.message) for w in caught)
    assert all(word in said for word in ("max_speed = 9", "gravity", "slope"))


def test_models_that_scenes_cannot_drive_say_so(tmp_path):
    for types, words in ((1, "does not see baffles"), (5, "types 0 to 4")):
        files = written(tmp_path, random_state(types=types), metadata())
        model, _ = import_model(*files, edge_update="residual", noise_std=NOISE)
        with pytest.raises(SimulatorError, match=words):
            LearnedSimulator(model).check(scene())
    files = written(tmp_path, random_state(types=1), metadata())
    model, _ = import_model(*files, edge_update="residual", noise_std=NOISE)
    assert LearnedSimulator(model).rollout([scene(baffle=[])])[0].status == "ok"
