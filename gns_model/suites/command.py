"""`gns-model evaluate`: against trajectories of one's own, or by the suites of the paper."""

from __future__ import annotations

import json
import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gns_model import console
from gns_model.errors import GnsError

if TYPE_CHECKING:
    from gns_model.simulator import Progress
    from gns_model.suites.result import SuiteResult


class SuiteName(StrEnum):
    """The suites of the paper's tables and figures."""

    columns = "columns"
    friction = "friction"
    upscaled = "upscaled"
    flume = "flume"
    speed = "speed"
    training = "training"
    all = "all"


class Device(StrEnum):
    """Where a model runs."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


#: Suites of columns, which are run from several fillings, and how many.
OF_COLUMNS = (SuiteName.columns, SuiteName.friction, SuiteName.upscaled, SuiteName.all)
FILLINGS = 8

CORES = os.cpu_count() or 1


def evaluate(
    model: Annotated[str, typer.Argument(help="Shipped model, checkpoint folder, or mpm.")],
    suite: Annotated[
        SuiteName | None,
        typer.Option(help="Tables and figures of the paper, beside our own solver."),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="In place of a suite: folder of reference trajectories (HDF5)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results.json, CSV files and figures.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Use at most so many files of --data.")] = 1000,
    gradients: Annotated[
        int, typer.Option(min=0, help="Files of --data to check design gradients on, in full.")
    ] = 0,
    spacing: Annotated[
        float | None,
        typer.Option(help="Of the solver's points in a suite in m; default: the paper's element."),
    ] = None,
    budget: Annotated[
        float,
        typer.Option(min=0.1, help="Seconds a device that the speed and training suites may take."),
    ] = 300.0,
    fillings: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Starts off the lattice whose mean is judged, of columns, friction and upscaled; "
            "0: one start only.",
            show_default="8; 0 for a simulator without `refilled`",
        ),
    ] = None,
    device: Annotated[Device, typer.Option(help="auto: the GPU, if there is one.")] = Device.auto,
    workers: Annotated[
        int,
        typer.Option(
            min=1, help="Cores: scenes side by side, or threads of one.", show_default="all cores"
        ),
    ] = CORES,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Judge a simulator: by the paper's tables and figures, or on trajectories it has not seen."""
    if (suite is None) == (data is None):
        raise GnsError("give either --suite or --data, one of the two")
    if fillings and suite not in OF_COLUMNS:
        raise GnsError("--fillings is for --suite columns, friction, upscaled or all")
    if data is not None:
        _on_data(model, data, out, count, gradients, device, workers, as_json, quiet)
        return
    assert suite is not None
    if out is None:
        raise GnsError("a suite writes tables and figures: give their folder, --out DIR")
    if spacing is not None and not spacing > 0:
        raise GnsError(f"--spacing must be positive, got {spacing:g}")
    _by_suites(model, suite, out, spacing, budget, fillings, device, workers, as_json, quiet)


def _by_suites(
    model: str,
    suite: SuiteName,
    out: Path,
    spacing: float | None,
    budget: float,
    fillings: int | None,
    device: Device,
    workers: int,
    as_json: bool,
    quiet: bool,
) -> None:
    from gns_model.simulator import can_refill, load_simulator
    from gns_model.suites.registry import chosen, run_suites
    from gns_model.suites.setup import Setup

    found = _devices(device)
    simulator = load_simulator(model, **simulator_options(model, found[-1], workers, spacing))
    left_out = chosen(suite.value, simulator)[1]  # refuses what does not fit before any work
    for name, reason in left_out.items():
        print(f"left out: {name}: {reason}", file=sys.stderr)
    if fillings is None:
        fillings = FILLINGS if can_refill(simulator) else 0
    with console.progress_bar(quiet=quiet) as bar:

        def stage(description: str) -> Progress:
            task = bar.add_task(description, total=1.0)
            return lambda fraction: bar.update(task, completed=fraction)

        results: list[SuiteResult] = []
        setup = Setup(out, spacing, workers, found, budget, fillings, stage)
        report = run_suites(simulator, suite.value, setup, finished=results.append)
    for name in report["left_out"].keys() - left_out.keys():
        print(f"left out: {name}: {report['left_out'][name]}", file=sys.stderr)
    for result in results:
        for warning in result.warnings:
            print(f"warning: {warning}", file=sys.stderr)
    if as_json:
        print(json.dumps(report, indent=2))
        return
    for result in results:
        _show(result)
    print(f"tables and figures in {out}")


def simulator_options(
    model: str, device: str, workers: int, spacing: float | None = None
) -> dict[str, Any]:
    """Keyword arguments of `load_simulator`: as many cores as `workers`, be it for scenes side by
    side or for one alone. The solver on a GPU has neither threads nor processes."""
    options: dict[str, Any] = {"device": device}
    if model == "mpm":
        if spacing is not None:
            options["spacing"] = spacing
        return options | ({"workers": workers, "threads": workers} if device == "cpu" else {})
    import torch

    # torch leaves out the second half of hyperthreaded cores, where products only wait
    threads = min(workers, torch.get_num_threads())
    return options | {"workers": workers, "threads": threads}


def _devices(device: Device) -> tuple[str, ...]:
    """Torch devices to measure; a rollout runs on the last."""
    if device is not Device.auto:
        return (device.value,)
    import torch

    return ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)


def _show(result: SuiteResult) -> None:
    # A column without a single number (the paper's, where it has none) is not worth its width.
    result.shown = [s for s in result.shown if any(row[s[0]] is not None for row in result.rows)]
    headings = [heading for _, heading, _ in result.shown]
    console.print_table(result.title, headings, result.cells())
    for aim in result.aims:
        print(aim)
    for key, value in result.facts.items():
        print(f"  {key}: {value:.4g}" if isinstance(value, float) else f"  {key}: {value}")
    print("\n".join([*result.notes, ""]))


def _on_data(
    model: str,
    data: Path,
    out: Path | None,
    count: int,
    gradients: int,
    device: Device,
    workers: int,
    as_json: bool,
    quiet: bool,
) -> None:
    from gns_model.evaluation import compare
    from gns_model.files import write_whole
    from gns_model.gradient_check import gradient_check
    from gns_model.simulator import load_simulator
    from gns_model.trajectory import Trajectory

    simulator = load_simulator(model, **simulator_options(model, _devices(device)[-1], workers))
    files = sorted(data.glob("*.h5"))[:count]
    if not files:
        raise GnsError(f"{data}: no trajectory files (*.h5)")
    references = [Trajectory.load(file) for file in files]
    with console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task(f"{model} on {len(files)} scenes", total=1.0)
        comparison = compare(
            simulator,
            references,
            batch=2 * workers,
            progress=lambda f: bar.update(task, completed=f),
        )
    result = comparison.to_dict()
    if gradients:
        checks = [gradient_check(simulator, r.scene) for r in references[:gradients]]
        result["gradient_cosine"] = [check.cosine for check in checks]
    if out is not None:
        from gns_model.evaluation_figures import deposit_figure, scatter_figure

        write_whole(out / "results.json", json.dumps(result, indent=2).encode())
        comparison.to_csv(out / "results.csv")
        scatter_figure(comparison, out / "scatter.png")
        deposit_figure(comparison, out / "deposits.png")
    if as_json:
        print(json.dumps(result, indent=2))
        return
    console.show(comparison.table())
    if gradients:
        print("cosine of gradient and central differences:", result["gradient_cosine"])
    if out is not None:
        print(f"results in {out}")
