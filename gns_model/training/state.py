"""The whole state of a training run in one file, so that a resumed run goes on as if never stopped.

`state.safetensors` holds weights, their moving average and the optimiser's moments; its metadata
holds, as JSON, the step, the time spent, the best score so far and the statistics of the data. The
random generators need no state of their own: they follow from the seed and the step (`batches`).
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from gns_model.errors import FileFormatError
from gns_model.files import write_whole
from gns_model.learned.model import LearnedModel
from gns_model.training.schedule import MovingAverage
from gns_model.training.statistics import Statistics

FORMAT, VERSION = "gns-training-state", 1
FILE = "state.safetensors"


@dataclass
class Position:
    """Where a run stands.

    Attributes:
        step: optimiser steps done.
        seconds: spent on them, validations included.
        best_score: lowest rollout score so far; None before the first validation.
        validated_at, saved_at: `seconds` at the last validation and at the last save.
        statistics: of the data; measured once.
        architecture: the model of the recipe, as JSON values.
        seed: of the run.
        ruler: what `best_score` was measured by; scores by another ruler do not compare.
    """

    step: int
    seconds: float
    best_score: float | None
    validated_at: float
    saved_at: float
    statistics: Statistics
    architecture: dict[str, Any]
    seed: int
    ruler: str = ""

    def to_json(self) -> str:
        """As `from_json` reads it."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> Position:
        """Read what `to_json` wrote; KeyError, TypeError or ValueError if it did not."""
        values = json.loads(text)
        measured: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in values["statistics"].items()
        }
        return cls(**{**values, "statistics": Statistics(**measured)})


def save_state(
    path: Path,
    position: Position,
    model: LearnedModel,
    average: MovingAverage,
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write the state whole: under a temporary name, then renamed."""
    tensors = {f"model.{k}": v for k, v in model.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in average.weights.items()}
    for number, values in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{k}": v for k, v in values.items()}
    tensors = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "position": position.to_json(),
    }
    write_whole(path, save(tensors, metadata=metadata))


def read_position(path: Path) -> Position:
    """Where the run in `path` stands.

    Raises:
        FileFormatError: if the file is truncated, foreign or of a newer version.
    """
    return parse_state(_content(path), path)[0]


def parse_state(content: bytes, path: Path) -> tuple[Position, dict[str, Tensor]]:
    """Position and tensors of a state file; `path` is for messages.

    Raises:
        FileFormatError: if the content is truncated, foreign or of a newer version.
    """
    try:
        tensors = load(content)
        size = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + size]).get("__metadata__", {})
        if metadata.get("format") != FORMAT:
            raise FileFormatError(f"{path}: not a {FORMAT} file")
        if int(metadata["version"]) > VERSION:
            raise FileFormatError(
                f"{path}: version {metadata['version']}, this program reads up to {VERSION}"
            )
        return Position.from_json(metadata["position"]), tensors
    except FileFormatError:
        raise
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: truncated, or not a {FORMAT} file ({error})") from None


def restore(
    tensors: dict[str, Tensor],
    model: LearnedModel,
    average: MovingAverage,
    optimiser: torch.optim.Optimizer,
    path: Path,
) -> None:
    """Put the tensors of a state where they belong; `path` is for messages.

    Raises:
        FileFormatError: if they are of another architecture.
    """
    parts: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "optimiser": {}}
    for key, value in tensors.items():
        part, name = key.split(".", 1)
        parts.setdefault(part, {})[name] = value
    try:
        model.load_state_dict(parts["model"])
        for name, weights in average.weights.items():
            weights.copy_(parts["average"][name])
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in parts["optimiser"].items():
            number, name = key.split(".", 1)
            moments.setdefault(int(number), {})[name] = value
        groups = optimiser.state_dict()["param_groups"]
        optimiser.load_state_dict({"state": moments, "param_groups": groups})
    except (KeyError, RuntimeError, ValueError):
        raise FileFormatError(f"{path}: the state of a model of another architecture") from None


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from None
