"""One lesson of `--refine`: the verified trajectories as training data, and the training on them.

The recipe is that of the last leg of the shipped models, cut short: the model is unrolled over up
to ten steps and asked back from where it drifts to, at a low rate. Nothing in the verified layouts
keeps it from forgetting other flows but that rate, unless it is given the data that it came from.
"""

from __future__ import annotations

import json
import os
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
from gns_model.learned.checkpoint import CARD, load_model, read_card, save_model
from gns_model.learned.config import Limits
from gns_model.scene import Scene, write_whole
from gns_model.training import TrainingError, launch
from gns_model.training.recipe import Recipe
from gns_model.training.state import FILE, read_position

if TYPE_CHECKING:
    from design.run import Run

#: Steps of the model that a training rollout is unrolled over at most.
UNROLL = 10


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
            dim = run.scene.dim - 1
            about = read_card(folder)["refined"]
            layouts = [np.array(x, dtype=float).reshape(-1, dim) for x in about["layouts"]]
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
    recipe = recipe_of(run, lesson, scenes)
    lesson.training.mkdir(parents=True, exist_ok=True)
    file = lesson.training / "recipe.toml.json"
    write_whole(file, recipe.model_dump_json(indent=2).encode())
    _train(file, recipe, lesson, run.workers, watch)
    _keep(lesson, scenes)
    shutil.rmtree(lesson.folder / "lessons", ignore_errors=True)
    return lesson.model
