"""How good a model is: rollouts of held-out scenes, measured like every other result.

One-step losses do not tell a good simulator from a bad one; a model is chosen by what a person
would read off its rollouts. The ranks share the rollouts, so that none waits for the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from gns_model import measures
from gns_model.data.windows import WindowIndex
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.scene import Scene
from gns_model.training.batches import Draw, collate, read
from gns_model.training.distributed import Ranks
from gns_model.training.loss import unrolled_loss
from gns_model.trajectory import OK, Trajectory

#: Measures that a model is judged by, the relative error that counts as 1, and the smallest true
#: value that an error is relative to (a share of mass may be zero).
AIMS: dict[str, tuple[float, float]] = {
    "centroid_travel": (0.01, 0.05),
    "runout_p99": (0.025, 0.05),
    "upstream_depth": (0.08, 0.02),
    "mass_past_section": (0.15, 0.02),
}

#: Relative error of a rollout that diverged, and the most that any counts for.
WORST = 1.0


class Interrupted(Exception):
    """Someone asked the run to stop in the middle of a rollout."""


@dataclass(frozen=True)
class Scores:
    """Result of one validation, the same on every rank.

    Attributes:
        score: mean over AIMS of mean relative error / aim; 1 or less where all aims are met.
        errors: mean relative error of each measure over the rollouts.
        slope: of predicted on true centroid travel over the rollouts; nan if there are too few.
        one_step: one-step loss without noise.
        diverged: number of rollouts that diverged.
        complete: False if a rank was interrupted, so that the rest means nothing.
    """

    score: float
    errors: dict[str, float]
    slope: float
    one_step: float
    diverged: int
    complete: bool = True

    def row(self) -> dict[str, float]:
        """Flat, for a log."""
        return {
            "score": self.score,
            "one_step": self.one_step,
            **self.errors,
            "slope": self.slope,
            "diverged": float(self.diverged),
        }


@dataclass
class Validator:
    """Rollouts and windows of held-out trajectories.

    Args:
        index: the held-out trajectories.
        ranks: those that share the work.
        rollouts: number of trajectories to simulate, evenly from the list of files.
        windows: number of windows of the one-step loss.
    """

    index: WindowIndex
    ranks: Ranks
    rollouts: int
    windows: int
    _truth: dict[int, dict[str, float]] = field(default_factory=dict)

    def __call__(self, model: LearnedModel, stop: Callable[[], bool]) -> Scores:
        """Score `model`; all ranks must call this together.

        Args:
            stop: asked between the steps of a rollout; True ends the validation early.
        """
        count = len(self.index.sources)
        chosen = np.unique(np.linspace(0, count - 1, min(self.rollouts, count)).round().astype(int))
        names = list(AIMS)
        # A row a rollout: relative errors, then true and predicted centroid travel, diverged.
        table = torch.zeros(len(chosen) + 1, len(names) + 3, dtype=torch.float64)
        simulator = LearnedSimulator(model, "validation")

        def watch(_fraction: float) -> None:
            if stop():
                raise Interrupted

        interrupted = 0.0
        try:
            for row in range(self.ranks.rank, len(chosen), self.ranks.world):
                source = int(chosen[row])
                truth = self._measure(source)
                scene = self._scene(source)
                result = simulator.rollout([scene], progress=watch)[0]
                table[row] = torch.tensor(_compare(truth, result, names), dtype=torch.float64)
            table[-1, 0], table[-1, 1] = self._one_step(simulator.model, stop)
        except Interrupted:
            interrupted = 1.0
        table[-1, 2] = interrupted
        table = self.ranks.sum(table.to(self.ranks.device, torch.float32)).cpu().double()
        rows = table[:-1].numpy()
        errors = {name: float(rows[:, k].mean()) for k, name in enumerate(names)}
        score = float(np.mean([errors[name] / AIMS[name][0] for name in names]))
        one_step = float(table[-1, 0] / max(1.0, float(table[-1, 1])))
        return Scores(
            score=score,
            errors=errors,
            slope=_slope(rows[:, -3], rows[:, -2]),
            one_step=one_step,
            diverged=round(float(rows[:, -1].sum())),
            complete=float(table[-1, 2]) == 0,
        )

    def _scene(self, source: int) -> Scene:
        """The scene for as long as the reference simulated it."""
        entry = self.index.sources[source]
        return entry.scene.replace(duration=(entry.frames - 1) * entry.interval)

    def _measure(self, source: int) -> dict[str, float]:
        if source not in self._truth:
            trajectory = Trajectory.load(self.index.sources[source].path)
            self._truth[source] = measures.summary(trajectory)
        return self._truth[source]

    @torch.no_grad()
    def _one_step(self, model: LearnedModel, stop: Callable[[], bool]) -> tuple[float, float]:
        """Sum of the losses of this rank's windows, and their number."""
        rng = np.random.default_rng(0)
        total, number = 0.0, 0
        for k in range(self.windows):
            source = int(rng.integers(len(self.index.sources)))
            frame = int(rng.random() * self.index.starts(source, 1))
            if k % self.ranks.world != self.ranks.rank:
                continue
            if stop():
                raise Interrupted
            window = read(self.index, Draw(source, frame, 0, False, 0.0), unroll=1)
            batch = collate([window], noise_std=0.0, rng=rng, device=self.ranks.device)
            total += float(unrolled_loss(model, batch))
            number += 1
        return total, float(number)


def _compare(truth: dict[str, float], result: Trajectory, names: list[str]) -> list[float]:
    if result.status != OK:
        travel = truth["centroid_travel"]
        return [*(WORST for _ in names), travel, travel, 1.0]
    found = measures.summary(result)
    errors = [
        min(WORST, abs(found[name] - truth[name]) / max(abs(truth[name]), AIMS[name][1]))
        for name in names
    ]
    return [*errors, truth["centroid_travel"], found["centroid_travel"], 0.0]


def _slope(true: np.ndarray, found: np.ndarray) -> float:
    """Least-squares slope of `found` on `true`."""
    spread = true - true.mean() if len(true) else true
    if len(true) < 3 or not np.square(spread).sum() > 0:
        return float("nan")
    return float((spread * found).sum() / np.square(spread).sum())
