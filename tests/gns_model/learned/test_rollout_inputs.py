"""Rollouts as a function of the release velocity and of the friction angle, and their slopes."""

import math

import pytest
import torch

from gns_model.errors import SimulatorError
from gns_model.learned import LearnedSimulator

FRICTION = {"material_features": ("tan_friction_angle", "base_friction")}


def released(scene, velocity):
    """The scene with another release velocity."""
    (release,) = scene.releases
    return scene.replace(releases=(release.model_copy(update={"velocity": velocity}),))


def rubbed(scene, angle):
    return scene.replace(material=scene.material.model_copy(update={"friction_angle": angle}))


@pytest.mark.parametrize(("dim", "baffles"), [(2, "distance"), (3, "distance"), (3, "points")])
def test_another_velocity_is_another_scene(make_model, make_scene, dim, baffles):
    types = {"types": 9} if baffles == "points" else {}
    simulator = LearnedSimulator(make_model(dim=dim, baffles=baffles, **types))
    scene, other = make_scene(dim), (1.2, 0.3, -0.4)[:dim]
    (expected,) = simulator.rollout_tensor([released(scene, other)], frames=6)
    (found,) = simulator.rollout_tensor([scene], frames=6, velocities=[torch.tensor(other)])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    own = torch.tensor(scene.releases[0].velocity)
    assert torch.equal(
        simulator.rollout_tensor([scene], frames=6, velocities=[own])[0],
        simulator.rollout_tensor([scene], frames=6)[0],
    )


def test_another_friction_is_another_scene(make_model, make_scene):
    simulator = LearnedSimulator(make_model(**FRICTION))
    scenes = [make_scene(), make_scene()]
    expected = simulator.rollout_tensor([rubbed(scenes[0], 20.0), scenes[1]], frames=6)
    angles = [20.0, scenes[1].material.friction_angle]
    tan = [torch.tensor(math.tan(math.radians(a))) for a in angles]
    found = simulator.rollout_tensor(scenes, frames=6, tan_friction=tan)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)
    assert not torch.allclose(found[0], found[1])


def test_friction_that_the_model_does_not_see(make_model, make_scene):
    simulator = LearnedSimulator(make_model(), "blind")
    with pytest.raises(SimulatorError, match="blind does not see"):
        simulator.rollout_tensor([make_scene()], tan_friction=[torch.tensor(0.5)])


@pytest.mark.parametrize("what", ["velocities", "tan_friction"])
def test_slopes_are_those_of_differences(make_model, make_scene, what):
    simulator = LearnedSimulator(make_model(dtype=torch.float64, **FRICTION))
    scene = make_scene()
    at = {"velocities": [2.0, 0.1, 0.05], "tan_friction": 0.7}[what]
    value = torch.tensor(at, dtype=torch.float64, requires_grad=True)

    def travel(value):
        (track,) = simulator.rollout_tensor([scene], frames=9, **{what: [value]})
        return track[-1].square().sum(dim=1).mean()

    travel(value).backward()
    for k in range(value.numel()):
        step = torch.zeros(value.numel(), dtype=torch.float64)
        step[k] = 1e-5
        step = step.reshape(value.shape)
        with torch.no_grad():
            difference = (travel(value + step) - travel(value - step)) / 2e-5
        assert value.grad.reshape(-1)[k] == pytest.approx(float(difference), rel=1e-4, abs=1e-9)
        assert difference != 0
