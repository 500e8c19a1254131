"""How good a model is: rollouts of held-out scenes, measured like every other result.

One-step losses do not tell a good simulator from a bad one; a model is chosen by what a person
would read off its rollouts. The ranks share the rollouts, so that none waits for the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from gns_model import measures
from gns_model.data.windows import WindowIndex
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.particles import MOVING, STATIONARY
from gns_model.simulator import Progress
from gns_model.training.batches import Draw, collate, read
from gns_model.training.distributed import Ranks
from gns_model.training.judging import AIMS, Facts, errors, judged_by, judged_by_all
from gns_model.training.kinematic import kinematic_spacing
from gns_model.training.loss import step_error
from gns_model.trajectory import OK, Trajectory


class Interrupted(Exception):
    """Someone asked the run to stop in the middle of a rollout."""


@dataclass(frozen=True)
class Scores:
    """Result of one validation, the same on every rank.

    Attributes:
        score: mean over the measures of mean relative error / aim; at most 1 where all are met.
        errors: mean relative error of each measure, over the rollouts that it means something in.
        slope: of predicted on true over the rollouts, of the first measure in `errors`; nan if
            there are too few.
        one_step: one-step loss without noise.
        drive: slope of predicted on true mean acceleration of a scene along x, over the windows of
            that loss; 1 is right. A model that drives every flow a tenth too little has a good
            loss, most of which is what single grains do, and stops early.
        diverged: number of rollouts that diverged.
        complete: False if a rank was interrupted, so that the rest means nothing.
    """

    score: float
    errors: dict[str, float]
    slope: float
    one_step: float
    drive: float
    diverged: int
    complete: bool = True

    def row(self) -> dict[str, float]:
        """Flat, for a log."""
        return {
            "score": self.score,
            "one_step": self.one_step,
            "drive": self.drive,
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
    _truth: dict[int, Facts] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.index.sources)
        spread = np.linspace(0, count - 1, min(self.rollouts, count)).round()
        self._chosen = [int(k) for k in np.unique(spread)]
        scenes = [self.index.sources[k].scene for k in self._chosen]
        self._names = judged_by_all(scenes)
        self._judged = np.array([[n in judged_by(s) for n in self._names] for s in scenes])

    @property
    def ruler(self) -> str:
        """What the score is made of: scores of two rulers do not compare."""
        files = [self.index.sources[k].path.name for k in self._chosen]
        return " ".join([*self._names, *files])

    def __call__(
        self,
        model: LearnedModel,
        stop: Callable[[], bool],
        progress: Callable[[float], None] | None = None,
    ) -> Scores:
        """Score `model`; all ranks must call this together.

        Args:
            stop: asked between the steps of a rollout; True ends the validation early.
            progress: called with the share of this rank's rollouts that is done.
        """
        # A row a rollout: relative errors, then true and predicted leading measure, diverged.
        width = len(self._names)
        table = np.zeros((len(self._chosen) + 1, width + 4))
        simulator = LearnedSimulator(model, "validation")

        def watch(fraction: float) -> None:
            if stop():
                raise Interrupted
            if progress is not None:
                progress((first + fraction * len(batch)) / len(mine))

        mine = range(self.ranks.rank, len(self._chosen), self.ranks.world)
        # A GPU wants many scenes at once; on a CPU a batch only makes its steps, which a stop
        # waits for, longer.
        together = len(mine) if self.ranks.device.type == "cuda" else 1
        try:
            for first in range(0, len(mine), max(1, together)):
                batch = mine[first : first + together]
                for row, result in zip(batch, self._simulate(simulator, batch, watch), strict=True):
                    table[row, : width + 3] = self._compare(row, result)
            table[-1, 1:5] = self._one_step(simulator.model, stop)
        except Interrupted:
            table[-1, 0] = 1.0
        message = torch.tensor(table, dtype=torch.float32, device=self.ranks.device)
        table = self.ranks.sum(message).cpu().double().numpy()
        rows = table[:-1]
        interrupted, loss, number, product, square = table[-1, :5].tolist()
        mean = {
            name: float(rows[self._judged[:, k], k].mean()) for k, name in enumerate(self._names)
        }
        lead = self._judged[:, 0]
        return Scores(
            score=float(np.mean([error / AIMS[name][0] for name, error in mean.items()])),
            errors=mean,
            slope=_slope(rows[lead, width], rows[lead, width + 1]),
            one_step=loss / max(1.0, number),
            drive=product / square if square > 0 else float("nan"),
            diverged=round(float(rows[:, width + 2].sum())),
            complete=interrupted == 0,
        )

    def _simulate(
        self, simulator: LearnedSimulator, rows: Sequence[int], watch: Progress
    ) -> list[Trajectory]:
        """Rollouts of some of the chosen files, for as long as the reference simulated them.

        A foreign one goes on from its own first frames: its points fill no scene.
        """
        sources = [self.index.sources[self._chosen[row]] for row in rows]
        if not any(source.foreign for source in sources):
            scenes = [s.scene.replace(duration=(s.frames - 1) * s.interval) for s in sources]
            return simulator.rollout(scenes, progress=watch)
        results = []
        for row, source in zip(rows, sources, strict=True):
            if not source.foreign:
                results += self._simulate(simulator, [row], watch)
                continue
            k = self._chosen[row]
            start = self.index.read(k, 0, unroll=1)
            frames = 1 + (source.frames - 1 - self.index.first(k)) // self.index.stride(k)
            result = simulator.rollout_from(
                source.scene,
                start.history,
                start.particle_type,
                start.tan_friction,
                frames=frames,
                progress=watch,
            )
            results.append(_all_moving_alike(result))
        return results

    def _facts(self, row: int) -> Facts:
        k = self._chosen[row]
        if k not in self._truth:
            truth = Trajectory.load(self.index.sources[k].path)
            first = self.index.first(k)
            if first:
                truth = replace(truth, positions=truth.positions[first:], time=truth.time[first:])
            self._truth[k] = Facts.of(_all_moving_alike(truth), self.index.stride(k))
        return self._truth[k]

    def _compare(self, row: int, result: Trajectory) -> list[float]:
        """One row of the table; measures that mean nothing in the scene count 0 and are left out
        of the means."""
        truth = self._facts(row)
        scene = self.index.sources[self._chosen[row]].scene
        found = errors(judged_by(scene), truth, result)
        lead = self._names[0]
        diverged = result.status != OK
        pair = [truth.measures[lead]] * 2
        if not diverged:
            pair[1] = measures.summary(result)[lead]
        return [*(found.get(name, 0.0) for name in self._names), *pair, float(diverged)]

    @torch.no_grad()
    def _one_step(self, model: LearnedModel, stop: Callable[[], bool]) -> np.ndarray:
        """Of this rank's windows: sum of the losses, number, and sums of the products of the
        predicted with the true mean acceleration along x, and of the squares of the true one."""
        rng = np.random.default_rng(0)
        sums = np.zeros(4)
        for k in range(self.windows):
            source = int(rng.integers(len(self.index.sources)))
            frame = int(rng.random() * self.index.starts(source, 1))
            if k % self.ranks.world != self.ranks.rank:
                continue
            if stop():
                raise Interrupted
            item = Draw(source, frame, 0, False, 0.0)
            window = read(self.index, item, kinematic=kinematic_spacing(model.config))
            batch = collate([window], noise_std=0.0, rng=rng, device=self.ranks.device)
            history, move, moves = batch.history, batch.moves[:, 0], batch.world.moving
            after = model.step(history, batch.world)
            loss = step_error(model, history, after, move, moving=batch.moving)
            velocity = history[:, -1] - history[:, -2]
            true, found = (
                float((p - velocity)[moves, 0].mean()) / model.config.dt**2
                for p in (move, after - history[:, -1])
            )
            sums += float(loss), 1.0, found * true, true * true
        return sums


def _all_moving_alike(trajectory: Trajectory) -> Trajectory:
    """Foreign points move under several types; measures are about those of one."""
    kinds = trajectory.particle_type
    alike = np.where(kinds == STATIONARY, kinds, MOVING).astype(kinds.dtype)
    return replace(trajectory, particle_type=alike)


def _slope(true: np.ndarray, found: np.ndarray) -> float:
    """Least-squares slope of `found` on `true`."""
    spread = true - true.mean() if len(true) else true
    if len(true) < 3 or not np.square(spread).sum() > 0:
        return float("nan")
    return float((spread * found).sum() / np.square(spread).sum())
