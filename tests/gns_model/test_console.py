import errno
import os
import subprocess
import sys
import warnings

import pytest
import typer

from gns_model import console
from gns_model.errors import SceneError


def leave(error: BaseException) -> None:
    with console.clean_errors():
        raise error


def by_c_code() -> SystemError:
    """What C code makes of an interrupt in Python code that it calls."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (SceneError("scene.toml: key 'domain'\nis missing"), 2, "key 'domain' is missing"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/x/y.h5"), 2, "/x/y.h5: No space left"),
        (OSError("unable to write"), 2, "unable to write"),
        (MemoryError(), 2, "out of memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (by_c_code(), 130, "interrupted"),
    ],
)
def test_what_a_user_or_a_machine_causes_is_one_line_and_a_code(capsys, error, code, words):
    with pytest.raises(SystemExit) as left:
        leave(error)
    assert left.value.code == code
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err


def test_a_fault_of_ours_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        leave(ZeroDivisionError())
    with pytest.raises(SystemError):
        leave(SystemError("of C code"))


def test_it_decorates_a_command(capsys):
    @console.clean_errors()
    def command(value: int) -> None:
        raise SceneError(f"bad {value}")

    with pytest.raises(SystemExit):
        command(3)
    assert "bad 3" in capsys.readouterr().err


def make_app() -> typer.Typer:
    app = typer.Typer(no_args_is_help=True, add_completion=False)

    @app.command()
    def one(number: int = 0) -> None:
        print("one", number)

    @app.command()
    def stop() -> None:
        raise KeyboardInterrupt

    @app.command()
    def leave() -> None:
        raise typer.Exit(3)

    return app


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["one", "--number", "4"], 0, ""),
        (["one", "--number", "four"], 2, "--number"),
        (["one", "--nonsense"], 2, "--nonsense"),
        (["nonsense"], 2, "nonsense"),
        (["stop"], 130, "interrupted"),
        (["leave"], 3, ""),
    ],
)
def test_a_bad_option_is_one_line_too(capsys, arguments, code, words):
    with pytest.raises(SystemExit) as left:
        console.main(make_app(), "tool", arguments)
    assert left.value.code == code
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == (1 if words else 0)


def test_no_command_prints_the_help(capsys):
    with pytest.raises(SystemExit) as left:
        console.main(make_app(), "tool", [])
    assert left.value.code == 2
    captured = capsys.readouterr()
    assert "Usage" in captured.err + captured.out


def test_it_is_light_to_import():
    heavy = "[m for m in ('typer', 'rich', 'numpy', 'torch') if m in sys.modules]"
    out = subprocess.run(
        [sys.executable, "-c", f"import sys, gns_model.console; print({heavy})"],
        capture_output=True,
        text=True,
        check=True,
    )
    # The package itself may load numpy; the command line tools wait.
    assert "typer" not in out.stdout
    assert "rich" not in out.stdout
    assert "torch" not in out.stdout


def test_a_quiet_bar_prints_nothing(capsys):
    with console.progress_bar(quiet=True) as bar:
        bar.advance(bar.add_task("x", total=1))
    captured = capsys.readouterr()
    assert captured.out + captured.err == ""


def test_a_warning_is_one_line_and_the_place_is_told_of_a_librarys_own_only(capsys):
    app = typer.Typer()

    @app.command()
    def run():
        warnings.simplefilter("always")
        warnings.warn("outside of what\nit knows", stacklevel=1)
        warnings.warn("gone soon", DeprecationWarning, stacklevel=1)

    before = warnings.showwarning
    with pytest.raises(SystemExit):
        console.main(app, "tool", [])
    ours, theirs = capsys.readouterr().err.splitlines()
    assert ours == "warning: outside of what it knows"
    assert theirs.startswith(f"warning: gone soon (DeprecationWarning, {__file__}:")
    assert warnings.showwarning is before


def test_an_interrupt_within_exec_has_the_same_code(tmp_path):
    program = """
import typer
from gns_model import console
app = typer.Typer()
@app.command()
def run():
    exec("raise KeyboardInterrupt")
console.main(app, "tool")
"""
    (tmp_path / "tool.py").write_text(program)
    done = subprocess.run(
        [sys.executable, "-m", "tool"], cwd=tmp_path, capture_output=True, check=False
    )
    assert done.returncode == 130
