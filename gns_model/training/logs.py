"""The logs of a run: tables (CSV) for everyone, and TensorBoard's events where it is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gns_model.files import write_whole


class Table:
    """A CSV file with a column `step`, to which rows are added.

    Rows beyond the step that a run resumes at are dropped when it is opened.
    """

    def __init__(self, path: Path, *, step: int) -> None:
        self.path = path
        rows = [row for row in read_table(path) if row.get("step", step + 1) <= step]
        if rows:
            self._write(rows)
        else:
            path.unlink(missing_ok=True)

    def add(self, row: Mapping[str, float]) -> None:
        """Add one row; the file is written anew if its columns are others."""
        header = None
        if self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                header = next(csv.reader(file), None)
        if header != list(row):
            return self._write([*read_table(self.path), dict(row)])
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(f"{v:.7g}" for v in row.values())

    def _write(self, rows: list[dict[str, float]]) -> None:
        """Write rows whole; a column that a row lacks stays empty in it."""
        names = list(dict.fromkeys(name for row in rows for name in row))
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(names)
        for row in rows:
            writer.writerow(f"{row[name]:.7g}" if name in row else "" for name in names)
        write_whole(self.path, text.getvalue().encode())


def read_table(path: Path) -> list[dict[str, float]]:
    """The rows of a `Table`; one that was cut short, by a power cut say, is left out."""
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


class Events:
    """TensorBoard's event files, `tensorboard --logdir OUT/tensorboard`; nothing without it."""

    def __init__(self, folder: Path, *, step: int) -> None:
        self._writer: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        # Events beyond the step that is resumed at were not, as the rows of the tables.
        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    @property
    def on(self) -> bool:
        """Whether TensorBoard is there."""
        return self._writer is not None

    def add(self, group: str, step: int, values: Mapping[str, float]) -> None:
        """Write values under the tags "group/name"."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)
            self._writer.flush()

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()
