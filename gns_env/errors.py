"""The errors of the env: each is one of Gymnasium's own kind and of ours, and holds one line.

A user of Gymnasium catches `gymnasium.error.Error`, a command of this package `GnsError`; both see
the same exception. They are raised at construction and in `reset`; `step` raises only
`gymnasium.error.InvalidAction` and `ResetNeeded`, before anything is simulated.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium.error

from gns_env.objective import ObjectiveError
from gns_model.errors import FileFormatError, GnsError, LayoutError, SceneError, SimulatorError


class EnvError(gymnasium.error.Error, GnsError, ValueError):
    """An argument of the env that cannot be."""


class InvalidScenario(EnvError):
    """A scenario with an unknown key, or with a value that this scene cannot have."""


class InvalidScene(EnvError, SceneError):
    """A scene that cannot be built or read."""


class InvalidSimulator(EnvError, SimulatorError):
    """A simulator that is unknown or cannot run the scene."""


class InvalidLayout(EnvError, LayoutError):
    """More baffles than the placement area holds."""


class InvalidObjective(EnvError, ObjectiveError):
    """No objective, or one that the flow without baffles gives nothing to compare with."""


class InvalidModelFile(EnvError, FileFormatError):
    """A checkpoint that is not one."""


_KINDS: tuple[tuple[type[GnsError], type[EnvError]], ...] = (
    (SceneError, InvalidScene),
    (SimulatorError, InvalidSimulator),
    (LayoutError, InvalidLayout),
    (ObjectiveError, InvalidObjective),
    (FileFormatError, InvalidModelFile),
    (GnsError, EnvError),
)


@contextmanager
def gymnasium_errors() -> Iterator[None]:
    """Raise every GnsError of the block as the kind above that is Gymnasium's too."""
    try:
        yield
    except gymnasium.error.Error:
        raise
    except GnsError as error:
        kind = next(ours for theirs, ours in _KINDS if isinstance(error, theirs))
        raise kind(str(error)) from None
