"""The searches against each other at equal cost: rollouts and backward passes both count.

    python benchmarks/searches.py --out runs/searches --jobs 2
    python benchmarks/searches.py --out runs/searches --show   # table and figure of what there is

Every method gets the same number of passes in every scene, once for each seed. A pass is a rollout
or a backward pass through one. Runs that ask for the same layout (the baselines, random starts of
one seed) share what it gave through a file, which saves time; each is counted where it was asked
for. The curve of a run is written as soon as the run ends, a run whose file is there is not run
again, and one that was interrupted finds what it had asked for, so Ctrl-C costs nothing. The table
ends with the difference between hybrid and each other method, seed by seed.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

METHODS = ("random", "rows", "tpe", "gp", "nsga2", "gradient", "lbfgs", "hybrid")
SCENES = ("examples/flume.toml", "examples/flume_six.toml")
COLUMNS = ("scene", "method", "seed", "passes", "rollouts", "backwards", "origin", "cost", "best")
#: Colour and dash of each method; hybrid comes last, on top.
LOOKS = {
    "random": ("#8a8378", (1, 1)),
    "rows": ("#5c7f1e", (5, 2)),
    "tpe": ("#1f8aa0", (1, 0)),
    "gp": ("#2f6fb2", (1, 0)),
    "nsga2": ("#94307c", (1, 1)),
    "gradient": ("#c2571a", (1, 0)),
    "lbfgs": ("#d99a2b", (5, 2)),
    "hybrid": ("#1d1b18", (1, 0)),
}

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--out", type=Path, default=Path("runs/searches"), help="folder of the runs")
parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="scene files")
parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
parser.add_argument("--budget", type=int, default=20, help="passes of each run")
parser.add_argument("--seeds", type=int, default=5, help="runs of each method in each scene")
parser.add_argument("--first-seed", type=int, default=0)
parser.add_argument("--batch", type=int, default=4, help="layouts proposed at a time")
parser.add_argument(
    "--duration", type=float, default=0.5, help="of the flows [s], which rest near 0.6 s"
)
parser.add_argument("--precision", default="auto", help="float32, bfloat16 or auto")
parser.add_argument("--simulator", default="baffle-lite", help="a shipped model or a path")
parser.add_argument("--jobs", type=int, default=1, help="one-thread processes")
parser.add_argument("--csv", type=Path, help="where to put all runs together; default: in --out")
parser.add_argument("--figure", type=Path, help="default: searches.png in --out")
parser.add_argument("--show", action="store_true", help="run nothing")


# -- runs ------------------------------------------------------------------------------------------


class Remembering:
    """An evaluator that runs no layout twice: what is known is in a file that processes share.

    Costs, status and gradients are remembered, which is what a search asks for.
    """

    differentiable = True

    def __init__(self, task: Any, file: Path) -> None:
        from design.evaluators import InProcess

        self._inner, self._file, self._read = InProcess(task), file, 0
        self._known: dict[str, Any] = {}

    def evaluate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Any]]:
        """See `design.campaign.Evaluator`."""
        yield from self._each("cost", self._inner.evaluate, layouts)

    def differentiate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Any]]:
        """See `design.campaign.Evaluator`."""
        yield from self._each("gradient", self._inner.differentiate, layouts)

    def _each(
        self, kind: str, run: Callable[..., Any], layouts: Sequence[np.ndarray]
    ) -> Iterator[tuple[int, Any]]:
        from design.outcome import Outcome

        for k, layout in enumerate(layouts):
            name = f"{kind} {np.round(layout, 6).tolist()}"
            if name not in self._known:
                self._look()
            if name not in self._known:
                outcome = next(iter(run([layout])))[1]
                gradient = None if outcome.gradient is None else outcome.gradient.tolist()
                values = [outcome.cost, outcome.status, outcome.backwards, gradient]
                with self._file.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps([name, *values]) + "\n")
                self._known[name] = values
            cost, status, backwards, gradient = self._known[name]
            slope = None if gradient is None else np.array(gradient)
            yield k, Outcome(cost, {}, status, backwards=backwards, gradient=slope)

    def _look(self) -> None:
        """Read what was written since the last look."""
        if not self._file.exists():
            return
        with self._file.open(encoding="utf-8") as stream:
            stream.seek(self._read)
            for line in iter(stream.readline, ""):
                if not line.endswith("\n"):
                    break  # another process is writing it
                name, *values = json.loads(line)
                self._known[name] = values
                self._read = stream.tell()


def run_file(out: Path, scene: str, method: str, seed: int) -> Path:
    """Where the curve of one run is."""
    return out / f"{Path(scene).stem}-{method}-{seed}.csv"


def run_all(arguments: argparse.Namespace, scene: str, seed: int) -> list[str]:
    """Every method that is missing, with one seed in one scene; a line on each."""
    import optuna
    import torch

    from design.campaign import Campaign
    from design.methods import METHODS as SEARCHES
    from design.trials import TrialLog
    from gns_env.task import BaffleTask
    from gns_model.files import write_whole
    from gns_model.scene import Scene
    from gns_model.simulator import load_simulator

    torch.set_num_threads(1)
    given = Scene.from_toml(scene)
    task = BaffleTask(
        given.replace(duration=arguments.duration),
        load_simulator(arguments.simulator, precision=arguments.precision),
        n_baffles=len(given.baffles),
    )
    evaluator = Remembering(task, arguments.out / f"{Path(scene).stem}.jsonl")
    lines = []
    for method in arguments.methods:
        file = run_file(arguments.out, scene, method, seed)
        if file.exists():
            continue
        began = time.perf_counter()
        log = TrialLog(optuna.create_study(direction="minimize"), task.space)
        campaign = Campaign(log, evaluator, arguments.budget, seed, arguments.batch)
        SEARCHES[method](campaign)
        rollouts = backwards = 0
        best = np.inf
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for trial in log.trials():
            rollouts += trial.outcome.rollouts
            backwards += trial.outcome.backwards
            best = min(best, trial.cost)
            spent = (rollouts + backwards, rollouts, backwards)
            costs = (f"{trial.cost:.6f}", f"{best:.6f}")
            writer.writerow([Path(scene).stem, method, seed, *spent, trial.origin, *costs])
        write_whole(file, text.getvalue().encode())
        lines.append(
            f"{Path(scene).stem} {method} seed {seed}: best {best:.4f} of {rollouts} rollouts and "
            f"{backwards} backward passes, {time.perf_counter() - began:.0f} s"
        )
        print(lines[-1], flush=True)
    return lines


def same_settings(arguments: argparse.Namespace) -> None:
    """Write down what the runs in --out have in common, or refuse to add others to them."""
    from gns_model.files import write_whole

    names = ("budget", "batch", "duration", "simulator", "precision")
    settings = {name: getattr(arguments, name) for name in names}
    file = arguments.out / "settings.json"
    if not file.exists():
        write_whole(file, json.dumps(settings).encode())
    known = json.loads(file.read_text(encoding="utf-8"))
    if known != settings:
        sys.exit(f"the runs in {arguments.out} have {known}, asked for now: {settings}")


def run_missing(arguments: argparse.Namespace) -> None:
    """All runs whose files are not there, seed by seed, so that what is there compares methods."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    same_settings(arguments)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    work = [
        (scene, seed)
        for seed in seeds
        for scene in arguments.scenes
        if not all(run_file(arguments.out, scene, m, seed).exists() for m in arguments.methods)
    ]
    if arguments.jobs == 1 or len(work) < 2:
        for scene, seed in work:
            run_all(arguments, scene, seed)
        return
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(run_all, arguments, scene, seed) for scene, seed in work]
        try:
            for job in as_completed(jobs):
                job.result()
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


# -- what they say ---------------------------------------------------------------------------------


def gather(out: Path) -> list[dict[str, str]]:
    """The rows of all runs in `out`."""
    rows: list[dict[str, str]] = []
    for file in sorted(out.glob("*-*-*.csv")):
        with file.open(newline="", encoding="utf-8") as stream:
            rows += list(csv.DictReader(stream))
    return rows


def curves(rows: Sequence[dict[str, str]], budget: int) -> dict[str, dict[str, dict[int, Any]]]:
    """Least cost so far after 1 to `budget` passes, by scene, method and seed; nan before any."""
    found: dict[str, dict[str, dict[int, Any]]] = {}
    for row in rows:
        seeds = found.setdefault(row["scene"], {}).setdefault(row["method"], {})
        curve = seeds.setdefault(int(row["seed"]), np.full(budget, np.nan))
        spent = int(row["passes"])
        if spent <= budget:
            curve[spent - 1 :] = float(row["best"])
    return found


def interval(values: np.ndarray) -> float:
    """Half of the 95% confidence interval of the mean over the first axis, by Student's t."""
    from scipy.stats import t

    n = len(values)
    return float(t.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n)) if n > 1 else np.nan


def table(rows: Sequence[dict[str, str]], budget: int) -> str:
    """For each scene: mean best cost with its interval, passes, and hybrid less each method."""
    lines = []
    for scene, methods in curves(rows, budget).items():
        ends = {m: {s: c[-1] for s, c in seeds.items()} for m, seeds in methods.items()}
        ranked = sorted(ends, key=lambda m: float(np.mean(list(ends[m].values()))))
        lines += [
            f"{scene}, {budget} passes",
            f"{'rank':>4} {'method':9} {'seeds':>5} {'best cost':>18} {'rollouts':>9} "
            f"{'backward':>9}   hybrid less this, seed by seed",
        ]
        for rank, method in enumerate(ranked, 1):
            values = np.array(list(ends[method].values()))
            last = {
                s: [r for r in rows if (r["scene"], r["method"], r["seed"]) == (scene, method, s)]
                for s in {r["seed"] for r in rows}
            }
            used = [
                np.mean([float(r[-1][kind]) for r in last.values() if r])
                for kind in ("rollouts", "backwards")
            ]
            line = (
                f"{rank:4d} {method:9} {len(values):5d} {values.mean():9.4f} "
                f"± {interval(values):.4f} {used[0]:9.1f} {used[1]:9.1f}"
            )
            both = sorted(set(ends[method]) & set(ends.get("hybrid", {})))
            if method != "hybrid" and both:
                less = np.array([ends["hybrid"][s] - ends[method][s] for s in both])
                line += f"   {less.mean():+.4f} ± {interval(less):.4f}"
            lines.append(line)
        lines.append("")
    return "\n".join(lines)


def figure(rows: Sequence[dict[str, str]], budget: int, path: Path) -> None:
    """Mean least cost so far against passes, one panel a scene, with 95% bands."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    from design.theme import LIGHT

    found = curves(rows, budget)
    with rc_context(LIGHT.rc()):
        drawing = Figure(figsize=(10.4, 4.4), layout="constrained")
        panels = drawing.subplots(1, len(found), squeeze=False)[0]
        passes = np.arange(1, budget + 1)
        for axes, (scene, methods) in zip(panels, found.items(), strict=True):
            ends = []
            for method in [m for m in METHODS if m in methods]:
                colour, dash = LOOKS[method]
                values = np.array(list(methods[method].values()))
                mean = values.mean(axis=0)
                half = np.array([interval(v) for v in values.T])
                top = method == "hybrid"
                axes.fill_between(
                    passes, mean - half, mean + half, step="post", color=colour, lw=0,
                    alpha=0.22 if top else 0.07, zorder=3 if top else 2,
                )  # fmt: skip
                axes.step(
                    passes, mean, where="post", color=colour, ls=(0, dash) if dash[1] else "-",
                    lw=2.4 if top else 1.5, label=method, zorder=5 if top else 4,
                )  # fmt: skip
                ends.append((mean[-1] - half[-1], mean[0]))
            # Chance alone starts far above what everybody else begins with, the first row: what
            # counts is below that, and the rest is cut off.
            low, high = min(e for e, _ in ends), min(s for _, s in ends)
            axes.set(
                title=scene, xlabel="passes: rollouts and backward passes", xlim=(1, budget),
                ylim=(low - 0.2 * (high - low), high + 0.8 * (high - low)),
            )  # fmt: skip
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        panels[0].set_ylabel("least cost so far [-], mean of seeds and 95% interval")
        panels[-1].legend(ncols=2, loc="upper right")
        drawing.savefig(path, dpi=150)


def main() -> None:
    arguments = parser.parse_args()
    stopped = False
    if not arguments.show:
        try:
            run_missing(arguments)
        except KeyboardInterrupt:
            stopped = True
    rows = gather(arguments.out)
    if not rows:
        sys.exit(f"no run in {arguments.out} has ended")
    from gns_model.files import write_whole

    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(arguments.csv or arguments.out / "searches.csv", text.getvalue().encode())
    print(table(rows, arguments.budget))
    figure(rows, arguments.budget, arguments.figure or arguments.out / "searches.png")
    if stopped:
        sys.exit("interrupted: the runs that had ended are kept; the same command goes on")


if __name__ == "__main__":
    main()
