import numpy as np
import pytest

from gns_model.cli import Family
from gns_model.data.scenes import FAMILIES, draw
from gns_model.errors import SceneError


def test_the_command_knows_every_family():
    assert [family.value for family in Family] == list(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_scene_is_the_same_everywhere_and_another_for_another_index(family):
    assert draw(family, 3, 5) == draw(family, 3, 5)
    assert len({draw(family, seed, index) for seed in (0, 1) for index in range(4)}) == 8


def test_an_unknown_family_is_refused():
    with pytest.raises(SceneError, match="squares"):
        draw("circles", 0, 0)


def test_squares_are_as_narrow_and_as_high_as_columns_of_other_aspects():
    scenes = [draw("squares", 0, k) for k in range(200)]
    sides = np.array([scene.releases[0].size for scene in scenes])
    np.testing.assert_allclose(sides[:, 0], sides[:, 1])
    assert 0.08 <= sides.min() < 0.09
    assert 0.42 < sides.max() <= 0.45
    lower = np.array([scene.releases[0].lower for scene in scenes])
    assert (lower[:, 1] == 0).all()
    assert 70 < (lower[:, 0] == 0).sum() < 130
    assert all(scene.releases[0].velocity == (0.0, 0.0) for scene in scenes)
