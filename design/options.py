"""What the commands of gns-design share: how a simulator and an objective are named."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

if TYPE_CHECKING:
    from design.evaluators import SimulatorSpec
    from gns_env.objective import Objective

SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML).", show_default=False)]
Simulator = Annotated[
    str, typer.Option(help="mpm, a shipped model such as baffle-lite, or a checkpoint folder.")
]
Spacing = Annotated[
    Optional[float],  # noqa: UP045  (typer reads it at run time, also on Python 3.11)
    typer.Option(help="Spacing of points for mpm in m; default: the solver's fine one."),
]
Weight = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(
        help="Weight of this measure, relative to no baffles; default: the objective's.",
        show_default=False,
        rich_help_panel="What to make small",
    ),
]
Device = Annotated[
    str,
    typer.Option(help="torch device of the simulator: cpu or cuda; mpm has a solver for each."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress.")]


def simulator_spec(name: str, spacing: float | None, device: str) -> SimulatorSpec:
    """The simulator that the options name.

    Raises:
        SimulatorError: if the options do not go together, or there is no such device.
    """
    from design.evaluators import SimulatorSpec
    from gns_model.errors import SimulatorError

    if name != "mpm" and spacing is not None:
        raise SimulatorError(f"a spacing can be chosen for mpm only; {name} has its own")
    import torch

    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise SimulatorError(f"no device {device!r}: give cpu or cuda") from None
    if kind not in ("cpu", "cuda") or (kind == "cuda" and not torch.cuda.is_available()):
        raise SimulatorError(f"device {device!r} is not there: give cpu, or cuda on a GPU machine")
    return SimulatorSpec(name, device, () if spacing is None else (("spacing", spacing),))


def objective_of(**weights: float | None) -> Objective:
    """The objective with the weights that were given and the defaults of the others."""
    from gns_env.objective import Objective

    given: dict[str, Any] = {name: value for name, value in weights.items() if value is not None}
    return Objective(**given)


def names_of(given: list[str] | None) -> tuple[str, ...] | None:
    """Names that were given one by one or with commas; None if none were.

    Raises:
        SettingError: for an empty name.
    """
    from design.settings import SettingError

    if given is None:
        return None
    names = tuple(name.strip() for text in given for name in text.split(","))
    if not all(names):
        raise SettingError("--ensemble: give names or folders of learned models, or none")
    return names


def rounds_of(refine: bool, rounds: int) -> int:
    """How many rounds of refinement are asked for.

    Raises:
        SettingError: for less than one.
    """
    from design.settings import SettingError

    if rounds < 1:
        raise SettingError(f"--refine-rounds must be 1 or more, got {rounds}")
    return rounds if refine else 0
