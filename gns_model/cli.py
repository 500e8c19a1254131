"""The command `gns-model`: simulate, validate, generate, train, evaluate."""

from __future__ import annotations

import json
import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from gns_model import console
from gns_model.errors import GnsError
from gns_model.interop.commands import register as register_interop
from gns_model.scene import Scene
from gns_model.suites.command import evaluate

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Simulators of granular flow: the MPM reference solver and the graph network.",
)

Workers = Annotated[
    int, typer.Option(min=1, help="Processes, one thread each.", show_default="all cores")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
CORES = os.cpu_count() or 1


class Solver(StrEnum):
    """Engines of the reference solver."""

    numba = "numba"
    torch = "torch"


class Family(StrEnum):
    """Families of random scenes."""

    random = "random"
    flume = "flume"
    layouts = "layouts"
    columns = "columns"
    friction = "friction"
    barriers = "barriers"
    rectangles = "rectangles"
    squares = "squares"
    spreading = "spreading"
    spreading_friction = "spreading-friction"
    pressed = "pressed"
    pressed_friction = "pressed-friction"
    bare = "bare"
    rows = "rows"
    rectangles_friction = "rectangles-friction"
    slides = "slides"


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).")],
    out: Annotated[Path, typer.Option(help="Trajectory file to write (HDF5).")],
    simulator: Annotated[
        str, typer.Option(help="mpm, a shipped model, or a checkpoint folder.")
    ] = "mpm",
    vtk: Annotated[
        Path | None, typer.Option(help="Also write it for ParaView (VTKHDF, *.vtkhdf).")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of the solver on cpu.")] = CORES,
    spacing: Annotated[
        float | None, typer.Option(help="Of the solver's points in m; default: the paper's.")
    ] = None,
    device: Annotated[
        str, typer.Option(help="torch device: cpu or cuda; mpm has a solver for each.")
    ] = "cpu",
    quiet: Quiet = False,
) -> None:
    """Run one scene and write its trajectory."""
    from gns_model import measures
    from gns_model.simulator import load_simulator
    from gns_model.vtkhdf import check_name, save_vtkhdf

    if vtk is not None:
        check_name(vtk)
    options: dict[str, Any] = {}
    if simulator == "mpm":
        options = {"spacing": spacing, **({"threads": threads} if device == "cpu" else {})}
    elif spacing is not None:
        raise GnsError(f"--spacing is the solver's; {simulator!r} has one of its own")
    runner = load_simulator(simulator, device, **options)
    loaded = Scene.from_toml(scene)
    runner.check(loaded)
    with console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task(f"{runner.name}: {loaded.name}", total=1.0)
        trajectory = runner.rollout([loaded], progress=lambda f: bar.update(task, completed=f))[0]
    trajectory.save(out)
    print(f"{out}: {trajectory.status}, {trajectory.positions.shape[1]} points")
    if vtk is not None:
        save_vtkhdf(trajectory, vtk)
        print(f"{vtk}: for ParaView")
    for key, value in measures.summary(trajectory).items():
        print(f"  {key:20s} {value:10.4f} {measures.UNITS[key]}")


@app.command()
def validate(
    as_json: Json = False,
    workers: Workers = CORES,
    spacing: Annotated[
        float | None, typer.Option(help="Of the flume's points in m; default: the paper's.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Run the reference solver on the paper's six columns and its flume, and compare."""
    from gns_model import validation

    with console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task("reference solver on the paper's scenes", total=1.0)
        result = validation.validate(
            workers=workers,
            flume_spacing=spacing,
            progress=lambda f: bar.update(task, completed=f),
        )
    if as_json:
        print(json.dumps(result, indent=2))
        return
    console.print_table(
        f"Normalised runout of columns, base friction {result['base_friction']:g} (calibrated)",
        ["a = H0/L0", "H0 x L0 (m)", "points", "solver", "paper's MPM", "error"],
        [
            [
                f"{row['aspect']:g}",
                f"{row['height']:g} x {row['length']:g}",
                str(row["points"]),
                f"{row['runout']:.3f}",
                f"{row['paper_mpm']:.3f}",
                f"{row['error']:+.1%}",
            ]
            for row in result["columns"]
        ],
    )
    flume = result["flume"]
    seconds = {k: flume[k] for k in ("row_1_arrival", "row_2_arrival", "rest")}
    print("Flume: " + ", ".join(f"{k} {v:.3f} s" for k, v in seconds.items() if v is not None))
    print("Runout of the front (m): " + str({k: round(v, 2) for k, v in flume["runout"].items()}))
    console.print_table(
        "Peak upstream depth by definition (paper: nearly 0.3 m)",
        ["definition", "depth (m)"],
        [[key, f"{value:.3f}"] for key, value in flume["upstream_depth"].items()],
    )
    print(f"Points that were ever inside a baffle: {flume['points_inside_baffles']}")
    print("within the stated bounds" if result["passed"] else "OUTSIDE the stated bounds")


@app.command()
def generate(
    out: Annotated[Path, typer.Option(help="Folder of the dataset.")],
    family: Annotated[Family, typer.Option(help="Family of scenes.")] = Family.random,
    count: Annotated[int, typer.Option(min=1, help="Trajectories in all shards.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes.")] = 0,
    workers: Workers = CORES,
    spacing: Annotated[
        float | None, typer.Option(help="Of the solver's points in m; default: the paper's.")
    ] = None,
    frame_interval: Annotated[
        float, typer.Option(min=1e-6, help="Between stored frames in s.")
    ] = 0.01,
    jitter: Annotated[
        float, typer.Option(min=0.0, help="Starts off their lattice by up to so many spacings.")
    ] = 0.0,
    points: Annotated[
        str | None, typer.Option(help="least:most, only scenes of as many points, e.g. :3000.")
    ] = None,
    solver: Annotated[
        Solver | None,
        typer.Option(help="Engine of the solver.", show_default="numba; on a GPU torch"),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu; for torch also cuda.")] = "cpu",
    batch: Annotated[int, typer.Option(min=1, help="Scenes at once, for torch.")] = 32,
    shard: Annotated[str, typer.Option(help="i/n: make every n-th trajectory from the i-th.")] = (
        "0/1"
    ),
    quiet: Quiet = False,
) -> None:
    """Make training data with the reference solver; a rerun goes on where it stopped."""
    from gns_model.data.generate import generate as run
    from gns_model.data.generate import parse_points, parse_shard

    part = parse_shard(shard)
    sizes = None if points is None else parse_points(points)
    with console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task(f"{family.value} scenes", total=count)
        paths = run(
            out,
            family=family.value,
            count=count,
            seed=seed,
            spacing=spacing,
            frame_interval=frame_interval,
            jitter=jitter,
            points=sizes,
            workers=workers,
            solver=solver and solver.value,
            device=device,
            batch=batch,
            shard=part,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{len(paths)} trajectories in {out}")


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe (TOML), see examples/recipes.")],
    out: Annotated[Path, typer.Option(help="Folder for weights, state, logs and plot.")],
    resume: Annotated[bool, typer.Option(help="Go on from the state in --out, if any.")] = True,
    ranks: Annotated[
        int, typer.Option(min=1, help="Local processes; under torchrun leave it at 1.")
    ] = 1,
) -> None:
    """Train a learned simulator."""
    from gns_model.training import Recipe, launch
    from gns_model.training import train as run
    from gns_model.training.distributed import leave

    loaded = Recipe.from_toml(recipe)
    if ranks > 1:
        raise typer.Exit(launch(recipe, out, ranks, resume=resume))
    folder = run(loaded, out, resume=resume)
    if os.environ.get("RANK", "0") == "0":
        print(folder)
    leave()


app.command()(evaluate)


register_interop(app)


def main() -> None:
    """Entry point."""
    console.main(app, "gns-model")


if __name__ == "__main__":
    main()
