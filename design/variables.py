"""The options of the command that say what may vary and what limits it: `--vary height=0.2:0.4`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from design.form import FORM
from design.settings import SettingError


def placement_of(vary: Sequence[str], number: str | None, **limits: float | None) -> dict[str, Any]:
    """Values for `Settings.placement` from options: what was given, and nothing else.

    Args:
        vary: "name=low:high", a name of `space.FORM`.
        number: "low:high", or one number.
        limits: by the name of the placement's key; None where not given.

    Raises:
        SettingError: if an option is not of that form.
    """
    ranges: dict[str, Any] = {}
    for text in vary:
        name, _, ends = text.partition("=")
        if name.strip() not in FORM:
            raise SettingError(f"--vary {text}: give one of {', '.join(FORM)}, as height=0.2:0.4")
        ranges[name.strip()] = _range(f"--vary {text}", ends, float)
    if number is not None:
        ranges["number"] = _range(f"--number {number}", number, int)
    given = {name: value for name, value in limits.items() if value is not None}
    return {**given, **({"vary": ranges} if ranges else {})}


def _range(option: str, text: str, kind: type[int] | type[float]) -> tuple[float, float]:
    try:
        numbers = [kind(part) for part in text.split(":")]
        low, high = numbers if len(numbers) == 2 else (*numbers, *numbers)
    except (ValueError, TypeError):
        raise SettingError(f"{option}: give a range low:high") from None
    return low, high
