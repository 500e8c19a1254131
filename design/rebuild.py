"""`gns-design report`: the page of a run folder once more, from what the folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from design import options
from gns_model import console

#: A folder with one of these is, or was going to be, a run.
TRACES = ("summary.json", "trials.csv", "scene.toml", "study.db", "trajectories")


def report(
    run: Annotated[Path, typer.Argument(help="Run folder.", show_default=False)],
    gif: Annotated[bool, typer.Option(help="Draw flow.gif too: it takes seconds.")] = True,
    quiet: options.Quiet = False,
) -> None:
    """Write report.html and its figures anew; a run that was cut off gives a partial page."""
    with console.clean_errors():
        check(run)
        with console.progress_bar(quiet=quiet) as bar:
            task = bar.add_task(f"report of {run}", total=None)
            from design.report import write_report

            path = write_report(run, gif=gif)
            bar.update(task, total=1, completed=1)
        print(path)


def check(run: Path) -> None:
    """Refuse what is no run folder, before anything is written into it.

    Raises:
        FileFormatError: if it is no folder, or holds nothing of a run.
    """
    from gns_model.errors import FileFormatError

    if not run.is_dir():
        raise FileFormatError(f"{run}: no such folder")
    if not any((run / name).exists() for name in TRACES):
        raise FileFormatError(f"{run}: no run of gns-design, it has none of {', '.join(TRACES)}")
