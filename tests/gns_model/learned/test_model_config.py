from __future__ import annotations

import subprocess
import sys

import pytest
from pydantic import ValidationError

import gns_model
from gns_model.learned import Limits, ModelConfig


def test_round_trip_as_json():
    config = ModelConfig(limits=Limits(max_speed=3.0, friction_angle=(30.0, 40.0)))
    assert ModelConfig.model_validate_json(config.model_dump_json()) == config


@pytest.mark.parametrize(
    "options",
    [
        {"baffles": "points"},
        {"radius": 0.02},
        {"latent": 0},
        {"dt": float("nan")},
        {"activation": "gelu"},
        {"wings": 2},
        {"edge_update": "tripled"},
        {"hidden": 0},
        {"wall_clip": -1.0},
        {"bounds": ((0.0, 1.0), (0.0, 1.0))},
        {"bounds": ((0.0, 1.0), (0.0, 1.0), (1.0, 0.0))},
    ],
)
def test_refuses(options):
    with pytest.raises(ValidationError):
        ModelConfig(**options)


def test_limits_hold_what_they_were_made_of_and_nothing_is_known_of_nothing(make_scene):
    scenes = [make_scene(), make_scene(friction={"base": 0.3}), make_scene(baffle=[])]
    limits = Limits.of(scenes)
    assert limits.base_friction == (0.3, 0.7)
    assert limits.baffle_height == (0.15, 0.2)
    assert not any(limits.broken_by(s) for s in scenes)
    assert Limits().broken_by(scenes[0]) == []
    fast = {"lower": [0.1] * 3, "upper": [0.3] * 3, "velocity": [5.0, 0, 0]}
    (line,) = limits.broken_by(make_scene(release=[fast], baffle=[]))[:1]
    assert line.startswith("max_speed = 5, but trained on")


def test_names_load_on_first_use_and_import_is_cheap():
    code = (
        "import sys, gns_model; "
        "heavy = {'torch', 'numba', 'h5py', 'pydantic'} & set(sys.modules); "
        "assert not heavy, heavy; gns_model.Scene; import gns_model.learned; "
        "assert 'numba' not in sys.modules; print(gns_model.__version__)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == gns_model.__version__
    with pytest.raises(AttributeError):
        _ = gns_model.nonsense
    assert "radius_graph" in dir(gns_model)
