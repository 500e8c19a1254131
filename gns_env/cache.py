"""What a simulator has said already: bounded, and shared by all envs of a process.

A rollout is known by the simulator (its weights and settings, not its object), by the scene without
baffles, and by the layout in whatever order. Measures and deposit maps are small and kept by the
thousand; trajectories are large and share a budget of bytes.
"""

from __future__ import annotations

import hashlib
import json
import uuid
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.trajectory import Trajectory

#: Rollouts that a cache remembers, and the bytes that their trajectories may fill.
REMEMBERED, TRAJECTORY_BYTES = 10_000, 256 * 2**20
#: Layouts closer than this in every coordinate are one layout [m].
SAME_LAYOUT = 1e-6

#: What is kept of a trajectory: nothing, its last two frames (enough to draw the deposit), or all.
Keep = Literal["nothing", "rest", "whole"]


@dataclass(frozen=True)
class Outcome:
    """What one rollout showed.

    Attributes:
        measures: as `gns_model.measures.summary`; finite whatever happened.
        status: "ok", or how the rollout failed: "diverged", "interrupted" or "leaked".
        deposit: depth in the last frame [m], see `gns_env.deposit`.
        depths: peak depth upstream of each baffle [m], in the order of `sorted_centres`.
    """

    measures: dict[str, float]
    status: str
    deposit: NDArray[np.float32]
    depths: NDArray[np.float32]


class RolloutCache:
    """Outcomes by key, the longest unused of them forgotten first."""

    def __init__(self, remembered: int = REMEMBERED, trajectory_bytes: int = TRAJECTORY_BYTES):
        self.remembered, self.trajectory_bytes = remembered, trajectory_bytes
        self._outcomes: OrderedDict[bytes, Outcome] = OrderedDict()
        self._trajectories: OrderedDict[tuple[bytes, Keep], Trajectory] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._outcomes)

    def find(self, key: bytes, keep: Keep = "nothing") -> tuple[Outcome, Trajectory | None] | None:
        """The outcome of `key` with the trajectory asked for; None if either is not known."""
        outcome = self._outcomes.get(key)
        if outcome is None:
            return None
        trajectory = None
        if keep != "nothing":
            trajectory = self._trajectories.get((key, keep))
            if trajectory is None:
                return None
            self._trajectories.move_to_end((key, keep))
        self._outcomes.move_to_end(key)
        return outcome, trajectory

    def remember(
        self, key: bytes, outcome: Outcome, keep: Keep = "nothing", trajectory: Any = None
    ) -> None:
        """Keep an outcome, and its trajectory unless `keep` is "nothing"."""
        self._outcomes[key] = outcome
        self._outcomes.move_to_end(key)
        if keep != "nothing":
            self._drop((key, keep))
            self._trajectories[key, keep] = trajectory
            self._bytes += trajectory.positions.nbytes
        while len(self._outcomes) > self.remembered:
            oldest, _ = self._outcomes.popitem(last=False)
            self._drop((oldest, "rest"))
            self._drop((oldest, "whole"))
        while self._bytes > self.trajectory_bytes:
            self._drop(next(iter(self._trajectories)))

    def clear(self) -> None:
        """Forget everything."""
        self._outcomes.clear()
        self._trajectories.clear()
        self._bytes = 0

    def _drop(self, key: tuple[bytes, Keep]) -> None:
        trajectory = self._trajectories.pop(key, None)
        if trajectory is not None:
            self._bytes -= trajectory.positions.nbytes


class _SharedCache(RolloutCache):
    """The cache of this process: a copy of what refers to it refers to it still, in every process
    to that process's own."""

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return shared_cache, ()


_SHARED = _SharedCache()


def shared_cache() -> RolloutCache:
    """The cache that all envs of this process share."""
    return _SHARED


def sorted_centres(centres: NDArray[Any]) -> NDArray[Any]:
    """Centres (k, D-1) in one order, so that the answer does not depend on the order asked for."""
    return centres[np.lexsort(centres.T[::-1])] if len(centres) else centres


def layout_key(centres: NDArray[np.float64]) -> bytes:
    """The same bytes for the same layout in any order."""
    return sorted_centres(np.rint(centres / SAME_LAYOUT).astype(np.int64)).tobytes()


def scene_key(simulator: Simulator, scene: Scene) -> bytes:
    """The same bytes for the same scene on the same simulator."""
    values = json.dumps(scene.to_dict(), sort_keys=True)
    return hashlib.sha256(f"{_identity(simulator)!r}{values}".encode()).digest()


def _identity(simulator: Any) -> Hashable:
    """The same value for simulators that answer the same.

    Ours are known by weights and settings; anything else, a subclass or a wrapper included, by the
    object itself, so whoever changes such an object in place should use another cache.
    """
    kind = f"{type(simulator).__module__}.{type(simulator).__qualname__}"
    if kind in _SOLVERS:
        settings = simulator.settings()
        return kind, tuple((k, v) for k, v in settings.items() if k not in _NO_MATTER)
    try:
        if simulator not in _IDENTITIES:
            known = kind == "gns_model.learned.simulator.LearnedSimulator"
            _IDENTITIES[simulator] = _weights(simulator) if known else str(uuid.uuid4())
        return kind, _IDENTITIES[simulator]
    except TypeError:  # it cannot be hashed or referred to weakly
        return kind, str(uuid.uuid4())


def _weights(simulator: Any) -> str:
    words = (
        simulator.config.model_dump_json(), simulator.device.type, simulator.precision,
        simulator.filling, simulator.jitter,
    )  # fmt: skip
    digest = hashlib.sha256(repr(words).encode())
    for name, tensor in sorted(simulator.model.state_dict().items()):
        digest.update(f"{name}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


_SOLVERS = ("gns_model.mpm.solver.MpmSimulator", "gns_model.mpm.torch_solver.TorchMpmSimulator")
#: Settings that the answer of a reference solver does not depend on.
_NO_MATTER = ("threads", "workers", "batch", "cuda_graph")
_IDENTITIES: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
