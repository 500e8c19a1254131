"""Does the spread of an ensemble tell where a learned simulator is wrong?

    python benchmarks/ensemble.py --members runs/lite2/model --data data/test

Scenes: unseen layouts whose reference trajectories are in --data, and flows out of the model's
depth (`beyond`), which the reference solver simulates here (35 CPU seconds each). Everything is
rolled out once and found again in --cache.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

from rich.progress import Progress

from design.evaluators import SimulatorSpec
from design.store import Rolled, RolloutStore, Watch
from design.workers import Workers
from gns_model import measures
from gns_model.console import progress_bar
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--model", default="baffle-lite")
parser.add_argument("--members", nargs="*", default=[], help="further models, beside their own")
parser.add_argument("--fillings", type=int, default=0, help="further fillings of the model")
parser.add_argument("--data", type=Path, required=True, help="folder of unseen layouts")
parser.add_argument("--layouts", type=int, default=32, help="how many of them")
parser.add_argument("--cache", type=Path, default=Path("runs/ensemble"))
parser.add_argument("--workers", type=int, default=1)


@dataclass
class Case:
    """A scene by the reference solver and by each simulator, with and without its baffles."""

    name: str
    scene: Scene
    true: dict[str, float]
    true_none: dict[str, float]
    members: list[Rolled]
    members_none: list[Rolled]


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
        "release 0.45 m high": changed(
            "tall", release=[{**values["release"][0], "upper": [0.45, 0.55, 1.7]}]
        ),
    }


def main() -> None:
    arguments = parser.parse_args()
    model = SimulatorSpec(arguments.model)
    specs = [model, *map(SimulatorSpec, arguments.members)]
    specs += [
        SimulatorSpec(arguments.model, options=(("filling", k),))
        for k in range(1, arguments.fillings + 1)
    ]
    with Workers(arguments.workers) as workers, progress_bar() as bar:
        store = RolloutStore(arguments.cache, workers)
        scenes = collect(arguments, store, specs, bar)
    print(len(scenes))


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
    names = ["unseen"] * len(scenes) + list(outside)
    # Names and placements do not flow: so that equal flows are simulated once.
    plain = [s.replace(name="flow", placement=None) for s in [*scenes, *outside.values()]]
    bare = [s.with_baffles([]) for s in plain]
    flows = list({json.dumps(s.to_dict()): s for s in [*plain, *bare]}.values())
    unsolved = [s for s in flows if s not in plain[: len(truths)]]
    watch, jobs = Watch(bar), {}
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
            )
        )
    return cases


def key(scene: Scene) -> str:
    """What tells two flows apart."""
    return json.dumps(scene.to_dict())


if __name__ == "__main__":
    main()
