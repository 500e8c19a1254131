"""One lesson of `--refine`: the verified trajectories as training data, and the training on them.

The model is trained through whole flows (`gns_model.training.flows`): what a site has in common,
such as a friction that the model never saw, is a bias of all of its flows, and a few steps through
flows from their release to rest mend that, where hundreds of steps on windows do not. Nothing in
the verified layouts keeps it from forgetting other flows but the low rate, unless it is given the
data that it came from.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design.evaluators import SimulatorSpec
from design.store import RolloutStore, Watch
from design.verify import Judged
from gns_model.errors import FileFormatError
from gns_model.files import link_or_copy
from gns_model.learned.checkpoint import CARD, load_model, read_card, save_model
from gns_model.learned.config import Limits
from gns_model.scene import Scene
from gns_model.training import TrainingError, launch
from gns_model.training.recipe import Recipe
from gns_model.training.state import FILE, read_position
from gns_model.trajectory import open_trajectory

if TYPE_CHECKING:
    from design.run import Run

LEARNING_RATE = 5e-5

#: Edges of the flows of a step on one rank, summed over time: about one flume, 30 CPU seconds.
FLOW_EDGES = 3_000_000

#: Optimiser steps below which a refinement is not to be trusted: the first steps of an optimiser
#: that has no moments yet go astray. Seven on four layouts of the flume took the centroid's gap on
#: three others from 3.6 to 1.2 %.
FEW = 5

#: What one process of the training takes with a batch of one flume, heap included [bytes].
RANK_MEMORY = 4e9


@dataclass(frozen=True)
class Lesson:
    """A refinement to do, or done already.

    Attributes:
        folder: of the round; the refined model's checkpoint.
        start: the model to begin with.
        judged: the verified layouts to learn from; of a lesson that is done, those known now.
        layouts: what it learns (has learnt) from [m], each (n, D-1).
    """

    folder: Path
    start: SimulatorSpec
    judged: tuple[Judged, ...]
    layouts: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, run: Run, folder: Path, start: SimulatorSpec, judged: Sequence[Judged]) -> Lesson:
        """The lesson of `folder`. One that is done stays as it is, also if more is known now."""
        if (folder / CARD).exists():
            empty = np.zeros((0, run.problem.scene.dim - 1))
            about = read_card(folder)["refined"]
            layouts = [np.array(x, dtype=float) if x else empty for x in about["layouts"]]
            return cls(folder, start, tuple(judged), tuple(layouts))
        return cls(folder, start, tuple(judged), tuple(j.centres for j in judged))

    @property
    def done(self) -> bool:
        """Whether the refined model is there."""
        return (self.folder / CARD).exists()

    @property
    def training(self) -> Path:
        """Where the training keeps its state and logs."""
        return self.folder / "training"

    @property
    def model(self) -> SimulatorSpec:
        """The refined model."""
        # Absolute: the same model, whichever way the run folder is named next time.
        return SimulatorSpec(str(self.folder.resolve()), self.start.device)

    def spent(self) -> dict[str, Any]:
        """Steps and minutes of training, as the card has them."""
        trained = read_card(self.folder)["trained_on"]
        return {"steps": trained["steps"], "minutes": trained["minutes"]}


def teach(run: Run, lesson: Lesson, store: RolloutStore, watch: Watch) -> SimulatorSpec:
    """Train the model of `lesson`, or go on with a training that was interrupted.

    Raises:
        KeyboardInterrupt: if it is told to stop; what was trained is kept.
        TrainingError, FileFormatError, RecipeError: if training fails.
    """
    if lesson.done:
        return lesson.model
    scenes = _lay_out(run, lesson, store, watch)
    s = run.settings
    recipe = recipe_of(lesson, scenes, minutes=s.refine_minutes, data=s.refine_data)
    _train(recipe, lesson, run.workers, watch)
    _keep(lesson, scenes)
    shutil.rmtree(lesson.folder / "lessons", ignore_errors=True)
    return lesson.model


def recipe_of(
    lesson: Lesson, scenes: Sequence[Scene], *, minutes: float, data: Path | None
) -> Recipe:
    """How `lesson` is trained.

    Raises:
        FileFormatError: if there are no trajectories in `data`.
    """
    config = lesson.start.load().config  # type: ignore[attr-defined]
    steps = max(round(s.duration / config.dt) for s in scenes)
    lessons = str(lesson.folder / "lessons")
    train = [lessons]
    if data is not None:
        old = len(training_files(data))
        # Trajectories are drawn uniformly: half of the flows shall be new ones.
        train = [lessons] * max(1, round(old / len(scenes))) + [str(data)]
    return Recipe(
        name=f"{Path(lesson.start.name).name}, refined",
        start_from=lesson.start.name,
        model=config,
        train=tuple(train),
        minutes=minutes,
        learning_rate=LEARNING_RATE,
        warmup=0.1,
        ema_decay=0.8,
        unroll_fraction=1.0,
        flow_share=1.0,
        flow_steps=max(1, steps),
        flow_edges=FLOW_EDGES,
        statistics_windows=32,  # the model keeps those it was trained with
        device="cpu" if lesson.start.device == "cpu" else "cuda",
        precision="auto",
        checkpoint_minutes=1.0,
    )


def training_files(folder: Path) -> list[Path]:
    """The trajectory files in `folder`, sorted.

    Raises:
        FileFormatError: if there are none.
    """
    paths = sorted(p for p in folder.glob("*.h5") if not p.name.startswith("."))
    if not paths:
        raise FileFormatError(f"{folder}: no trajectory files (*.h5) in this folder")
    return paths


def _lay_out(run: Run, lesson: Lesson, store: RolloutStore, watch: Watch) -> list[Scene]:
    """Link the reference trajectories of the verified layouts into RUN/refined-k/lessons."""
    verifier = run.settings.verifier
    pending = [p for j in lesson.judged for p in store.roll(verifier, run.problem.laid_out(j))]
    watch.add(f"{lesson.folder.name}: trajectories", pending)
    watch.wait(pending)
    folder = lesson.folder / "lessons"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    scenes = []
    for k, rolled in enumerate(p.result() for p in pending):
        if rolled.status != "ok":
            continue
        link = folder / f"verified-{k:03d}.h5"
        link_or_copy(rolled.path, link)
        with open_trajectory(link) as file:
            scenes.append(Scene.from_dict(json.loads(file.attrs["scene"]), source=str(link)))
    return scenes


def _train(recipe: Recipe, lesson: Lesson, ranks: int, watch: Watch) -> None:
    """Run the training in processes of its own; returns when its time is used up."""
    lesson.training.mkdir(parents=True, exist_ok=True)
    file, log = lesson.training / "recipe.toml", lesson.training / "log.txt"
    recipe.to_toml(file)
    budget = 60 * (recipe.minutes or 0)
    state = lesson.training / FILE
    before = read_position(state).seconds if state.exists() else 0.0
    began = time.monotonic()
    task = watch.bar.add_task(f"{lesson.folder.name}: training", total=budget)

    def show() -> None:
        watch.bar.update(task, completed=min(budget, before + time.monotonic() - began))

    code = launch(file, lesson.training, _affordable(ranks), log=log, watch=show)
    if code != 0:
        lines = log.read_text(errors="replace").strip().splitlines() or [f"exit code {code}"]
        raise TrainingError(f"{lesson.training}: {lines[-1].removeprefix('error: ')}")
    if not state.exists() or read_position(state).seconds < budget:
        raise KeyboardInterrupt  # it was told to stop, and has saved its state
    watch.bar.update(task, completed=budget)


def _affordable(ranks: int) -> int:
    """At most `ranks` processes, and no more than find their memory free."""
    with contextlib.suppress(OSError):  # Linux says what it could give, its caches included
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return max(1, min(ranks, int(1024 * int(line.split()[1]) / RANK_MEMORY)))
    return 1


def _keep(lesson: Lesson, scenes: Sequence[Scene]) -> None:
    """Write the refined model and its card into the folder of the round."""
    trained = load_model(lesson.training / "last")
    parent = lesson.start.load()
    limits: Limits = parent.config.limits.widened(scenes)  # type: ignore[attr-defined]
    trained.model.config = trained.model.config.model_copy(update={"limits": limits})
    about = {
        "from": lesson.start.describe(),
        "layouts": [np.round(c, 6).tolist() for c in lesson.layouts],
        "scene": scenes[0].name,
    }
    card = {
        "name": lesson.folder.name,
        "refined": about,
        "trained_on": trained.card["trained_on"],
    }
    save_model(lesson.folder, trained.model, card)
