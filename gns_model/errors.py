"""The errors that a user can cause. Every command turns them into one line and exit code 2."""

from __future__ import annotations


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
