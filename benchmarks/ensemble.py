"""Does the spread of an ensemble tell where a learned simulator is wrong?

    python benchmarks/ensemble.py --members runs/lite2/model --data data/test

Scenes: unseen layouts whose reference trajectories are in --data, and flows out of the model's
depth (`beyond`), which the reference solver simulates here (35 CPU seconds each). Everything is
rolled out once and found again in --cache.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import Progress

from design.ensemble import Ensemble, beyond_limits, relative_spread
from design.evaluators import SimulatorSpec
from design.outcome import Outcome
from design.store import Pending, Rolled, RolloutStore, Watch
from gns_env.objective import Objective
from gns_model import measures
from gns_model.console import print_table, progress_bar
from gns_model.evaluation import rank_correlation
from gns_model.files import write_whole
from gns_model.learned.checkpoint import CARD, read_card
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory
from gns_model.workers import Workers

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--model", default="baffle-lite")
parser.add_argument("--members", nargs="*", default=[], help="further models, beside their own")
parser.add_argument("--fillings", type=int, default=0, help="further fillings of the model")
parser.add_argument("--data", type=Path, required=True, help="folder of unseen layouts")
parser.add_argument("--layouts", type=int, default=32, help="how many of them")
parser.add_argument("--cache", type=Path, default=Path("runs/ensemble"))
parser.add_argument("--write", type=Path, help="checkpoint whose card shall name this ensemble")
parser.add_argument("--workers", type=int, default=1)

UNSEEN = "unseen layouts"
MEASURES = ("cost", "centroid_travel", "upstream_depth", "runout_p99", "mass_past_section")


@dataclass
class Case:
    """A scene by the reference solver and by each simulator, with and without its baffles."""

    name: str
    scene: Scene
    true: dict[str, float]
    true_none: dict[str, float]
    members: list[Rolled]
    members_none: list[Rolled]
    broken: list[str]


def beyond() -> dict[str, Scene]:
    """The paper's flume, changed in one thing at a time beyond what baffle-lite was trained on."""
    flume = Scene.from_toml(Path(__file__).parent.parent / "examples" / "flume.toml")
    values = flume.to_dict()

    def changed(name: str, **changes: object) -> Scene:
        return Scene.from_dict({**values, "name": name, **changes})

    def thrown(speed: float) -> list[dict[str, object]]:
        return [{**values["release"][0], "velocity": [speed, 0.0, 0.0]}]

    def boxes(places: list[tuple[float, float]], size: list[float]) -> list[dict[str, object]]:
        return [{"center": list(p), "size": size} for p in places]

    row = [(0.75, z) for z in (0.5, 0.75, 1.0, 1.25, 1.5)]
    lattice = [(0.75, 0.205 + 0.199 * k) for k in range(9)]
    return {
        "faster, 3.5 m/s": changed("faster", release=thrown(3.5)),
        "slower, 0.3 m/s": changed("slower", release=thrown(0.3)),
        "friction 45 degrees, base 1": changed(
            "rough",
            material={**values["material"], "friction_angle": 45.0},
            friction={**values["friction"], "base": 1.0},
        ),
        "friction 25 degrees, base 0.3": changed(
            "smooth",
            material={**values["material"], "friction_angle": 25.0},
            friction={**values["friction"], "base": 0.3},
        ),
        "gaps of 5 cm": changed("slits", baffle=boxes(lattice, [0.15, 0.3, 0.15])),
        "posts of 4 cm": changed("posts", baffle=boxes(row, [0.04, 0.3, 0.04])),
        "wall of 1 m": changed("wall", baffle=boxes([(0.75, 1.0)], [0.15, 0.6, 1.0])),
    }


def main() -> None:
    arguments = parser.parse_args()
    ensemble = Ensemble.of(SimulatorSpec(arguments.model), arguments.members or None)
    specs = list(ensemble.members) or [SimulatorSpec(arguments.model)]
    specs += [
        SimulatorSpec(arguments.model, options=(("filling", k),))
        for k in range(1, arguments.fillings + 1)
    ]
    if len(specs) < 2:
        raise SystemExit("nothing to compare: the card names no members, so give --members")
    with Workers(arguments.workers) as workers, progress_bar() as bar:
        store = RolloutStore(arguments.cache, workers)
        cases = collect(arguments, store, specs, bar)
    print("Simulators: " + ", ".join(f"{s.name} {dict(s.options) or ''}".strip() for s in specs))
    judged = [Judgement.of(case) for case in cases]
    unseen = [j for j in judged if j.name == UNSEEN]
    limits = limits_of(unseen)
    print_cases(judged, limits)
    print_correlations(judged, limits)
    alarms = sum(j.marked(limits_of([o for o in unseen if o is not j])) for j in unseen)
    print(f"By limits from the others, {alarms} of {len(unseen)} unseen layouts would be marked")
    print(
        "Limits, mean and three standard deviations of the spread over the unseen layouts: "
        + ", ".join(f"{m} {100 * v:.2f} %" for m, v in limits.items())
    )
    if arguments.write is not None:
        write(arguments.write, [s.name for s in specs[1:]], limits)


def limits_of(unseen: Sequence[Judgement]) -> dict[str, float]:
    """Spread that is usual at most: the mean over unseen layouts and three deviations."""
    values = {m: np.array([j.spread[m] for j in unseen]) for m in MEASURES}
    return {m: float(v.mean() + 3 * v.std(ddof=1)) for m, v in values.items()}


def print_cases(judged: Sequence[Judgement], limits: dict[str, float]) -> None:
    """A row for the unseen layouts together and for each flow beyond them."""
    rows = []
    groups = [(UNSEEN, [j for j in judged if j.name == UNSEEN])]
    groups += [(j.name, [j]) for j in judged if j.name != UNSEEN]
    for name, group in groups:
        marked = sum(j.marked(limits) for j in group)
        row = [f"{name} ({len(group)})" if len(group) > 1 else name]
        for m in MEASURES:
            spread, error = (
                np.mean([getattr(j, k)[m] for j in group]) for k in ("spread", "error")
            )
            row.append(f"{100 * spread:.2f} / {100 * error:.2f}" if spread == spread else "-")
        row.append(f"{marked} of {len(group)}")
        broken = {line.split(" = ")[0].split()[-1] for j in group for line in j.broken}
        row.append(", ".join(sorted(broken)))
        rows.append(row)
    print_table(
        "Spread / error in %, of values relative to no baffles",
        ["scene", *MEASURES, "marked", "beyond the limits of"],
        rows,
    )


def print_correlations(judged: Sequence[Judgement], limits: dict[str, float]) -> None:
    """Does a layout of larger spread have the larger error?"""
    rows = []
    for name, chosen in (
        ("unseen layouts", [j for j in judged if j.name == UNSEEN]),
        ("flows beyond", [j for j in judged if j.name != UNSEEN]),
        ("all", list(judged)),
    ):
        cells = []
        for m in MEASURES:
            pairs = np.array([(j.spread[m], j.error[m]) for j in chosen])
            rank = rank_correlation(*pairs[np.isfinite(pairs).all(axis=1)].T)
            cells.append("-" if rank is None else f"{rank:+.2f}")
        rows.append([f"{name} ({len(chosen)})", *cells])
    for name, sign in (("mean error in %, marked", True), ("mean error in %, not marked", False)):
        group = [j for j in judged if j.marked(limits) is sign]
        errors = [np.nanmean([j.error[m] for j in group]) for m in MEASURES] if group else []
        rows.append([f"{name} ({len(group)})", *(f"{100 * e:.1f}" for e in errors)])
    print_table("Rank correlation of spread and error", ["over", *MEASURES], rows)
    unseen = [j for j in judged if j.name == UNSEEN]
    true = np.array([j.true_cost for j in unseen])
    one, mean = (np.array([getattr(j, k) for j in unseen]) for k in ("first_cost", "mean_cost"))
    print(
        "Rank correlation of the objective with the truth, unseen layouts: the model alone "
        f"{rank_correlation(one, true) or 0:.3f}, mean of all "
        f"{rank_correlation(mean, true) or 0:.3f}"
    )


def write(folder: Path, members: list[str], limits: dict[str, float]) -> None:
    """Put members and limits on the card of a checkpoint."""
    card = read_card(folder)
    card |= {"ensemble": members, "ensemble_limits": {k: round(v, 5) for k, v in limits.items()}}
    write_whole(folder / CARD, (json.dumps(card, indent=2) + "\n").encode())
    print(f"written to {folder / CARD}")


@dataclass
class Judgement:
    """One scene: spread of the ensemble and error of its first model, by measure [-].

    Attributes:
        spread: see `design.ensemble.relative_spread`.
        error: |value - truth| / truth, both relative to no baffles by the same simulator.
        broken: limits on the card of the model that the scene lies outside of.
        true_cost, first_cost, mean_cost: the objective by the solver, the first model, and all.
    """

    name: str
    spread: dict[str, float]
    error: dict[str, float]
    broken: list[str]
    true_cost: float
    first_cost: float
    mean_cost: float

    @classmethod
    def of(cls, case: Case) -> Judgement:
        """From the rollouts of a case."""
        objective = Objective()

        def seen(values: dict[str, float], none: dict[str, float], status: str) -> Outcome:
            return Outcome(objective.cost(values, none), values, status)

        pairs = list(zip(case.members, case.members_none, strict=True))
        outcomes = [seen(r.measures, n.measures, r.status) for r, n in pairs]
        none = [seen(n.measures, n.measures, n.status) for n in case.members_none]
        truth = seen(case.true, case.true_none, "ok")
        error = {"cost": abs(outcomes[0].cost / truth.cost - 1)}
        spread = relative_spread(outcomes, none)
        for m in MEASURES[1:]:
            if m not in spread or min(case.true[m], case.true_none[m]) < 1e-6:
                spread[m] = error[m] = math.nan  # nothing passes the section
                continue
            ours = outcomes[0].measures[m] / none[0].measures[m]
            theirs = case.true[m] / case.true_none[m]
            error[m] = abs(ours / theirs - 1)
        return cls(
            case.name,
            spread,
            error,
            case.broken,
            truth.cost,
            outcomes[0].cost,
            float(np.mean([o.cost for o in outcomes])),
        )

    def marked(self, limits: dict[str, float]) -> bool:
        """Whether one of the spreads is larger than its limit."""
        return any(self.spread[m] > limits[m] for m in MEASURES)


def collect(
    arguments: argparse.Namespace, store: RolloutStore, specs: list[SimulatorSpec], bar: Progress
) -> list[Case]:
    """Of every scene: the truth, and what each of `specs` says."""
    solver = SimulatorSpec("mpm")
    scenes, truths = [], []
    for path in sorted(arguments.data.glob("*.h5"))[: arguments.layouts]:
        truth = Trajectory.load(path)
        scenes.append(truth.scene)
        truths.append(measures.summary(truth))
    outside = beyond()
    names = [UNSEEN] * len(scenes) + list(outside)
    # Names and placements do not flow: so that equal flows are simulated once.
    plain = [s.replace(name="flow", placement=None) for s in [*scenes, *outside.values()]]
    bare = [s.with_baffles([]) for s in plain]
    flows = list({json.dumps(s.to_dict()): s for s in [*plain, *bare]}.values())
    unsolved = [s for s in flows if s not in plain[: len(truths)]]
    watch = Watch(bar)
    jobs: dict[tuple[SimulatorSpec, str], Pending] = {}
    for spec, asked in [(solver, unsolved), *((spec, flows) for spec in specs)]:
        started = [store.start(spec, s, trajectory=False) for s in asked]
        watch.add(f"{spec.name} {dict(spec.options) or ''}", started)
        jobs |= {(spec, key(s)): p for s, p in zip(asked, started, strict=True)}
    watch.wait(list(jobs.values()))
    store.prune(set())
    cases = []
    for k, (name, flow, none) in enumerate(zip(names, plain, bare, strict=True)):
        known = truths[k] if k < len(truths) else jobs[solver, key(flow)].result().measures
        cases.append(
            Case(
                name,
                plain[k],
                known,
                jobs[solver, key(none)].result().measures,
                [jobs[spec, key(flow)].result() for spec in specs],
                [jobs[spec, key(none)].result() for spec in specs],
                beyond_limits(specs[0], plain[k]),
            )
        )
    return cases


def key(scene: Scene) -> str:
    """What tells two flows apart."""
    return json.dumps(scene.to_dict())


if __name__ == "__main__":
    main()
