"""What a person sees of a training run: a live line, logs and a plot of the loss."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from gns_model.console import progress_bar
from gns_model.training.distributed import Ranks
from gns_model.training.logs import Events, Table
from gns_model.training.loss_figure import LOG, VALIDATION, plot

#: Seconds between two rows of the log, and two lines where there is no terminal.
EVERY = 10.0

#: Folder of TensorBoard's events.
EVENTS = "tensorboard"


class Display:
    """Progress of a run, on rank 0; silent on the others.

    `log.csv` has a row every few seconds (means since the last one), `validation.csv` one for each
    validation, and `tensorboard/` both, if TensorBoard is installed; after a resume, what lies
    beyond the step that is resumed is dropped.

    Args:
        step, done: where the run stands as it begins, in steps and in `unit`.
        total: the budget, in `unit`.
    """

    def __init__(
        self, out: Path, ranks: Ranks, *, step: int, done: float, total: float, unit: str
    ) -> None:
        self.out, self.active = out, ranks.rank == 0
        self.total, self.unit = total, unit
        self._sums: dict[str, float] = {}
        self._count, self._since = 0, time.monotonic()
        self._done = done
        self._bar = progress_bar(quiet=not self.active)
        self._live = self.active and self._bar.console.is_terminal
        if self.active:
            self._log = Table(out / LOG, step=step)
            self._checks = Table(out / VALIDATION, step=step)
            self._events = Events(out / EVENTS, step=step)

    def __enter__(self) -> Display:
        if self._live:
            self._bar.start()
            self._task = self._bar.add_task(
                "training",
                total=self.total,
                completed=self._done,  # type: ignore[arg-type]  # minutes; rich counts any number
            )
        if self.active and not self._events.on:
            self.say("no TensorBoard logs: pip install 'gns-baffles[train]' adds them to the CSV")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live:
            self._bar.stop()
        if self.active:
            self._events.close()

    def step(self, step: int, seconds: float, done: float, values: Mapping[str, float]) -> None:
        """Take in one optimiser step.

        Args:
            step: steps done, this one included.
            seconds: spent so far.
            done: of the budget, in its unit.
            values: loss, learning rate, gradient norm, edges per second, ...
        """
        if not self.active:
            return
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1
        if self._live:
            text = f"step {step}  loss {values['loss']:.4f}"
            self._bar.update(self._task, completed=done, description=text)
        passed = time.monotonic() - self._since
        if passed < EVERY and done < self.total:
            return
        row = {name: value / self._count for name, value in self._sums.items()}
        row = {"step": step, "seconds": seconds, **row, "steps_per_second": self._count / passed}
        self._log.add(row)
        self._events.add("train", step, {k: v for k, v in row.items() if k != "step"})
        if not self._live:
            left = ""
            if done > self._done:
                left = (
                    f"  {_clock(max(0.0, self.total - done) / (done - self._done) * passed)} left"
                )
            print(
                f"step {step}  loss {row['loss']:.4f}  lr {row['learning_rate']:.2e}  "
                f"{row['edges_per_second']:.3g} edges/s  {done:.1f}/{self.total:g} {self.unit}"
                + left,
                flush=True,
            )
        self._done = done
        self._sums, self._count, self._since = {}, 0, time.monotonic()

    def validating(self, fraction: float) -> None:
        """Show how far a validation is, on a terminal."""
        if self._live:
            self._bar.update(self._task, description=f"validating {fraction:.0%}")

    def validation(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        """Take in one validation."""
        if not self.active:
            return
        self._checks.add({"step": step, "seconds": seconds, **values})
        self._events.add("validation", step, values)
        self.say("validation  " + "  ".join(f"{k} {v:.4g}" for k, v in values.items()))
        plot(self.out)

    def say(self, text: str) -> None:
        """Print one line above the live bar."""
        if self._live:
            self._bar.console.print(text, highlight=False)
        elif self.active:
            print(text, flush=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
