"""What a training step costs: the paper's table of parameters, edges, memory and seconds."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch

from gns_model.learned import LearnedModel, ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.learned.world import World
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.suites import cost_figures
from gns_model.suites.block import block_scene
from gns_model.suites.cost import Cost, Meter, clock, ratio
from gns_model.suites.plain import plain
from gns_model.suites.result import Row, SuiteResult
from gns_model.suites.setup import Setup
from gns_model.training.batches import Batch
from gns_model.training.loss import unrolled_loss

#: The paper's table by dimension: edges, parameters, memory [GB] and seconds a step on an A100.
PAPER = {2: (20_000, 1_591_826, 20.0, 0.26), 3: (32_000, 1_592_979, 30.0, 0.38)}
#: Graphs in a batch, as in the paper.
GRAPHS = 2

SHOWN = (
    ("network", "network", "s"),
    ("device", "device", "s"),
    ("parameters", "parameters", ",d"),
    ("edges", "edges", ",d"),
    ("seconds", "s/step", ".3f"),
    ("seconds_bfloat16", "bfloat16", ".3f"),
    ("seconds_plain", "plain", ".3f"),
    ("over_plain", "plain / ours", ".1f"),
    ("bfloat16_over_plain", "plain / bf16", ".1f"),
    ("memory_mb", "MB", ",.0f"),
    ("memory_bfloat16_mb", "bf16 MB", ",.0f"),
    ("memory_plain_mb", "plain MB", ",.0f"),
    ("paper_seconds", "paper A100", "g"),
    ("paper_memory_gb", "paper GB", "g"),
)

KINDS = ("", "_bfloat16", "_plain")


@dataclass(frozen=True)
class Setting:
    """A network and the number of edges of its batch."""

    name: str
    model: LearnedModel
    paper: bool = False

    @property
    def edges(self) -> int:
        """The paper's number for this dimension."""
        return PAPER[self.model.config.dim][0]


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Time training steps of the paper's two networks and the simulator's own, on every device."""
    rows: list[Row] = []
    settings = settings_of(simulator)
    for device in setup.devices:
        progress = setup.stage(f"training steps on {device}")
        for number, setting in enumerate(settings):
            rows.append(_row(setting, device, setup, setup.budget / len(settings)))
            progress((number + 1) / len(settings))
    cost_figures.training(rows, setup.out / "training.png")
    return SuiteResult(
        suite="training",
        title=f"Cost of a training step, {setup.threads} thread(s) on the CPU",
        rows=rows,
        shown=SHOWN,
        notes=[
            f"A step: graph of {GRAPHS} blocks of grains, forward, backward, gradient norm, AdamW. "
            "Weights are random where the paper's network is meant; plain is cat-gather-scatter in "
            "float32. The paper's columns are an A100's.",
        ],
        files=["training.png"],
    )


def settings_of(simulator: Simulator) -> list[Setting]:
    """The paper's two networks and, if it has one, the simulator's."""
    out = []
    for dim in (2, 3):
        torch.manual_seed(0)
        model = LearnedModel(ModelConfig.paper(2 if dim == 2 else 3))
        out.append(Setting(f"paper's {dim}D", model, paper=True))
    own = getattr(simulator, "model", None)
    if isinstance(own, LearnedModel):
        out.append(Setting(simulator.name, own))
    return out


def block_batch(config: ModelConfig, edges: int, device: str, graphs: int = GRAPHS) -> Batch:
    """Blocks of grains in motion with about `edges` directed edges altogether.

    What they do is random: only the cost of a step is of interest.
    """
    rng = np.random.default_rng(0)
    start, scene = _block_with(config, edges / graphs, rng)
    velocity = np.array([1.0] + [0.0] * (config.dim - 1))
    past = np.arange(-config.history, 1)[:, None] * config.dt * velocity
    history = start[:, None] + past + rng.normal(0, 1e-4, (len(start), len(past), config.dim))
    moves = config.dt * velocity + rng.normal(0, config.dt**2, (len(start), 1, config.dim))

    def tensor(values: np.ndarray) -> torch.Tensor:
        whole = np.concatenate([values] * graphs)
        return torch.tensor(whole, dtype=torch.float32, device=device)

    world = World.from_scenes([scene] * graphs, [len(start)] * graphs, device=device)
    return Batch(tensor(history), tensor(moves), world)


def _block_with(
    config: ModelConfig, edges: float, rng: np.random.Generator
) -> tuple[np.ndarray, Scene]:
    """Loose points (N, D) of a block with about `edges` edges, and the scene that they stand in."""
    points, best = edges / 10, (math.inf, np.empty(0), block_scene(config.dim, 8, config.spacing))
    for _ in range(6):  # the share of points at the surface falls as blocks grow
        scene = block_scene(config.dim, round(points), config.spacing)
        start = fill(scene, config.spacing).positions
        start = start + rng.uniform(-0.2, 0.2, start.shape) * config.spacing
        found = len(radius_graph(torch.tensor(start, dtype=torch.float32), config.radius)[0])
        if abs(found - edges) < best[0]:
            best = abs(found - edges), start, scene
        points = len(start) * edges / max(1, found)
    return best[1], best[2]


def stepper(model: LearnedModel, batch: Batch, *, short: bool) -> Callable[[int], float]:
    """A function that takes so many training steps and returns the loss before the last.

    Args:
        short: products in bfloat16, as the recipes' precision = "bfloat16".
    """
    model = copy.deepcopy(model).train().requires_grad_(True)
    device = batch.history.device.type
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-4)

    def steps(count: int) -> float:
        value = math.nan
        for _ in range(count):
            with torch.autocast(device, torch.bfloat16) if short else nullcontext():
                loss = unrolled_loss(model, batch)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            value = loss.item()  # waits for a GPU
        return value

    return steps


def _row(setting: Setting, device: str, setup: Setup, budget: float) -> Row:
    config = setting.model.config
    model = copy.deepcopy(setting.model).to(device)
    batch = block_batch(config, setting.edges, device)
    edges = len(radius_graph(batch.history[:, -1], config.radius, batch.world.batch)[0])
    networks = {"": model, "_bfloat16": model, "_plain": plain(model)}
    costs: dict[str, Cost] = {}
    counted, now = clock(device, setup.threads)
    threads = torch.get_num_threads()
    torch.set_num_threads(setup.threads)
    try:
        for kind in KINDS:
            steps = stepper(networks[kind], batch, short=kind == "_bfloat16")
            costs[kind] = Meter(device, now).measure(steps, edges, budget / len(KINDS))
    finally:
        torch.set_num_threads(threads)
    row: Row = {
        "network": setting.name,
        "dim": config.dim,
        "device": device,
        "threads": setup.threads,
        "counted": counted,
        "parameters": sum(p.numel() for p in setting.model.parameters()),
        "points": len(batch.history),
        "edges": edges,
    }
    row |= {f"seconds{kind}": costs[kind].seconds for kind in KINDS}
    row["over_plain"] = ratio(costs["_plain"], costs[""])
    row["bfloat16_over_plain"] = ratio(costs["_plain"], costs["_bfloat16"])
    row |= {f"memory{kind}_mb": costs[kind].megabytes for kind in KINDS}
    told = PAPER[config.dim] if setting.paper else (None,) * 4
    keys = ("paper_edges", "paper_parameters", "paper_memory_gb", "paper_seconds")
    return {**row, **dict(zip(keys, told, strict=True))}
