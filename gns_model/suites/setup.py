"""What every suite is given beside the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gns_model.simulator import Progress, Simulator

#: Between frames of a simulator that names no stride of its own [s].
DEFAULT_STRIDE = 0.01


def silent(description: str) -> Progress:
    """A stage that shows nothing."""
    return lambda fraction: None


@dataclass(frozen=True)
class Setup:
    """Where and how a suite runs.

    Attributes:
        out: folder that the files go into; reference trajectories are kept in its `reference`.
        spacing: of the reference solver's points [m]; default: the paper's element.
        threads: of the solver and of torch on the CPU where seconds are measured.
        devices: torch devices whose cost is measured.
        budget: about how long measuring the cost may take on each device [s].
        fillings: how many other starts columns are run from beside the usual one; see `fillings`.
        stage: opens a progress bar; what it returns is called with the fraction done.
    """

    out: Path
    spacing: float | None = None
    threads: int = 1
    devices: tuple[str, ...] = ("cpu",)
    budget: float = 300.0
    fillings: int = 0
    stage: Callable[[str], Progress] = silent


def dimension(simulator: Simulator) -> int | None:
    """2 or 3; None for a simulator of both, such as the solver."""
    return getattr(getattr(simulator, "config", None), "dim", None)


def stride(simulator: Simulator) -> float:
    """Time between the frames of its trajectories [s]."""
    config = getattr(simulator, "config", None)
    if config is not None:
        return float(config.dt)
    settings = simulator.settings() if hasattr(simulator, "settings") else {}
    return float(settings.get("frame_interval", DEFAULT_STRIDE))
