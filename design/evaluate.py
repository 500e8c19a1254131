"""`gns-design evaluate`: measure one layout beside the same flow without baffles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from design import options
from gns_model import console

if TYPE_CHECKING:
    from gns_model.scene import Scene


def evaluate(
    scene: options.SceneFile,
    layout: Annotated[
        Path | None,
        typer.Option(
            help="TOML file whose baffle tables stand in place of the scene's, such as "
            "layouts/best.toml of a run; nothing else in it is read."
        ),
    ] = None,
    baffles: Annotated[
        Path | None,
        typer.Option(
            help="Mesh of walls (STL, PLY, OBJ, OFF, GLB; metres) in place of the scene's baffles. "
            "Each closed body has to be a box along the axes that stands on the base: only "
            "these are simulated exactly, and anything else is refused."
        ),
    ] = None,
    up: Annotated[
        Literal["y", "z"] | None,
        typer.Option(
            help="Axis of the mesh that points up; default: y for GLB, z for the others, as "
            "gns-design writes them."
        ),
    ] = None,
    vtk: Annotated[
        Path | None,
        typer.Option(
            help="Also write the flow with these baffles for ParaView (VTKHDF, *.vtkhdf)."
        ),
    ] = None,
    simulator: options.Simulator = "mpm",
    spacing: options.Spacing = None,
    device: options.Device = "cpu",
    runout_weight: options.Weight = None,
    depth_weight: options.Weight = None,
    mass_weight: options.Weight = None,
    json_output: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure a layout beside the same scene without baffles: measures, cost, and the change."""
    with console.clean_errors():
        from gns_model.errors import GnsError
        from gns_model.scene import Scene

        placed = Scene.from_toml(scene)
        if layout is not None and baffles is not None:
            raise GnsError("give --layout or --baffles, not both")
        if up is not None and baffles is None:
            raise GnsError("--up is about the mesh of --baffles")
        if layout is not None:
            placed = with_layout(placed, layout)
        if baffles is not None:
            placed = with_walls(placed, baffles, up)
        if vtk is not None:
            from gns_model.vtkhdf import check_name

            check_name(vtk)
        objective = options.objective_of(
            runout_weight=runout_weight, depth_weight=depth_weight, mass_weight=mass_weight
        )
        from design.measure import measure

        spec = options.simulator_spec(simulator, spacing, device)
        result = measure(placed, spec, objective=objective, vtk=vtk, quiet=quiet)
        if json_output:
            import json

            print(json.dumps(result, indent=2, allow_nan=False))
        else:
            _show(result)


def with_layout(scene: Scene, path: Path) -> Scene:
    """`scene` with the [[baffle]] entries of a TOML file in place of its own.

    Raises:
        SceneError: if the file cannot be read, names no baffle, or they do not fit the scene.
    """
    from gns_model.errors import SceneError
    from gns_model.toml import read_toml

    entries = read_toml(path, SceneError).get("baffle")
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"{path}: no [[baffle]] in it, so there is no layout to evaluate")
    return _placed(scene, tuple(entries), path)


def with_walls(scene: Scene, path: Path, up: Literal["y", "z"] | None = None) -> Scene:
    """`scene` with the bodies of a mesh file as its baffles; see `walls.read_walls`.

    Raises:
        FileFormatError, WallError: as `read_walls`.
        SceneError: if two bodies overlap, or one overlaps a release.
    """
    from design.walls import read_walls

    return _placed(scene, read_walls(path, scene, up=up), path)


def _placed(scene: Scene, baffles: tuple[Any, ...], path: Path) -> Scene:
    from gns_model.errors import SceneError

    try:
        return scene.replace(baffles=baffles)
    except SceneError as error:
        raise SceneError(f"{path}: {str(error).removeprefix('scene: ')}") from None


def _show(result: dict[str, Any]) -> None:
    from gns_model.measures import UNITS

    rows = []
    for name, unit in UNITS.items():
        change = result["relative"].get(name)
        rows.append(
            [
                rf"{name} \[{unit}]",
                f"{result['measures'][name]:.4g}",
                f"{result['no_baffles'][name]:.4g}",
                "-" if change is None else f"{100 * (change - 1):+.1f}%",
            ]
        )
    change = result["cost"] / result["cost_no_baffles"] - 1
    costs = [f"{result[k]:.4f}" for k in ("cost", "cost_no_baffles")]
    rows.append(["cost", *costs, f"{100 * change:+.1f}%"])
    console.print_table(
        f"{result['scene']}, {result['baffles']} baffles, by {result['simulator']}",
        ["", "with baffles", "no baffles", "change"],
        rows,
    )
    print(f"Cost: {result['objective']}")
