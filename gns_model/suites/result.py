"""What a suite returns: rows of a table, curves, aims met or missed, files written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gns_model.files import write_whole

#: A row of a table: names of its columns and plain values.
Row = dict[str, Any]


@dataclass(frozen=True)
class Aim:
    """A number that should not exceed `most`; `value` is None where it could not be measured."""

    name: str
    value: float | None
    most: float

    @property
    def met(self) -> bool:
        """Whether it was reached. What could not be measured was not."""
        return self.value is not None and self.value <= self.most

    def to_dict(self) -> Row:
        """Plain values."""
        return {"name": self.name, "value": self.value, "most": self.most, "met": self.met}

    def __str__(self) -> str:
        value = "not measured" if self.value is None else f"{self.value:.1%}"
        return f"{'met   ' if self.met else 'MISSED'}  {self.name}: {value}, aim {self.most:.0%}"


@dataclass
class SuiteResult:
    """One suite of one simulator.

    Attributes:
        suite, title: name and heading.
        rows: the table; all rows have the keys of the first.
        shown: (key, heading, format) of the columns that a terminal shows.
        aims: what was aimed at.
        facts: single numbers that belong to no row.
        warnings: what the model was not trained for.
        notes: sentences that a reader needs to understand the numbers.
        curves: longer tables, by file name without ending.
        files: names of the files that were written into the folder.
        seconds: that the suite took.
    """

    suite: str
    title: str
    rows: list[Row]
    shown: Sequence[tuple[str, str, str]]
    aims: list[Aim] = field(default_factory=list)
    facts: Row = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    curves: dict[str, list[Row]] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def to_dict(self) -> Row:
        """Plain finite values for JSON; the curves are in their files only."""
        content = {
            "title": self.title,
            "rows": self.rows,
            "aims": [aim.to_dict() for aim in self.aims],
            "facts": self.facts,
            "warnings": self.warnings,
            "notes": self.notes,
            "files": self.files,
            "seconds": self.seconds,
        }
        return finite(content)

    def write_tables(self, folder: Path) -> None:
        """Write the rows and the curves as CSV and note their names in `files`."""
        for name, rows in {self.suite: self.rows, **self.curves}.items():
            write_csv(folder / f"{name}.csv", rows)
            self.files.append(f"{name}.csv")

    def cells(self) -> list[list[str]]:
        """The shown columns as text, one list a row; "-" where there is no number."""
        return [[_cell(row[key], form) for key, _, form in self.shown] for row in self.rows]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with equal keys, whole or not at all."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def finite(value: Any) -> Any:
    """The same plain values with None in place of numbers that JSON does not know."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cell(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)
