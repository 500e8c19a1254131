"""The errors that a user can cause. Every command turns them into one line and exit code 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


class GnsError(Exception):
    """Base of every error that is about the input and not about the code."""


class SceneError(GnsError, ValueError):
    """A scene that cannot be built: the message names the key, the value and what is allowed."""


class FileFormatError(GnsError, ValueError):
    """A file that is truncated, foreign or of another version: the message names the file."""


class SimulatorError(GnsError, ValueError):
    """A simulator that is unknown or cannot run the scene."""


class LayoutError(GnsError, ValueError):
    """A number or arrangement of baffles that the placement area cannot hold."""


def first_fault(
    error: ValidationError, whole: str = "scene", keys: str = "gns_model/scene.py"
) -> str:
    """One line on the first thing that is wrong with a `whole`, whose keys stand in file `keys`."""
    fault = error.errors()[0]
    key = ".".join(str(part) for part in fault["loc"]) or whole
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        return f"unknown key {key!r} (value {fault['input']!r}); see the keys in {keys}"
    if fault["type"] == "missing":
        return f"key {key!r} is missing"
    if fault["type"] == "value_error":
        return message if key == whole else f"{key}: {message}"
    return f"{key} = {fault['input']!r}: {message}"
