"""What every command line of the project shares: clean errors and a progress bar with time left.

A user's mistake ends in one line on stderr and exit code 2, an interrupt in exit code 130; a
traceback is kept for our own mistakes. rich and typer are imported when they are used.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO

from gns_model.errors import GnsError
from gns_model.interrupts import none_lost

if TYPE_CHECKING:
    from rich.progress import Progress
    from typer import Typer

USER_ERROR, INTERRUPTED = 2, 130


def fail(message: str, code: int = USER_ERROR) -> NoReturn:
    """Print one line on stderr and leave with `code`."""
    print("error: " + " ".join(message.split()), file=sys.stderr)
    raise SystemExit(code)


@contextlib.contextmanager
def clean_errors() -> Iterator[None]:
    """Turn what a user or a machine can cause into one line and an exit code.

    Works as a context manager and as a decorator of a command. GnsError, OSError (a full disk, a
    folder that cannot be written) and MemoryError leave with 2, an interrupt with 130. Anything
    else is a fault of ours and keeps its traceback.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        # C code makes a SystemError of an interrupt that it did not expect.
        cause = error.__cause__ or error.__context__
        if not isinstance(error, KeyboardInterrupt) and not isinstance(cause, KeyboardInterrupt):
            raise
        fail("interrupted; what was finished is kept", INTERRUPTED)
    except GnsError as error:
        fail(str(error))
    except BrokenPipeError:
        # The reader of our output left (`| head`): nobody is there to be told.
        sys.stderr.close()
        raise SystemExit(USER_ERROR) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        fail(place + (error.strerror or str(error) or type(error).__name__))
    except MemoryError:
        fail("out of memory: use a coarser spacing, fewer workers or a smaller batch")


def main(app: Typer, name: str, arguments: list[str] | None = None) -> NoReturn:
    """Run a typer app as a command: bad options too are one line and exit code 2.

    A SIGTERM (a batch system that ends the job) is treated as Ctrl-C, so that the same care is
    taken of what is half done.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        with clean_errors(), none_lost(), warnings.catch_warnings():
            warnings.showwarning = _show_warning
            code = _run(app, name, arguments)
            if code == INTERRUPTED:  # typer swallows the interrupt and returns its code
                raise KeyboardInterrupt
    finally:
        # Nothing is left to take care of: a signal that comes now must not become a traceback.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # Under `python -m`, an interrupt that went through exec (dataclasses use it) would kill us
        # in the end, in place of the code 130, unless something is evaluated after it.
        exec("")
    raise SystemExit(code if isinstance(code, int) else 0)


def _run(app: Typer, name: str, arguments: list[str] | None) -> object:
    """What `app` returns; bad options end here."""
    from typer import Abort

    try:
        return app(arguments, prog_name=name, standalone_mode=False)
    except Abort:
        raise KeyboardInterrupt from None
    except Exception as error:
        # click's and typer's usage errors, whose common base depends on typer's version.
        if not hasattr(error, "format_message"):
            raise
        message = error.format_message()
        if type(error).__name__ == "NoArgsIsHelpError":  # the message is the whole help
            print(message, file=sys.stderr)
            raise SystemExit(USER_ERROR) from None
        fail(f"{message} (see {name} --help)")


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """A warning for the user is one line; of a library's own the place matters, too."""
    text = " ".join(str(message).split())
    if category is not UserWarning:
        text = f"{text} ({category.__name__}, {filename}:{lineno})"
    print("warning: " + text, file=file or sys.stderr)


def _interrupt(signum: int, frame: object) -> NoReturn:
    raise KeyboardInterrupt


def command() -> list[str]:
    """The command line that this process was started with, to be written down beside its result."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]


def progress_bar(*, quiet: bool = False) -> Progress:
    """A rich progress bar on stderr with time spent and time left; nothing when `quiet`.

    Off a terminal (a log file, a CI job) rich prints the last state once instead of redrawing.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
    )


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print a table on stdout, numbers to the right."""
    from rich.table import Table

    table = Table(*columns, title=title, title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*row)
    show(table)


def show(renderable: object) -> None:
    """Print a rich renderable on stdout, as wide as it needs where stdout is not a terminal."""
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    console.print(renderable)
