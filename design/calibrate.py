"""`gns-design calibrate`: the friction angle or the release velocity behind a deposit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from design import options
from gns_model import console

if TYPE_CHECKING:
    from design.inverse import Found
    from design.target import Target
    from design.unknowns import Unknown
    from gns_model.scene import Scene


def calibrate(
    scene: options.SceneFile,
    parameter: Annotated[
        Literal["friction", "velocity"],
        typer.Option(
            help="What to find: the friction angle, or the velocity of the releases in plan."
        ),
    ],
    target: Annotated[
        Path | None,
        typer.Option(
            help="Deposit to match: a trajectory file (.h5; its last frame counts), or a CSV of "
            "points of equal mass with the columns x, y, z in metres."
        ),
    ] = None,
    runout: Annotated[
        float | None,
        typer.Option(
            help="Or the runout to match: travel of the front of 99% of the material in m."
        ),
    ] = None,
    simulator: Annotated[
        str | None,
        typer.Option(
            help="mpm, a shipped model, or a checkpoint folder; default: the shipped model of this "
            "dimension that sees the parameter, else mpm."
        ),
    ] = None,
    method: Annotated[
        Literal["gradient", "differences"] | None,
        typer.Option(
            help="Slopes by autograd or by finite differences; default: gradient where the "
            "simulator has one."
        ),
    ] = None,
    budget: Annotated[int, typer.Option(min=1, help="Most values to try.")] = 12,
    out: Annotated[
        Path | None, typer.Option(help="Write the scene with what was found (TOML).")
    ] = None,
    spacing: options.Spacing = None,
    device: options.Device = "cpu",
    json_output: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the friction angle or the release velocity from a deposit or a runout."""
    with console.clean_errors():
        from gns_model.errors import GnsError
        from gns_model.scene import Scene

        given = Scene.from_toml(scene)
        if (target is None) == (runout is None):
            raise GnsError("give the deposit to match as --target, or the runout as --runout")
        from design.inverse import calibrate as search
        from design.inverse import default_method
        from design.target import read_deposit, read_runout
        from design.unknowns import unknown

        wanted_target: Target
        if target is not None:
            wanted_target, time = read_deposit(target, given)
            if time:  # as long as the flow that left the deposit
                given = given.replace(duration=time)
        else:
            assert runout is not None
            wanted_target = read_runout(runout, given)
        name = simulator or _default_simulator(given, parameter)
        runner = options.simulator_spec(name, spacing, device).load()
        chosen = default_method(runner, parameter, method)
        wanted = unknown(parameter, given, wanted_target)
        with console.progress_bar(quiet=quiet) as bar:
            task = bar.add_task(f"{parameter} by {name}, {chosen}", total=budget)
            found = search(
                given,
                runner,
                wanted_target,
                parameter,
                method=chosen,
                budget=budget,
                progress=lambda n, d, v: bar.update(
                    task, completed=n, description=f"{_text(wanted, v)}, {1000 * d:.1f} mm off"
                ),
            )
            bar.update(task, total=found.evaluations)
        if out is not None:
            wanted.put(Scene.from_toml(scene), found.value).to_toml(out)
        _tell(found, wanted, str(wanted_target), runner.name, json_output)
        if found.status == "interrupted":
            raise KeyboardInterrupt


def _default_simulator(scene: Scene, parameter: Literal["friction", "velocity"]) -> str:
    from design.inverse import fitting_models

    return [*fitting_models(parameter, scene.dim), "mpm"][0]


def _text(wanted: Unknown, value: Any) -> str:
    return ", ".join(
        f"{label} {v:.3f} {wanted.unit}" for label, v in zip(wanted.labels, value, strict=True)
    )


def summary(found: Found, wanted: Unknown) -> dict[str, Any]:
    """Plain values for --json; distances in metres."""
    return {
        "parameter": wanted.name,
        "unit": wanted.unit,
        "found": dict(zip(wanted.labels, map(float, found.value), strict=True)),
        "start": dict(zip(wanted.labels, map(float, found.start), strict=True)),
        "distance": found.distance,
        "start_distance": found.start_distance,
        "method": found.method,
        "status": found.status,
        "evaluations": found.evaluations,
        "rollouts": found.rollouts,
        "backwards": found.backwards,
        "rollouts_by_differences": found.rollouts_by_differences,
        "seconds": round(found.seconds, 2),
        "at_bound": bool(found.at_bound),
        "history": [{"value": value, "distance": distance} for value, distance in found.history],
    }


def _tell(found: Found, wanted: Unknown, target: str, simulator: str, as_json: bool) -> None:
    if as_json:
        import json

        values = {**summary(found, wanted), "target": target, "simulator": simulator}
        print(json.dumps(values, indent=2, allow_nan=False))
        return
    print(f"Found by {simulator}: {_text(wanted, found.value)}")
    print(
        f"It is {1000 * found.distance:.1f} mm off {target}; the scene's own "
        f"({_text(wanted, found.start)}) is {1000 * found.start_distance:.1f} mm off."
    )
    if found.at_bound:
        print("That is the end of the range that was looked through: the true value may lie beyond")
    cost = f"{found.rollouts} rollouts"
    if found.method == "differences" and found.backwards:
        cost += f" and {found.backwards} backward passes, whose slopes did not lead down"
    if found.method == "gradient":
        cost += (
            f" and {found.backwards} backward passes; finite differences take "
            f"{found.rollouts_by_differences} rollouts for as many slopes"
        )
    print(f"{found.status}: {found.evaluations} values tried by {found.method}, {cost}, "
          f"{found.seconds:.0f} s")  # fmt: skip
