"""Training the paper's own network: baffles as kinematic points, types, foreign data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gns_model.data.windows import Window, WindowIndex
from gns_model.learned.config import PAPER_TYPES, ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.learned.model import LearnedModel
from gns_model.learned.world import baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY
from gns_model.training import Recipe, RecipeError, train
from gns_model.training.batches import Draw, collate, read
from gns_model.training.distributed import Ranks
from gns_model.training.kinematic import kinematic_spacing, with_baffle_points
from gns_model.training.loss import Emphasis, unrolled_loss
from gns_model.training.setup import open_data
from gns_model.training.statistics import measure
from gns_model.training.validation import Validator
from gns_model.trajectory import Trajectory

SPACING, DT, RADIUS = 0.0625, 0.02, 0.1
CPU = torch.device("cpu")


def index(folder) -> WindowIndex:
    return WindowIndex([folder], spacing=SPACING, dt=DT, history=5, unroll=2)


def paper_model(**changes) -> LearnedModel:
    torch.manual_seed(0)
    small = {"spacing": SPACING, "dt": DT, "radius": RADIUS, "latent": 8, "blocks": 2}
    return LearnedModel(ModelConfig.paper(3).model_copy(update={**small, **changes}))


def test_baffles_become_points_that_stand_still(slides):
    plain = index(slides).read(0, 3, mixture=0)
    window = with_baffle_points(plain, SPACING)
    still = window.particle_type == STATIONARY
    box = plain.scene.baffle_boxes()[0]
    size = box[1] - box[0]
    assert still.sum() == np.prod(np.round(size / SPACING))
    assert not still[: len(plain.history)].any()
    np.testing.assert_array_equal(window.history[~still], plain.history)
    np.testing.assert_array_equal(window.future[~still], plain.future)
    stand = np.concatenate([window.history, window.future], axis=1)[still]
    assert (stand == stand[:, :1]).all()
    assert (stand > box[0]).all()
    assert (stand < box[1]).all()
    assert window.tan_friction.shape == window.particle_type.shape == (len(window.history),)
    assert kinematic_spacing(ModelConfig()) is None
    assert kinematic_spacing(ModelConfig.paper(3)) == ModelConfig.paper(3).spacing


def test_mirrored_points_stand_in_the_mirrored_baffle(slides):
    windows = index(slides)
    flipped = read(windows, Draw(0, 3, 0, True, 0.0), kinematic=SPACING)
    box = flipped.scene.baffle_boxes()[0]
    stand = flipped.history[flipped.particle_type == STATIONARY]
    assert (stand > box[0]).all()
    assert (stand < box[1]).all()


def test_what_stands_still_gets_no_noise_and_is_not_in_the_loss(slides):
    windows = index(slides)
    net = paper_model()
    measure(
        windows, windows=16, radius=RADIUS, noise_std=1e-3, subtract_gravity=False,
        kinematic=SPACING,
    ).apply(net)  # fmt: skip
    window = read(windows, Draw(0, 3, 0, False, 0.0), kinematic=SPACING)
    batch = collate([window] * 2, noise_std=1e-3, rng=np.random.default_rng(0), device=CPU)
    still = batch.world.particle_type == STATIONARY
    assert still.any()
    clean = torch.from_numpy(np.concatenate([window.history] * 2))
    assert torch.equal(batch.history[still], clean[still])
    assert not torch.equal(batch.history[~still], clean[~still])
    assert torch.equal(batch.moving, ~still)

    # The loss is the mean over moving points, whatever the target of the others says.
    @torch.no_grad()
    def loss(moves: torch.Tensor) -> float:
        return float(unrolled_loss(net, replace(batch, moves=moves), Emphasis(momentum_weight=1.0)))

    moves = batch.moves.clone()
    moves[still] = 7.0
    assert loss(moves) == loss(batch.moves)
    moves[~still] += 0.01
    assert loss(moves) > loss(batch.moves)
    # And after two steps on its own the model has moved none of them.
    with torch.no_grad():
        after = net.step(batch.history, batch.world)
    assert torch.equal(after[still], batch.history[still, -1])


def test_statistics_leave_out_what_stands_still(slides):
    windows = index(slides)
    options = {"windows": 32, "radius": RADIUS, "noise_std": 0.0, "subtract_gravity": False}
    plain, kinematic = measure(windows, **options), measure(windows, kinematic=SPACING, **options)
    assert plain.velocity_std == kinematic.velocity_std
    assert plain.acceleration_mean == kinematic.acceleration_mean
    window = with_baffle_points(windows.read(0, 5, mixture=0), SPACING)
    moving = len(windows.read(0, 5, mixture=0).history)
    edges = len(radius_graph(torch.from_numpy(window.history[:, -1].copy()), RADIUS)[0])
    assert kinematic.edges(moving, 0.4) == pytest.approx(edges, rel=0.2)
    assert np.mean(kinematic.neighbours) > np.mean(plain.neighbours)


def test_the_papers_network_trains_and_is_validated(tiny, tmp_path):
    small = {"spacing": SPACING, "dt": DT, "radius": RADIUS, "latent": 8, "blocks": 2}
    model = {**ModelConfig.paper(3).model_dump(mode="json", exclude={"limits"}), **small}
    recipe = Recipe.from_dict({**tiny, "model": model, "steps": 4})
    assert recipe.model.baffles == "points"
    assert recipe.model.types == PAPER_TYPES
    assert train(recipe, tmp_path) == tmp_path / "model"


def test_data_that_the_model_cannot_see_is_refused(tiny, slides):
    values = {**tiny, "model": {**tiny["model"], "baffles": "none"}}
    recipe = Recipe.from_dict(values)
    with pytest.raises(RecipeError, match="sees none"):
        open_data(recipe, recipe.train)
    with pytest.raises(RecipeError, match="at least 7"):
        Recipe.from_dict({**tiny, "model": {**tiny["model"], "types": 6}})


def test_types_of_a_window_reach_the_embedding(slides):
    """Two windows that differ in nothing but the type are told apart by their embedding."""
    windows = index(slides)
    net = paper_model(baffles="none")
    window = windows.read(0, 3, mixture=0)

    def predict(kind: int) -> torch.Tensor:
        typed = replace(window, particle_type=np.full(len(window.history), kind))
        batch = collate([typed], noise_std=0.0, rng=np.random.default_rng(0), device=CPU)
        with torch.no_grad():
            return net.acceleration(batch.history, batch.world)

    assert torch.equal(predict(MOVING), predict(MOVING))
    assert not torch.allclose(predict(MOVING), predict(5))
    assert isinstance(window, Window)


@pytest.fixture(scope="module")
def foreign(slides, tmp_path_factory):
    """`slides` as an import leaves it: moving points of type 5, and a baffle of type 3 as rows."""
    folder = tmp_path_factory.mktemp("foreign")
    for path in sorted(slides.iterdir())[:2]:
        ours = Trajectory.load(path)
        chosen = (ours.lattice % 2 == 0).all(axis=1)  # foreign points have the model's spacing
        fixed = baffle_points(baffle_boxes(ours.scene), SPACING).numpy()
        still = np.repeat(fixed[None], len(ours.time), axis=0)
        moving = ours.positions[:, chosen]
        Trajectory(
            positions=np.concatenate([moving, still], axis=1),
            time=ours.time,
            particle_type=np.repeat([5, STATIONARY], [moving.shape[1], len(fixed)]).astype(np.int8),
            scene=ours.scene.with_baffles([]),
            point_volume=ours.point_volume * 8,
            foreign=True,
        ).save(folder / path.name)
    return folder


def test_foreign_trajectories_train_and_are_validated_by_going_on(foreign, tiny, tmp_path):
    small = {"spacing": SPACING, "dt": DT, "radius": RADIUS, "latent": 8, "blocks": 2}
    model = {**ModelConfig.paper(3).model_dump(mode="json", exclude={"limits"}), **small}
    values = {**tiny, "train": [str(foreign)], "valid": [str(foreign)], "model": model}
    recipe = Recipe.from_dict({**values, "steps": 3, "mirror": False})
    assert train(recipe, tmp_path) == tmp_path / "model"
    # A model that keeps the velocity it sees is near a flow that hardly slows down from there on.
    windows = index(foreign)
    net = paper_model()
    with torch.no_grad():
        for p in net.network.decode.parameters():
            p.zero_()
    scores = Validator(windows, Ranks(0, 1, CPU), 2, 2)(net, lambda: False)
    assert scores.complete
    assert scores.diverged == 0
    assert {"runout_max", "centroid_travel", "energy"} == set(scores.errors)
    assert 0.01 < scores.errors["centroid_travel"] < 1
    # By hand: from the first frame with a whole history on, at constant velocity.
    truth = Trajectory.load(sorted(foreign.iterdir())[0])
    first = windows.first(0)
    x = truth.positions[:, truth.particle_type == 5, 0].mean(axis=1)
    steps = (len(x) - 1 - first) // 2
    going_on = steps * (x[first] - x[first - 2])
    error = abs(going_on - (x[-1] - x[first])) / max(x[-1] - x[first], 0.05)
    alone = Validator(windows, Ranks(0, 1, CPU), 1, 1)(net, lambda: False)
    assert alone.errors["centroid_travel"] == pytest.approx(min(1.0, error), rel=1e-3)


def test_a_model_of_boxes_refuses_kinematic_points(foreign, tiny):
    recipe = Recipe.from_dict({**tiny, "train": [str(foreign)]})
    with pytest.raises(RecipeError, match='use "points"'):
        open_data(recipe, recipe.train)
