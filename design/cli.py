"""gns-design: find a baffle layout, and measure one.

Heavy imports wait until a command needs them, so that --help answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from design.calibrate import calibrate
from design.evaluate import evaluate
from design.options import (
    Device,
    SceneFile,
    Simulator,
    Spacing,
    Weight,
    names_of,
    objective_of,
    rounds_of,
    simulator_spec,
)
from design.rebuild import report
from design.trust import trust_lines
from gns_model import console

if TYPE_CHECKING:
    from rich.table import Table

app = typer.Typer(
    help="Find where baffles stop a granular flow, checked by the reference solver.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


#: Panels of --help.
BUILD, SMALL = "What may be built", "What to make small"
MANY, TRUST, RUN = "Many flows", "Trust", "The run"


@app.command()
def optimize(
    scene: SceneFile,
    method: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="random, rows, tpe, gp, nsga2, bayes (gp or tpe by budget), gradient (Adam), "
            "lbfgs or hybrid; default: hybrid where the simulator has a gradient."
        ),
    ] = None,
    baffles: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="How many baffles; default: as many as the scene has, or 3.", rich_help_panel=BUILD
        ),
    ] = None,
    number: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Range for the number of baffles, such as 2:6: the search chooses.",
            show_default=False,
            rich_help_panel=BUILD,
        ),
    ] = None,
    vary: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            help="Range of what the search may choose of the baffles' form, one for all: "
            "height=0.2:0.4, along=, across= (m) or yaw= (degrees); may be given several times.",
            show_default=False,
            rich_help_panel=BUILD,
        ),
    ] = None,
    pattern: Annotated[
        str,
        typer.Option(
            help="free, or rows: straight rows with stagger and spacing.", rich_help_panel=BUILD
        ),
    ] = "free",
    max_height: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Greatest height of a baffle in m.", show_default=False, rich_help_panel=BUILD
        ),
    ] = None,
    max_volume: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Most concrete in all, in cubic metres.", show_default=False, rich_help_panel=BUILD
        ),
    ] = None,
    wall_gap: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Least distance of a baffle to the walls in m.",
            show_default=False,
            rich_help_panel=BUILD,
        ),
    ] = None,
    max_overtopping: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Most mass that may go over the baffles' tops, as a share.",
            show_default=False,
            rich_help_panel=SMALL,
        ),
    ] = None,
    freeboard: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Least height in m of the baffles' tops above the peak upstream depth; 0: it may "
            "be as deep as they are high.",
            show_default=False,
            rich_help_panel=SMALL,
        ),
    ] = None,
    baffle_cost: Annotated[
        float,
        typer.Option(help="Cost of each baffle, in units of the objective.", rich_help_panel=SMALL),
    ] = 0.0,
    concrete_cost: Annotated[
        float,
        typer.Option(
            help="Cost of a cubic metre of concrete, in units of the objective.",
            rich_help_panel=SMALL,
        ),
    ] = 0.0,
    budget: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="Rollouts of the search; a gradient's backward pass counts as one too; default: "
            "48, for each scenario.",
            show_default=False,
        ),
    ] = None,
    objectives: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Two or more of runout, p99, depth and mass, such as runout,depth: search for "
            "their Pareto front.",
            show_default=False,
            rich_help_panel=SMALL,
        ),
    ] = None,
    scenarios: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="Make the risk over so many flows small, drawn from the three ranges below.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    speed: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Range of the release's speed in m/s; default: 0.8 to 1.2 times the scene's.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    volume: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Range of the volume, relative to the scene's; default: 0.8:1.2.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    friction: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Range of the friction angle in degrees; default: 5 less to 5 more than the "
            "scene's. The default ranges keep to what a learned simulator was trained for.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    risk: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="mean of the scenarios' costs, or cvar: the mean of the worst; default: mean.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    cvar_level: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            help="Share of the scenarios that the CVaR leaves out, the best ones; default: 0.8.",
            show_default=False,
            rich_help_panel=MANY,
        ),
    ] = None,
    verify: Annotated[
        int,
        typer.Option(
            help="How many of the best the reference solver judges; 0: none.", rich_help_panel=TRUST
        ),
    ] = 4,
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Run folder; default: runs/<name of the scene>.",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ] = None,
    storage: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Address of a database, such as postgresql://user@host/database: workers that are "
            "given the same one share the search and its budget, each with an --out of its own; "
            "default: SQLite in the run folder.",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ] = None,
    study: Annotated[
        str,
        typer.Option(
            help="Name of the study in --storage, one for each problem.", rich_help_panel=RUN
        ),
    ] = "gns-design",
    grace: Annotated[
        int,
        typer.Option(
            help="Seconds without a sign of life after which the trials of another worker on "
            "--storage are tried again.",
            rich_help_panel=RUN,
        ),
    ] = 60,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Go on with what the run folder and storage hold.", rich_help_panel=RUN
        ),
    ] = False,
    simulator: Simulator = "baffle-lite",
    spacing: Spacing = None,
    device: Device = "cpu",
    verify_with: Annotated[
        str, typer.Option(help="Who judges the best layouts.", rich_help_panel=TRUST)
    ] = "mpm",
    verify_spacing: Spacing = None,
    runout_weight: Weight = None,
    depth_weight: Weight = None,
    mass_weight: Weight = None,
    batch: Annotated[int, typer.Option(help="Layouts proposed at a time.")] = 8,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="Processes of one thread; default: one a core.",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ] = None,
    ensemble: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            help="Further learned models that judge what may be verified: names or checkpoint "
            "folders, again for each or with commas; none: nobody. Default: those that the model's "
            "card names.",
            show_default=False,
            rich_help_panel=TRUST,
        ),
    ] = None,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine",
            help="Train the model on the verified layouts, then search and verify again.",
            rich_help_panel=TRUST,
        ),
    ] = False,
    refine_rounds: Annotated[
        int, typer.Option(help="How often, with --refine.", rich_help_panel=TRUST)
    ] = 1,
    refine_minutes: Annotated[
        float,
        typer.Option(help="Minutes of training in each round of --refine.", rich_help_panel=TRUST),
    ] = 5.0,
    refine_data: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of trajectories that --refine mixes in, so that the model does not forget "
            "them; default: none.",
            show_default=False,
            rich_help_panel=TRUST,
        ),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="No progress, no table.", rich_help_panel=RUN)
    ] = False,
) -> None:
    """Search for a layout of baffles, verify the best on the reference solver, write a report."""
    with console.clean_errors():
        from gns_model.scene import Scene

        given = Scene.from_toml(scene)
        from design.objectives import parse
        from design.run import Settings, optimise
        from design.scenarios import scenarios_of
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
        summary = optimise(given, folder, settings, command=console.command(), quiet=quiet)
        if not quiet:
            _show(summary, folder)


app.command()(evaluate)
app.command()(report)
app.command()(calibrate)


def _show(summary: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from gns_model.measures import UNITS

    out = Console(soft_wrap=True)
    verified = bool((summary["best"] or {}).get("verified"))
    who = summary["settings"]["verify_with" if verified else "simulator"]["name"]
    table = Table(title=f"Measures by {who}")
    for column in ("", "best found", "scene's own", "no baffles"):
        table.add_column(column, justify="left" if not column else "right")
    role = "verified" if verified else "surrogate"
    columns = [(summary[k] or {}).get(role) or {} for k in ("best", "paper_layout", "no_baffles")]
    for name, unit in UNITS.items():
        values = [f"{c[name]:.4g}" if name in c else "-" for c in columns]
        table.add_row(f"{name} [{unit}]".replace("[", r"\["), *values)
    key = "verified_cost" if verified else "cost"
    costs = [(summary[k] or {}).get(key) for k in ("best", "paper_layout", "no_baffles")]
    table.add_row("cost", *(f"{c:.4f}" if c is not None else "-" for c in costs))
    out.print(table)
    if summary["best"]:
        places = "  ".join(
            "(" + ", ".join(f"{v:.3f}" for v in c) + ")" for c in summary["best"]["layout"]
        )
        out.print(f"Layout, centres [m]: {places}", markup=False, highlight=False)
        size = summary["best"].get("size")
        if size:
            turned = f", turned by {summary['best'].get('yaw', 0):.1f} degrees"
            text = " x ".join(f"{v:.3f}" for v in size)
            said = f"Every baffle (along, height{', across' * (len(size) == 3)}): {text} m"
            out.print(said + turned * ("yaw" in summary["best"]), markup=False, highlight=False)
    for c in summary.get("constraints", ()):
        verb = "holds" if c["holds"] else "DOES NOT HOLD"
        out.print(
            f"{c['name']}: {c['value']:.4g} {c['unit']}, {c['relation']} {c['limit']:.4g}: {verb} "
            f"(by {c['by']})",
            markup=False,
            highlight=False,
        )
    if summary.get("front"):
        out.print(_front_table(summary["front"]))
    if summary.get("scenarios"):
        out.print(
            f"Costs are the {summary['risk']} over {len(summary['scenarios'])} scenarios, measures "
            "their means.",
            markup=False,
            highlight=False,
        )
    out.print(summary["verdict_text"], markup=False, highlight=False)
    for line in trust_lines(summary):
        out.print(line, markup=False, highlight=False)
    for note in summary["notes"]:
        out.print(f"Note: {note}", markup=False, highlight=False)
    out.print(
        f"{summary['rollouts']} rollouts, {summary['backwards']} backward passes, "
        f"{summary['reference_rollouts']} reference rollouts, "
        f"{summary['seconds']['total']:.0f} s. Open {folder / 'report.html'}",
        markup=False,
        highlight=False,
    )


def _front_table(entries: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    names = list(entries[0]["objectives"])
    table = Table(title="Pareto front, relative to no baffles")
    for column in ("point", *names, *(f"{n}, verified" for n in names), "file"):
        table.add_column(column, justify="left" if column == "file" else "right")
    for e in entries:
        verified = e["verified_objectives"] or {}
        table.add_row(
            str(e["point"]),
            *(f"{e['objectives'][n]:.4f}" for n in names),
            *(f"{verified[n]:.4f}" if n in verified else "-" for n in names),
            e["file"],
        )
    return table


def main() -> None:
    """Entry point of the command."""
    console.main(app, "gns-design")


if __name__ == "__main__":
    main()
