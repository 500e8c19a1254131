"""gns-design: find a baffle layout, and measure one.

Heavy imports wait until a command needs them, so that --help answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from design.calibrate import calibrate
from design.evaluate import evaluate
from design.options import (
    Device,
    SceneFile,
    Simulator,
    Spacing,
    Weight,
    build,
    many,
    names_of,
    objective_of,
    rounds_of,
    run,
    simulator_spec,
    small,
    trust,
)
from design.rebuild import report
from gns_model import console

app = typer.Typer(
    help="Find where baffles stop a granular flow, checked by the reference solver.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.command()
def optimize(
    scene: SceneFile,
    method: Annotated[
        str | None,
        typer.Option(
            help="random, rows, tpe, gp, nsga2, bayes (gp or tpe by budget), gradient (Adam), "
            "lbfgs or hybrid; default: hybrid where the simulator has a gradient."
        ),
    ] = None,
    baffles: Annotated[
        int | None, build(help="How many baffles; default: as many as the scene has, or 3.")
    ] = None,
    number: Annotated[
        str | None, build(help="Range for the number of baffles, such as 2:6: the search chooses.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        build(
            help="Range of what the search may choose of the baffles' form, one for all: "
            "height=0.2:0.4, along=, across= (m) or yaw= (degrees); may be given several times."
        ),
    ] = None,
    pattern: Annotated[
        str, build(help="free, or rows: straight rows with stagger and spacing.")
    ] = "free",
    max_height: Annotated[float | None, build(help="Greatest height of a baffle in m.")] = None,
    max_volume: Annotated[
        float | None, build(help="Most concrete in all, in cubic metres.")
    ] = None,
    wall_gap: Annotated[
        float | None, build(help="Least distance of a baffle to the walls in m.")
    ] = None,
    max_overtopping: Annotated[
        float | None, small(help="Most mass that may go over the baffles' tops, as a share.")
    ] = None,
    freeboard: Annotated[
        float | None,
        small(
            help="Least height in m of the baffles' tops above the peak upstream depth; 0: it may "
            "be as deep as they are high."
        ),
    ] = None,
    baffle_cost: Annotated[
        float, small(help="Cost of each baffle, in units of the objective.")
    ] = 0.0,
    concrete_cost: Annotated[
        float, small(help="Cost of a cubic metre of concrete, in units of the objective.")
    ] = 0.0,
    budget: Annotated[
        int | None,
        typer.Option(
            help="Rollouts of the search; a gradient's backward pass counts as one too; default: "
            "48, for each scenario."
        ),
    ] = None,
    objectives: Annotated[
        str | None,
        small(
            help="Two or more of runout, p99, depth and mass, such as runout,depth: search for "
            "their Pareto front."
        ),
    ] = None,
    scenarios: Annotated[
        int | None,
        many(help="Make the risk over so many flows small, drawn from the three ranges below."),
    ] = None,
    speed: Annotated[
        str | None,
        many(help="Range of the release's speed in m/s; default: 0.8 to 1.2 times the scene's."),
    ] = None,
    volume: Annotated[
        str | None, many(help="Range of the volume, relative to the scene's; default: 0.8:1.2.")
    ] = None,
    friction: Annotated[
        str | None,
        many(
            help="Range of the friction angle in degrees; default: 5 less to 5 more than the "
            "scene's. The default ranges keep to what a learned simulator was trained for."
        ),
    ] = None,
    risk: Annotated[
        str | None,
        many(help="mean of the scenarios' costs, or cvar: the mean of the worst; default: mean."),
    ] = None,
    cvar_level: Annotated[
        float | None,
        many(help="Share of the scenarios that the CVaR leaves out, the best ones; default: 0.8."),
    ] = None,
    verify: Annotated[
        int, trust(help="How many of the best the reference solver judges; 0: none.")
    ] = 4,
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    out: Annotated[Path | None, run(help="Run folder; default: runs/<name of the scene>.")] = None,
    storage: Annotated[
        str | None,
        run(
            help="Address of a database, such as postgresql://user@host/database: workers that are "
            "given the same one share the search and its budget, each with an --out of its own; "
            "default: SQLite in the run folder."
        ),
    ] = None,
    study: Annotated[
        str, run(help="Name of the study in --storage, one for each problem.")
    ] = "gns-design",
    grace: Annotated[
        int,
        run(
            help="Seconds without a sign of life after which the trials of another worker on "
            "--storage are tried again."
        ),
    ] = 60,
    resume: Annotated[
        bool, run("--resume", help="Go on with what the run folder and storage hold.")
    ] = False,
    simulator: Simulator = "baffle-lite",
    spacing: Spacing = None,
    device: Device = "cpu",
    verify_with: Annotated[str, trust(help="Who judges the best layouts.")] = "mpm",
    verify_spacing: Spacing = None,
    runout_weight: Weight = None,
    depth_weight: Weight = None,
    mass_weight: Weight = None,
    batch: Annotated[int, typer.Option(help="Layouts proposed at a time.")] = 8,
    workers: Annotated[
        int | None, run(help="Processes of one thread; default: one a core.")
    ] = None,
    ensemble: Annotated[
        list[str] | None,
        trust(
            help="Further learned models that judge what may be verified: names or checkpoint "
            "folders, again for each or with commas; none: nobody. Default: those that the model's "
            "card names."
        ),
    ] = None,
    refine: Annotated[
        bool,
        trust(
            "--refine",
            help="Train the model on the verified layouts, then search and verify again.",
        ),
    ] = False,
    refine_rounds: Annotated[int, trust(help="How often, with --refine.")] = 1,
    refine_minutes: Annotated[
        float, trust(help="Minutes of training in each round of --refine.")
    ] = 5.0,
    refine_data: Annotated[
        Path | None,
        trust(
            help="Folder of trajectories that --refine mixes in, so that the model does not forget "
            "them; default: none."
        ),
    ] = None,
    quiet: Annotated[bool, run("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Search for a layout of baffles, verify the best on the reference solver, write a report."""
    with console.clean_errors():
        from gns_model.scene import Scene

        given = Scene.from_toml(scene)
        from design.objectives import parse
        from design.printed import print_summary
        from design.run import Interrupted, optimise
        from design.scenarios import scenarios_of
        from design.settings import Settings
        from design.variables import placement_of

        names = parse(objectives) if objectives is not None else ()
        settings = Settings(
            method=method,
            objectives=names,
            scenarios=scenarios_of(scenarios, speed, volume, friction, risk, cvar_level, seed),
            baffles=baffles,
            budget=budget,
            verify=verify,
            seed=seed,
            simulator=simulator_spec(simulator, spacing, device),
            # The reference solver judges beside the search, on the cores that a GPU leaves free.
            verifier=simulator_spec(
                verify_with, verify_spacing, "cpu" if verify_with == "mpm" else device
            ),
            objective=objective_of(
                runout_weight=runout_weight, depth_weight=depth_weight, mass_weight=mass_weight
            ),
            storage=storage,
            study=study,
            grace=grace,
            resume=resume,
            workers=workers,
            batch=batch,
            pattern=pattern,
            baffle_cost=baffle_cost,
            concrete_cost=concrete_cost,
            placement=placement_of(
                vary or (),
                number,
                max_height=max_height,
                max_volume=max_volume,
                wall_gap=wall_gap,
                max_overtopping=max_overtopping,
                freeboard=freeboard,
            ),
            ensemble=names_of(ensemble),
            refine=rounds_of(refine, refine_rounds),
            refine_minutes=refine_minutes,
            refine_data=refine_data,
        )
        folder = out if out is not None else Path("runs") / given.name
        try:
            summary = optimise(given, folder, settings, command=console.command(), quiet=quiet)
        except Interrupted as left:
            if not quiet:
                print_summary(left.summary, folder)
            raise
        if not quiet:
            print_summary(summary, folder)


app.command()(evaluate)
app.command()(report)
app.command()(calibrate)


def main() -> None:
    """Entry point of the command."""
    console.main(app, "gns-design")


if __name__ == "__main__":
    main()
