"""A model begins with the weights of another one, and sees at first no more than it did."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gns_model.data.windows import WindowIndex
from gns_model.learned.checkpoint import load_model, save_model
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.scene import Scene
from gns_model.training import Recipe, RecipeError, train
from gns_model.training.batches import collate
from gns_model.training.transfer import inherit

SIZE = {"spacing": 0.0625, "dt": 0.02, "radius": 0.1, "latent": 8, "blocks": 2}


def build(seed: int = 0, **changes) -> LearnedModel:
    torch.manual_seed(seed)
    model = LearnedModel(ModelConfig(**{**SIZE, **changes}))
    for name in ("velocity", "acceleration"):
        getattr(model, f"{name}_mean").normal_()
        getattr(model, f"{name}_std").uniform_(0.5, 2.0)
    return model


@pytest.fixture
def parent(tmp_path):
    model = build()
    return save_model(tmp_path / "parent", model), model


def batch(slides):
    """With noise, or there would be no strain for a model to see."""
    windows = WindowIndex([slides], spacing=0.0625, dt=0.02, history=3)
    return collate(
        [windows.read(k, 4, mixture=k) for k in (0, 1)],
        noise_std=1e-3,
        rng=np.random.default_rng(0),
        device=torch.device("cpu"),
    )


def assert_one_step(child, model, given):
    """Both move the points of a batch alike."""
    with torch.no_grad():
        before = model.step(given.history, given.world)
        after = child.step(given.history, given.world)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-7)


def test_weights_and_normalisation_are_copied(parent):
    folder, model = parent
    child = build(seed=1, noise_std=1e-5)
    inherit(child, str(folder))
    for key, value in model.state_dict().items():
        assert torch.equal(child.state_dict()[key], value)


@pytest.mark.parametrize("types", [0, 9])
@pytest.mark.parametrize(
    ("more", "new"),
    [
        ({"material_features": ("base_friction", "tan_friction_angle")}, 2),
        ({"depth_range": 0.1}, 4),
        ({"depth_range": 0.1, "material_features": ("base_friction",)}, 5),
        ({"strain_unit": 0.3}, 10),
        ({"depth_range": 0.1, "strain_unit": 0.3, "material_features": ("base_friction",)}, 15),
    ],
)
def test_new_features_change_nothing_at_first(tmp_path, slides, types, more, new):
    """Also with a type embedding, whose inputs come after those of the material."""
    given = batch(slides)
    model = build(types=types)
    folder = save_model(tmp_path / "parent", model)
    child = build(seed=1, types=types, **more)
    inherit(child, str(folder))
    assert_one_step(child, model, given)
    # But they can be learned: their weights have gradients.
    child.acceleration(given.history, given.world).square().mean().backward()
    first = child.network.encode_vertex.layers[0].weight
    begin = model.config.vertex_inputs
    assert (first[:, begin : begin + new] == 0).all()
    assert (first.grad[:, begin : begin + new].abs().sum(0) > 0).all()


def test_a_shorter_history_begins_as_if_points_had_moved_steadily(tmp_path, slides):
    given = batch(slides)
    model = build(types=9, material_features=("base_friction",))
    folder = save_model(tmp_path / "parent", model)
    child = build(seed=1, types=9, material_features=("base_friction",), history=1)
    inherit(child, str(folder))
    before, now = given.history[:, -2], given.history[:, -1]
    steady = torch.stack([now - k * (now - before) for k in (3, 2, 1, 0)], dim=1)
    with torch.no_grad():
        torch.testing.assert_close(
            child.step(given.history[:, -2:], given.world),
            model.step(steady, given.world),
            rtol=0,
            atol=1e-6,
        )


def test_a_longer_history_changes_nothing_at_first(tmp_path, slides):
    given = batch(slides)
    model = build(history=2)
    folder = save_model(tmp_path / "parent", model)
    child = build(seed=1, history=3)
    inherit(child, str(folder))
    with torch.no_grad():
        torch.testing.assert_close(
            child.step(given.history, given.world),
            model.step(given.history[:, -3:], given.world),
            rtol=0,
            atol=1e-7,
        )


@pytest.mark.parametrize("blocks", [3, 4, 5])
def test_a_deeper_network_changes_nothing_at_first(tmp_path, slides, blocks):
    given = batch(slides)
    model = build()
    folder = save_model(tmp_path / "parent", model)
    child = build(seed=1, blocks=blocks)
    inherit(child, str(folder))
    assert_one_step(child, model, given)
    # But every block learns: what is zero at its end has a gradient.
    child.acceleration(given.history, given.world).square().mean().backward()
    norms = [block.vertex.norm.weight for block in child.network.blocks]
    assert sum(bool((norm == 0).all()) for norm in norms) == blocks - 2
    assert all((norm.grad.abs() > 0).any() for norm in norms)


def test_blocks_that_double_their_edges_cannot_be_added(tmp_path):
    folder = save_model(tmp_path / "parent", build(edge_update="doubled"))
    with pytest.raises(RecipeError, match="recipe's 4 cannot begin as its 2"):
        inherit(build(edge_update="doubled", blocks=4), str(folder))


def test_features_that_the_parent_knows_keep_their_weights_in_any_order(tmp_path, slides):
    given = batch(slides)
    model = build(material_features=("tan_friction_angle",))
    folder = save_model(tmp_path / "parent", model)
    child = build(seed=1, material_features=("base_friction", "tan_friction_angle"))
    inherit(child, str(folder))
    with torch.no_grad():
        torch.testing.assert_close(
            child.step(given.history, given.world), model.step(given.history, given.world)
        )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"latent": 16}, "its latent is 8, the recipe's 16"),
        ({"radius": 0.11}, "its radius is 0.1, the recipe's 0.11"),
        ({"baffles": "none"}, "baffles"),
        ({"blocks": 1}, "it has 2 blocks, the recipe's only 1"),
    ],
)
def test_another_architecture_is_refused_in_one_line(parent, changes, words):
    with pytest.raises(RecipeError, match=words) as caught:
        inherit(build(**changes), str(parent[0]))
    assert "\n" not in str(caught.value)


def scene_of(scale: float) -> Scene:
    """A block that slides into a baffle; speed and duration grow as the root of the lengths."""
    return Scene.from_dict(
        {
            "name": "similar",
            "duration": 0.2 * scale**0.5,
            "domain": {"lower": (0.0,) * 3, "upper": (2.0 * scale, 1.0 * scale, 1.0 * scale)},
            "release": [
                {
                    "lower": (0.25 * scale, 0.0, 0.25 * scale),
                    "upper": (0.75 * scale, 0.25 * scale, 0.75 * scale),
                    "velocity": (2.0 * scale**0.5, 0.0, 0.1 * scale**0.5),
                }
            ],
            "baffle": [
                {
                    "center": (0.95 * scale, 0.5 * scale),
                    "size": (0.25 * scale, 0.5 * scale, 0.25 * scale),
                }
            ],
        }
    )


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test_a_parent_of_another_scale_moves_points_alike(tmp_path, scale):
    """Froude similarity: lengths times scale, times and speeds times its root, the same flow."""
    folder = save_model(tmp_path / "parent", build(wall_range=0.1, baffle_range=0.2))
    child = build(
        seed=1,
        spacing=0.0625 * scale,
        radius=0.1 * scale,
        wall_range=0.1 * scale,
        baffle_range=0.2 * scale,
        dt=0.02 * scale**0.5,
    )
    inherit(child, str(folder))
    small = load_model(folder).rollout([scene_of(1.0)])[0].positions
    large = load_model(save_model(tmp_path / "child", child)).rollout([scene_of(scale)])[0]
    assert np.abs(small[-1] - small[0]).max() > 0.05
    np.testing.assert_allclose(large.positions / scale, small, atol=2e-4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"radius": 0.1}, "so radius must be 0.05, not 0.1"),
        ({"radius": 0.05, "dt": 0.02}, r"dt must be within 10% of 0\.01414, not 0\.02"),
    ],
)
def test_a_scale_that_is_not_one_scale_is_refused(parent, changes, words):
    half = {"spacing": 0.03125, "wall_range": 0.025, "baffle_range": 0.05}
    with pytest.raises(RecipeError, match=words):
        inherit(build(**{**half, **changes}), str(parent[0]))
    inherit(build(**{**half, "radius": 0.05, "dt": 0.015}), str(parent[0]))


@pytest.mark.parametrize("seen", [{"depth_range": 0.1}, {"strain_unit": 0.3}])
def test_what_is_seen_in_metres_or_seconds_does_not_scale(tmp_path, seen):
    folder = save_model(tmp_path / "parent", build(**seen))
    half = {"spacing": 0.03125, "radius": 0.05, "wall_range": 0.025, "baffle_range": 0.05}
    with pytest.raises(RecipeError, match="only start models of its own spacing"):
        inherit(build(**half, dt=0.014, **seen), str(folder))


def test_other_parents_are_refused(parent, tmp_path):
    with pytest.raises(RecipeError, match="no learned model"):
        inherit(build(), "mpm")
    with pytest.raises(RecipeError, match="nowhere"):
        inherit(build(), str(tmp_path / "nowhere"))
    rich = save_model(tmp_path / "rich", build(material_features=("base_friction",)))
    with pytest.raises(RecipeError, match="it sees base_friction"):
        inherit(build(), str(rich))
    deep = save_model(tmp_path / "deep", build(depth_range=0.1))
    with pytest.raises(RecipeError, match=r"its depth_range is 0\.1, the recipe's 0"):
        inherit(build(), str(deep))
    strained = save_model(tmp_path / "strained", build(strain_unit=0.3))
    with pytest.raises(RecipeError, match=r"its strain_unit is 0\.3, the recipe's 0\.5"):
        inherit(build(strain_unit=0.5), str(strained))


def test_training_starts_from_the_parent(tiny, tmp_path):
    """With a rate of almost nothing the child is still its parent after two steps, and its moving
    average, too; a model that starts at random is not."""
    first = train(Recipe.from_dict({**tiny, "valid": [], "steps": 3}), tmp_path / "first")
    more = {**tiny, "valid": [], "steps": 2, "learning_rate": 1e-12, "seed": 5}
    child = train(Recipe.from_dict({**more, "start_from": str(first)}), tmp_path / "child")
    orphan = train(Recipe.from_dict(more), tmp_path / "orphan")
    weights = [load_model(folder).model.network.decode.layers[0].weight for folder in
               (first, child, orphan)]  # fmt: skip
    torch.testing.assert_close(weights[1], weights[0], rtol=1e-6, atol=1e-7)
    assert not torch.allclose(weights[2], weights[0], rtol=1e-2)
