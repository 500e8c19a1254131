from __future__ import annotations

from pathlib import Path

import pytest

from gns_model.errors import GnsError, SimulatorError
from gns_model.simulator import Simulator, load_simulator


@pytest.mark.parametrize("name", ["nope", "MPM", "", "baffle-lite/"])
def test_an_unknown_simulator_is_named_with_what_there_is(name: str):
    with pytest.raises(SimulatorError, match="no simulator named") as caught:
        load_simulator(name)
    message = str(caught.value)
    assert repr(name) in message
    assert "mpm" in message
    assert "\n" not in message


def test_a_folder_that_is_no_checkpoint_is_named(tmp_path: Path):
    (tmp_path / "model.safetensors").write_bytes(b"not weights")
    for path in (tmp_path, tmp_path / "model.safetensors"):
        with pytest.raises(GnsError) as caught:
            load_simulator(path)
        assert str(tmp_path) in str(caught.value)


def test_mpm_takes_its_options():
    simulator = load_simulator("mpm", spacing=0.03125)
    assert isinstance(simulator, Simulator)
    assert simulator.name == "mpm"
    assert simulator.spacing == 0.03125
    with pytest.raises(SimulatorError, match="spacing must be positive, got -1"):
        load_simulator("mpm", spacing=-1)


def test_an_option_that_does_not_exist_is_an_input_error():
    with pytest.raises(GnsError, match="colour"):
        load_simulator("mpm", colour="red")
