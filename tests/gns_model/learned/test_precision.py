"""bfloat16 where the hardware multiplies it, and a word where it does not."""

import warnings

import pytest
import torch

from gns_model.learned import precision
from gns_model.learned.simulator import LearnedSimulator

CPU = torch.device("cpu")


@pytest.fixture(params=[True, False])
def fast(request, monkeypatch):
    monkeypatch.setattr(precision, "multiplies_bfloat16", lambda device: request.param)
    return request.param


def test_auto_takes_what_the_hardware_has_without_a_word(fast):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert precision.is_short("auto", CPU) is fast
        assert precision.is_short("float32", CPU) is False


def test_bfloat16_is_done_as_asked_and_warned_of_where_it_is_slow(fast):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert precision.is_short("bfloat16", CPU)
    assert [str(w.message)[:20] for w in said] == ([] if fast else ['precision "bfloat16"'])


def test_what_this_machine_answers_fits_its_instructions():
    found = precision.multiplies_bfloat16(CPU)
    assert isinstance(found, bool)
    assert not (found and torch.backends.cpu.get_cpu_capability() == "AVX2")
    assert precision.multiplies_bfloat16(torch.device("meta")) is False


def test_a_rollout_of_auto_is_that_of_what_it_takes(fast, make_model, make_scene):
    scene, taken = make_scene(), "bfloat16" if fast else "float32"
    one, other = (
        LearnedSimulator(make_model(), precision=p).rollout([scene])[0].positions[-1]
        for p in ("auto", taken)
    )
    assert (one == other).all()
