"""What a person sees of a training run: a live line, a CSV log and a plot of the loss."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from gns_model.console import progress_bar
from gns_model.scene import write_whole
from gns_model.training.distributed import Ranks

#: Seconds between two rows of the log, and two lines where there is no terminal.
EVERY = 10.0

LOG, VALIDATION, PLOT = "log.csv", "validation.csv", "loss.png"


class Display:
    """Progress of a run, on rank 0; silent on the others.

    `log.csv` has a row every few seconds (means since the last one), `validation.csv` one for each
    validation; after a resume, rows beyond the step that is resumed are dropped.
    """

    def __init__(self, out: Path, ranks: Ranks, *, step: int, total: float, unit: str) -> None:
        self.out, self.active = out, ranks.rank == 0
        self.total, self.unit = total, unit
        self._sums: dict[str, float] = {}
        self._count, self._since = 0, time.monotonic()
        self._done = 0.0
        self._bar = progress_bar(quiet=not self.active)
        self._live = self.active and self._bar.console.is_terminal
        if self.active:
            for name in (LOG, VALIDATION):
                _keep_until(out / name, step)

    def __enter__(self) -> Display:
        if self._live:
            self._bar.start()
            self._task = self._bar.add_task("training", total=self.total)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live:
            self._bar.stop()

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
        _append(self.out / LOG, row)
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

    def validation(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        """Take in one validation."""
        if not self.active:
            return
        _append(self.out / VALIDATION, {"step": step, "seconds": seconds, **values})
        self.say("validation  " + "  ".join(f"{k} {v:.4g}" for k, v in values.items()))
        plot(self.out)

    def say(self, text: str) -> None:
        """Print one line above the live bar."""
        if self._live:
            self._bar.console.print(text, highlight=False)
        elif self.active:
            print(text, flush=True)


def plot(out: Path) -> None:
    """Draw `loss.png` from the logs in `out`: training loss, one-step loss and rollout score."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    log, checks = _read(out / LOG), _read(out / VALIDATION)
    if not log:
        return
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    left.plot([r["step"] for r in log], [r["loss"] for r in log], lw=0.8, label="training")
    if checks:
        steps = [r["step"] for r in checks]
        left.plot(steps, [r["one_step"] for r in checks], "o-", label="held out, no noise")
        for name in dict.fromkeys(name for row in checks for name in row):
            if name not in ("step", "seconds", "one_step", "slope", "diverged"):
                style = {"color": "black", "lw": 2} if name == "score" else {"lw": 1}
                values = [r.get(name, float("nan")) for r in checks]
                right.plot(steps, values, "o-", label=name, **style)
        right.set(xlabel="step", ylabel="error relative to truth; score", yscale="log")
        right.legend()
    left.set(xlabel="step", ylabel="loss", yscale="log")
    left.legend()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    pyplot.close(figure)
    write_whole(out / PLOT, content.getvalue())


def _append(path: Path, row: Mapping[str, float]) -> None:
    """Add one row; the file is written anew if its columns are others."""
    header = None
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            header = next(csv.reader(file), None)
    if header != list(row):
        return _write(path, [*_read(path), dict(row)])
    with path.open("a", newline="", encoding="utf-8") as file:
        csv.writer(file).writerow(f"{v:.7g}" for v in row.values())


def _write(path: Path, rows: list[dict[str, float]]) -> None:
    """Write rows whole; a column that a row lacks stays empty in it."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(names)
    for row in rows:
        writer.writerow(f"{row[name]:.7g}" if name in row else "" for name in names)
    write_whole(path, text.getvalue().encode())


def _read(path: Path) -> list[dict[str, float]]:
    """The rows of a log. A last one that was cut short, by a power cut say, is left out."""
    if not path.exists():
        return []
    rows = []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            try:
                rows.append({k: float(v) for k, v in row.items() if v != ""})
            except (TypeError, ValueError):
                continue
    return rows


def _keep_until(path: Path, step: int) -> None:
    """Drop the rows beyond `step`, or the file if none is left."""
    rows = [row for row in _read(path) if row.get("step", step + 1) <= step]
    if rows:
        _write(path, rows)
    else:
        path.unlink(missing_ok=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
