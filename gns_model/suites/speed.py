"""Seconds per rollout step and edges by number of points: the paper's table of computation time."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch

from gns_model.errors import SimulatorError
from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.mpm import MpmSimulator
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator
from gns_model.suites import cost_figures
from gns_model.suites.block import block_scene
from gns_model.suites.cost import Cost, Meter, clock, ratio
from gns_model.suites.plain import plain
from gns_model.suites.result import Row, SuiteResult
from gns_model.suites.setup import Setup, dimension
from gns_model.trajectory import OK

#: Numbers of points by dimension: smaller ones, and the paper's.
SIZES = {
    2: (900, 3_600, 14_000, 40_000, 90_000, 102_000),
    3: (1_700, 6_900, 31_000, 100_000, 250_000, 389_000, 439_000),
}

#: The paper's table: edges, seconds of its MPM on 56 cores, of its GNS on them and on an A100.
PAPER: dict[int, dict[int, tuple[float, float, float, float | None]]] = {
    2: {
        3_600: (0.153e6, 37.0, 5.9, 0.050),
        40_000: (1.8e6, 227.0, 65.3, 0.616),
        90_000: (4.0e6, 596.0, 148.0, 1.515),
        102_000: (4.6e6, 818.0, 170.0, None),
    },
    3: {
        6_900: (0.125e6, 129.0, 4.59, 0.045),
        250_000: (4.8e6, 2767.0, 174.12, 1.521),
        389_000: (7.2e6, 4149.0, 271.56, 1.996),
        439_000: (8.2e6, 4628.0, 306.92, None),
    },
}

SHOWN = (
    ("network", "network", "s"),
    ("device", "device", "s"),
    ("points", "points", ",d"),
    ("edges", "edges", ",d"),
    ("seconds", "s/step", ".4f"),
    ("seconds_bfloat16", "bfloat16", ".4f"),
    ("seconds_plain", "plain", ".4f"),
    ("seconds_mpm", "our MPM", ".4f"),
    ("over_plain", "plain / ours", ".1f"),
    ("bfloat16_over_plain", "plain / bfloat16", ".1f"),
    ("over_mpm", "MPM / ours", ".2f"),
    ("memory_mb", "MB", ",.0f"),
    ("memory_plain_mb", "plain MB", ",.0f"),
    ("paper_cpu", "paper CPU", "g"),
    ("paper_gpu", "paper A100", "g"),
)

#: The kinds of work: ours in both precisions, the plain network, the solver.
KINDS = ("", "_bfloat16", "_plain", "_mpm")


@dataclass(frozen=True)
class Series:
    """One network whose cost is measured over all sizes."""

    name: str
    model: LearnedModel
    paper: bool = False


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Time the simulator's network and the paper's, of random weights, on every device.

    Sizes grow until the budget of a device, shared by its series, or the memory is used up.
    """
    rows: list[Row] = []
    every = series_of(simulator)
    for device in setup.devices:
        for series in every:
            progress = setup.stage(f"speed of {series.name} on {device}")
            rows += _ladder(series, device, setup, setup.budget / len(every), progress)
    cost_figures.speed(rows, PAPER, setup.out / "speed.png")
    return SuiteResult(
        suite="speed",
        title=f"Seconds per rollout step, {setup.threads} thread(s) on the CPU",
        rows=rows,
        shown=[s for s in SHOWN if s[0] != "device" or len(setup.devices) > 1],
        notes=[
            "Same process, same points, same graph; plain is cat-gather-scatter in float32 with "
            "the same weights. Our MPM advances the same points by the same time on "
            f"{setup.threads} thread(s) of the CPU. Edges are directed. Memory: on a CPU above "
            "what was resident before the step, on CUDA all that torch had allocated. One thread's "
            "seconds are CPU seconds.",
            "The paper's columns are its own machines': its MPM is CB-Geo on 56 cores, its GNS on "
            "those and on an A100 of 40 GB.",
        ],
        files=["speed.png"],
    )


def series_of(simulator: Simulator) -> list[Series]:
    """The simulator's own network, if it has one, and the paper's in its dimension."""
    dim = dimension(simulator)
    out = []
    if dim is not None:
        model = getattr(simulator, "model", None)
        if not isinstance(model, LearnedModel):
            raise SimulatorError(f"{simulator.name} has no network whose speed could be measured")
        out.append(Series(simulator.name, model))
    dims: tuple[Literal[2, 3], ...] = (2, 3) if dim is None else (2,) if dim == 2 else (3,)
    for each in dims:
        torch.manual_seed(0)
        out.append(Series(f"paper's {each}D", LearnedModel(ModelConfig.paper(each)), paper=True))
    return out


def _ladder(
    series: Series, device: str, setup: Setup, budget: float, progress: Progress
) -> list[Row]:
    config = series.model.config
    model = copy.deepcopy(series.model).to(device)
    # What is timed is the network: no step may be left to the solver.
    model.config = config.model_copy(update={"solver_steps": 0})
    runners: dict[str, Any] = {
        "": LearnedSimulator(model, threads=setup.threads),
        "_bfloat16": LearnedSimulator(model, threads=setup.threads, precision="bfloat16"),
        "_plain": LearnedSimulator(plain(model), threads=setup.threads),
        "_mpm": MpmSimulator(
            spacing=config.spacing, frame_interval=config.dt, threads=setup.threads
        ),
    }
    meters, counted = {}, {}
    for kind in KINDS:
        where = "cpu" if kind == "_mpm" else device
        counted[kind], now = clock(where, setup.threads)
        meters[kind] = Meter(where, now)
    spent = 0.0
    rows = []
    sizes = SIZES[config.dim]
    for number, points in enumerate(sizes):
        scene = block_scene(config.dim, points, config.spacing)
        start = fill(scene, config.spacing).positions
        edges = len(radius_graph(torch.tensor(start, dtype=torch.float32), config.radius)[0])
        costs: dict[str, Cost] = {}
        for place, kind in enumerate(KINDS):
            began = meters[kind].now()
            steps = _steps_of(runners[kind], scene, config.dt)
            costs[kind] = meters[kind].measure(steps, len(start), budget - spent)
            spent += meters[kind].now() - began
            progress((number + (place + 1) / len(KINDS)) / len(sizes))
        rows.append(
            {
                "network": series.name,
                "dim": config.dim,
                "of_paper": series.paper,
                "device": device,
                "threads": setup.threads,
                "counted": counted[""],
                "points": len(start),
                "edges": edges,
                "latent": config.latent,
                "blocks": config.blocks,
                "dt": config.dt,
                **_columns(costs),
                **_told(config.dim, points if series.paper else None),
            }
        )
        if all(cost.seconds is None for cost in costs.values()):
            break
    progress(1.0)
    return rows


def _steps_of(runner: Simulator, scene: Scene, dt: float) -> Callable[[int], None]:
    """A function that runs so many steps of dt [s]."""

    def steps(count: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a block of this size is outside any model's limits
            trajectory = runner.rollout([scene.replace(duration=count * dt)])[0]
        if trajectory.status != OK:
            raise SimulatorError(
                f"{runner.name} {trajectory.status} on a block of {len(trajectory.particle_type)} "
                "points: its time means nothing"
            )

    return steps


def _columns(costs: dict[str, Cost]) -> Row:
    """Seconds, ratios and memory of one size, and why there is none of them where there is none."""
    row: Row = {f"seconds{kind}": costs[kind].seconds for kind in KINDS}
    row["over_plain"] = ratio(costs["_plain"], costs[""])
    row["bfloat16_over_plain"] = ratio(costs["_plain"], costs["_bfloat16"])
    row["over_mpm"] = ratio(costs["_mpm"], costs[""])
    row |= {f"memory{kind}_mb": costs[kind].megabytes for kind in KINDS}
    row["left_out"] = "; ".join(
        f"{kind[1:] or 'ours'}: {cost.reason}" for kind, cost in costs.items() if cost.reason
    )
    return row


def _told(dim: int, points: int | None) -> Row:
    """What the paper's table says of a size, if it has it."""
    keys = ("paper_edges", "paper_mpm", "paper_cpu", "paper_gpu")
    return dict(zip(keys, PAPER[dim].get(points or 0, (None,) * 4), strict=True))
