"""What the commands of gns-design share: how a simulator and an objective are named."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from design.evaluators import SimulatorSpec
    from gns_env.objective import Objective

#: An option in a panel of --help.
build = partial(typer.Option, rich_help_panel="What may be built")
small = partial(typer.Option, rich_help_panel="What to make small")
many = partial(typer.Option, rich_help_panel="Many flows")
trust = partial(typer.Option, rich_help_panel="Trust")
run = partial(typer.Option, rich_help_panel="The run")

SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML).")]
Simulator = Annotated[
    str, typer.Option(help="mpm, a shipped model such as baffle-lite, or a checkpoint folder.")
]
Spacing = Annotated[
    float | None,
    typer.Option(help="Spacing of points for mpm in m; default: the solver's fine one."),
]
Weight = Annotated[
    float | None,
    small(help="Weight of this measure, relative to no baffles; default: the objective's."),
]
Device = Annotated[
    str, typer.Option(help="torch device of the simulator: cpu or cuda; mpm has a solver for each.")
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
