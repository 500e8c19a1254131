"""What a simulator is, and how to get one by name: the seam that the env and the searches hold."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeGuard, runtime_checkable

from gns_model.errors import SimulatorError
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Called as a rollout advances, with the fraction done, 0 to 1.
Progress = Callable[[float], None]


@runtime_checkable
class Simulator(Protocol):
    """Anything that turns scenes into trajectories."""

    name: str

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        """Simulate every scene for its duration; one trajectory a scene, in order."""
        ...

    def check(self, scene: Scene) -> None:
        """Raise SimulatorError if this simulator cannot run `scene`."""
        ...


class Refillable(Simulator, Protocol):
    """A simulator that can start from other fillings."""

    def refilled(self, jitter: float, filling: int) -> Simulator:
        """The same from points `shaken` so (`gns_model.particles`)."""


def can_refill(simulator: Simulator) -> TypeGuard[Refillable]:
    """Whether it can start from other fillings; a simulator of one's own need not."""
    return hasattr(simulator, "refilled")


def load_simulator(name: str | os.PathLike[str], device: str = "cpu", **options: Any) -> Simulator:
    """A simulator by name.

    Args:
        name: "mpm" (the reference solver), the name of a shipped model such as "baffle-lite",
            or the path of a checkpoint folder.
        device: torch device. On the CPU the reference solver is the one in numba, `MpmSimulator`;
            on "cuda" the same scheme in torch, `TorchMpmSimulator`: one thing under one name, and
            results agree within round-off.
        options: passed on to the simulator, e.g. `spacing` for "mpm".

    Raises:
        SimulatorError: if there is no such simulator, or it has no such option.
        FileFormatError: if the checkpoint is truncated or is not ours.
    """
    if str(name) == "mpm" and device != "cpu":
        from gns_model.mpm.torch_solver import TorchMpmSimulator

        _check_options(TorchMpmSimulator, device=device, **options)
        return TorchMpmSimulator(device=device, **options)
    if str(name) == "mpm":
        from gns_model.mpm import MpmSimulator

        _check_options(MpmSimulator, **options)
        return MpmSimulator(**options)
    from gns_model.learned.checkpoint import load_model, shipped_models

    shipped = shipped_models()
    path = shipped.get(str(name), Path(name))
    if not str(name) or not path.exists():
        known = ", ".join(["mpm", *sorted(shipped)])
        raise SimulatorError(
            f"no simulator named {str(name)!r}: give {known}, or the path of a checkpoint folder"
        )
    _check_options(load_model, path, device=device, **options)
    return load_model(path, device=device, **options)


def _check_options(function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    try:
        inspect.signature(function).bind(*arguments, **options)
    except TypeError as error:
        raise SimulatorError(f"options of the simulator: {error}") from None
