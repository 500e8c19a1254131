"""The cache: bounded in number and bytes, keyed by what a rollout depends on and nothing else."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from gns_env.cache import Outcome, RolloutCache, layout_key, scene_key, shared_cache
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory


def outcome(value: float = 0.0) -> Outcome:
    return Outcome({"cost": value}, "ok", np.zeros((2, 2), np.float32), np.zeros(0, np.float32))


@pytest.fixture
def frames(plane_scene: Scene) -> Trajectory:
    """A trajectory of 800 bytes."""
    return Trajectory(
        np.zeros((2, 50, 2), np.float32), np.arange(2.0), np.full(50, 6), plane_scene, 1.0
    )


def test_the_longest_unused_is_forgotten_first() -> None:
    cache = RolloutCache(remembered=2)
    cache.remember(b"a", outcome(1))
    cache.remember(b"b", outcome(2))
    assert cache.find(b"a") is not None
    cache.remember(b"c", outcome(3))
    assert cache.find(b"b") is None
    assert cache.find(b"a")[0].measures == {"cost": 1}
    assert len(cache) == 2
    cache.clear()
    assert cache.find(b"a") is None


def test_trajectories_fill_their_bytes_and_no_more(frames: Trajectory) -> None:
    cache = RolloutCache(trajectory_bytes=2000)
    for key in (b"a", b"b", b"a", b"c"):
        cache.remember(key, outcome(), "rest", frames)
        assert cache._bytes == sum(t.positions.nbytes for t in cache._trajectories.values())
        assert cache._bytes <= 2000
    assert cache.find(b"b", "rest") is None  # only a and c have room
    assert cache.find(b"b") is not None  # what is small is known still
    assert cache.find(b"c", "rest")[1] is frames
    assert cache.find(b"c", "whole") is None
    tiny = RolloutCache(remembered=1)
    tiny.remember(b"a", outcome(), "whole", frames)
    tiny.remember(b"b", outcome())
    assert tiny._bytes == 0


def test_keys_are_what_the_answer_depends_on(flume: Scene) -> None:
    same = scene_key(MpmSimulator(spacing=0.05), flume)
    assert same == scene_key(MpmSimulator(spacing=0.05, workers=3, threads=2), flume)
    assert same != scene_key(MpmSimulator(spacing=0.04), flume)
    assert same != scene_key(MpmSimulator(spacing=0.05), flume.replace(duration=0.8))

    class Mine(MpmSimulator):
        """Might answer otherwise."""

    assert scene_key(Mine(), flume) != scene_key(Mine(), flume)
    mine = Mine()
    assert scene_key(mine, flume) == scene_key(mine, flume)
    a = np.array([[0.5, 0.2], [0.7, 0.4]])
    assert layout_key(a) == layout_key(a[::-1]) == layout_key(a + 1e-9)
    assert layout_key(a) != layout_key(a + 1e-5)


def test_a_learned_model_is_known_by_its_weights(is_shipped: bool, flume: Scene) -> None:
    if not is_shipped:
        pytest.skip("no model is shipped")
    from gns_model import load_simulator

    one, two, other = (load_simulator("baffle-lite") for _ in range(3))
    assert scene_key(one, flume) == scene_key(two, flume)
    next(other.model.parameters()).data[0] += 1e-6
    assert scene_key(one, flume) != scene_key(other, flume)
    for choice in ({"filling": 1}, {"jitter": 0.2}):
        assert scene_key(one, flume) != scene_key(load_simulator("baffle-lite", **choice), flume)


def test_copies_share_the_cache_of_the_process() -> None:
    assert copy.deepcopy(shared_cache()) is shared_cache()
    assert pickle.loads(pickle.dumps(shared_cache())) is shared_cache()
