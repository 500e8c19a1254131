"""Design gradients against central differences through whole rollouts, and what each costs.

    python benchmarks/gradients.py                          # two layouts of the flume, four starts
    python benchmarks/gradients.py --starts 2 --kinds exact smoothed

A flow of grains is chaotic, so even the central difference of a finite move depends on where single
grains start. Each layout is therefore moved by `--step` in every coordinate under several starts
that differ in the choice of tracers alone (`LearnedSimulator.perturbed_start`). The mean over
starts is what a gradient has to agree with, and a component counts as known where it exceeds the
standard deviation over starts. Cosines are given over all components and over the known ones, of
each gradient by itself (one rollout, one backward pass) and of the mean over starts. All that is
computed is kept in `--cache`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from design.evaluators import SimulatorSpec
from design.gradient import smooth_costs
from gns_env.task import BaffleTask
from gns_model.learned.adjoint import ADJOINT_LIMIT, ADJOINT_SMOOTHING
from gns_model.scene import Scene

#: Kinds of gradient: limit and smoothing of the adjoints.
KINDS: dict[str, tuple[float | None, float]] = {
    "exact": (None, 0.0),
    "limited": (ADJOINT_LIMIT, 0.0),
    "smoothed": (ADJOINT_LIMIT, ADJOINT_SMOOTHING),
}
#: A layout that is no engineer's: three baffles askew.
ASKEW = np.array([[0.8, 0.6], [0.85, 1.25], [1.15, 0.9]])

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--scene", default="examples/flume.toml")
parser.add_argument("--simulator", default="baffle-lite", help="a shipped model or a path")
parser.add_argument("--starts", type=int, default=4, help="perturbed starts, the usual one first")
parser.add_argument("--step", type=float, default=0.02, help="of the central differences [m]")
parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
parser.add_argument("--exact-starts", type=int, default=1, help="starts of the exact gradient")
parser.add_argument("--cache", type=Path, default=Path("runs/gradients"))


class Book:
    """Smooth costs and gradients of layouts, computed once and kept in a file of JSON lines."""

    def __init__(self, task: BaffleTask, spec: SimulatorSpec, folder: Path) -> None:
        self.task = task
        about = json.dumps([task.scene.to_dict(), spec.describe()], sort_keys=True, default=str)
        self._file = folder / f"{hashlib.sha256(about.encode()).hexdigest()[:12]}.jsonl"
        folder.mkdir(parents=True, exist_ok=True)
        lines = self._file.read_text("utf-8").splitlines() if self._file.exists() else []
        self._known: dict[str, Any] = dict(json.loads(line) for line in lines)

    def cost(self, centres: np.ndarray, start: int) -> float:
        """The smooth cost of a layout [m], shape (n, D-1): one rollout."""
        name = f"cost {np.round(centres, 6).tolist()} start {start}"
        if name not in self._known:
            with torch.no_grad():
                _, costs = smooth_costs(self.task, [torch.tensor(centres)], draws=[start])
            self._keep(name, float(costs.sum()))
        return float(self._known[name])

    def gradient(
        self, centres: np.ndarray, start: int, limit: float | None, smoothing: float
    ) -> np.ndarray:
        """Its derivative [1/m], shape (n, D-1): one rollout and one backward pass."""
        where = f"{np.round(centres, 6).tolist()} start {start}"
        name = f"gradient {where} limit {limit} smoothing {smoothing}"
        if name not in self._known:
            leaf = torch.tensor(centres, requires_grad=True)
            _, costs = smooth_costs(
                self.task, [leaf], limit=limit, smoothing=smoothing, draws=[start]
            )
            costs.sum().backward()
            assert leaf.grad is not None
            self._keep(name, leaf.grad.tolist())
        return np.array(self._known[name])

    def differences(self, centres: np.ndarray, start: int, step: float) -> np.ndarray:
        """Central differences [1/m], shape (n, D-1): two rollouts for each coordinate."""
        found = np.zeros_like(centres)
        for index in np.ndindex(*centres.shape):
            move = np.zeros_like(centres)
            move[index] = step
            ahead, behind = (self.cost(centres + m, start) for m in (move, -move))
            found[index] = (ahead - behind) / (2 * step)
        return found

    def _keep(self, name: str, value: Any) -> None:
        self._known[name] = value
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps([name, value]) + "\n")


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of two arrays of one shape."""
    return float((a * b).sum() / (np.linalg.norm(a) * np.linalg.norm(b)))


def main() -> None:
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene = Scene.from_toml(arguments.scene)
    own = np.array([b.center for b in scene.baffles])
    spec = SimulatorSpec(arguments.simulator)
    book = Book(BaffleTask(scene, spec.load(), n_baffles=len(own)), spec, arguments.cache)
    starts = range(arguments.starts)
    layouts = {"scene's own": own}
    if own.shape == ASKEW.shape:
        layouts["askew"] = ASKEW
    for layout, centres in layouts.items():
        numeric = np.array([book.differences(centres, s, arguments.step) for s in starts])
        mean = numeric.mean(axis=0)
        known = np.abs(mean) > numeric.std(axis=0, ddof=1) if len(numeric) > 1 else mean != 0
        print(
            f"{layout} layout of {scene.name}, {arguments.simulator}, {scene.duration} s, "
            f"differences of {100 * arguments.step:g} cm under {len(numeric)} starts "
            f"({2 * centres.size * len(numeric)} rollouts)\n"
            f"  differences [1/m]: {np.round(mean.ravel(), 3).tolist()}\n"
            f"  {known.sum()} of {known.size} components exceed the spread over starts: "
            f"{known.ravel().astype(int).tolist()}"
        )
        print(f"  {'gradient':28} {'passes':>6} {'cosine, all':>12} {'known':>6} {'length':>7}")
        one = [(cosine(n, mean), cosine(n[known], mean[known]), np.linalg.norm(n)) for n in numeric]
        show("differences of one start", 2 * centres.size, one, mean)
        for kind in arguments.kinds:
            mine = starts[: arguments.exact_starts] if kind == "exact" else starts
            found = [book.gradient(centres, s, *KINDS[kind]) for s in mine]
            one = [
                (cosine(g, mean), cosine(g[known], mean[known]), np.linalg.norm(g)) for g in found
            ]
            show(f"{kind}, one start", 2, one, mean)
            if len(found) > 1:
                g = np.mean(found, axis=0)
                both = [(cosine(g, mean), cosine(g[known], mean[known]), np.linalg.norm(g))]
                show(f"{kind}, mean of {len(found)}", 2 * len(found), both, mean)
        print()


def show(name: str, passes: int, found: list[tuple[Any, ...]], mean: np.ndarray) -> None:
    """One line: mean and least cosine, and the length against that of the differences."""
    everything, known, length = (np.array(column) for column in zip(*found, strict=True))
    ratio = length.mean() / np.linalg.norm(mean)
    line = f"  {name:28} {passes:6d} {everything.mean():12.2f} {known.mean():6.2f} {ratio:7.2f}"
    if len(found) > 1:
        line += f"  (least {everything.min():.2f}, {known.min():.2f})"
    print(line, flush=True)


if __name__ == "__main__":
    main()
