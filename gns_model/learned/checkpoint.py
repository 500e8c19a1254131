"""Checkpoints of learned simulators: a folder with `model.safetensors` and a card, `card.json`.

The card (JSON, format `gns-model`, version 1) holds `name`, `config` (ModelConfig), `parameters`,
`normalisation` (for reading; the model's own copy is in the weights), `weights_sha256`, and what
the trainer adds: `trained_on`, `scores`, notes, and `verdict`, a line that whoever loads the model
shall read (a model that misses its aims). `ensemble` names further models (shipped, or folders
relative to this one) that a design search asks beside it, and `ensemble_limits` how far they may
differ by measure (`design/ensemble.py`, written by `benchmarks/ensemble.py`). Each file is written
whole; the checksum tells a card from the weights of another save. The weights carry a copy of their
card and a checksum of their tensors, which count where a process was killed between the two files.
Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from gns_model.errors import FileFormatError, SimulatorError
from gns_model.files import write_whole
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator

FORMAT = "gns-model"
VERSION = 1
WEIGHTS, CARD = "model.safetensors", "card.json"

#: Folder of the models that come with the package.
PRETRAINED = Path(__file__).parent.parent / "pretrained"

_OWN_KEYS = ("format", "version", "config", "parameters", "normalisation", "weights_sha256")


def save_model(
    path: str | os.PathLike[str], model: LearnedModel, card: dict[str, Any] | None = None
) -> Path:
    """Write `model` and its card into the folder `path`, which is made if need be.

    Args:
        card: JSON values to add: `name` (default: that of the folder), `trained_on`, `scores`, ...
    """
    path = Path(path)
    state = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
    added = {k: v for k, v in (card or {}).items() if k not in _OWN_KEYS}
    buffers = {k: v.tolist() for k, v in model.named_buffers()}
    content = {
        "format": FORMAT,
        "version": VERSION,
        "name": path.name,
        **added,
        "config": model.config.model_dump(mode="json"),
        "parameters": sum(p.numel() for p in model.parameters()),
        "normalisation": {k: v for k, v in buffers.items() if k in state},
    }
    metadata = {"format": FORMAT, "version": str(VERSION)}
    metadata |= {"card": json.dumps(content, allow_nan=False), "tensors_sha256": _checksum(state)}
    weights = save(state, metadata=metadata)
    content["weights_sha256"] = hashlib.sha256(weights).hexdigest()
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"  # before anything is written
    if path.exists():
        write_whole(path / WEIGHTS, weights)
        write_whole(path / CARD, text.encode())
        return path
    # A folder that nobody ever meets without one of its files.
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        fresh.chmod(0o755)
        write_whole(fresh / WEIGHTS, weights)
        write_whole(fresh / CARD, text.encode())
        fresh.rename(path)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    return path


def read_card(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The card of the checkpoint folder `path`.

    Raises:
        FileFormatError: if it is missing, truncated, foreign or of a newer version.
    """
    file = Path(path) / CARD
    try:
        card = json.loads(file.read_bytes())
    except OSError as error:
        raise FileFormatError(
            f"{file}: cannot be read ({error.strerror}); a checkpoint is a folder with "
            f"{CARD} and {WEIGHTS}"
        ) from None
    except ValueError:
        raise FileFormatError(f"{file}: truncated, or not JSON") from None
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise FileFormatError(f"{file}: not the card of a {FORMAT} checkpoint")
    if not isinstance(card.get("version"), int) or card["version"] > VERSION:
        raise FileFormatError(
            f"{file}: version {card.get('version')!r}, this program reads up to {VERSION}"
        )
    return card


def load_model(
    path: str | os.PathLike[str], device: str = "cpu", **options: Any
) -> LearnedSimulator:
    """The simulator in the checkpoint folder `path`.

    Args:
        device: torch device to run on.
        options: of `LearnedSimulator`, such as `workers` and `threads`.

    Raises:
        FileFormatError: if a file is missing, truncated, foreign, of a newer version, or if card
            and weights are not of one save.
        SimulatorError: if there is no such device.
    """
    path = Path(path)
    card = read_card(path)
    try:
        weights = (path / WEIGHTS).read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path / WEIGHTS}: cannot be read ({error.strerror})") from None
    if hashlib.sha256(weights).hexdigest() != card.get("weights_sha256"):
        card = _card_within(path / WEIGHTS, weights)
    try:
        config = ModelConfig.model_validate(card.get("config"))
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in ("config", *fault["loc"]))
        raise FileFormatError(f"{path / CARD}: {key}: {fault['msg']}") from None
    model = LearnedModel(config)
    try:
        model.load_state_dict(load(weights))
    except (SafetensorError, RuntimeError):
        raise FileFormatError(
            f"{path / WEIGHTS}: its tensors do not fit the config in {CARD}"
        ) from None
    try:
        model.to(torch.device(device))
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise SimulatorError(f"device {device!r} cannot be used: {reason}") from None
    name = str(card.get("name", path.name))
    if card.get("verdict"):
        warnings.warn(f"{name}: {card['verdict']}", stacklevel=2)
    return LearnedSimulator(model, name=name, card=card, **options)


def _card_within(path: Path, weights: bytes) -> dict[str, Any]:
    """The card that weights carry, for weights that the card beside them was not written for.

    Raises:
        FileFormatError: if they are truncated or carry none.
    """
    try:
        state = load(weights)
        size = int.from_bytes(weights[:8], "little")
        metadata = json.loads(weights[8 : 8 + size])["__metadata__"]
        card = json.loads(metadata["card"]) if metadata["tensors_sha256"] == _checksum(state) else 0
    except (SafetensorError, KeyError, TypeError, ValueError):
        card = 0
    if not isinstance(card, dict):
        raise FileFormatError(
            f"{path}: truncated, or not the weights that {CARD} was written for"
        ) from None
    return card


def _checksum(state: dict[str, Tensor]) -> str:
    """SHA-256 of names and bytes of all tensors."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode() + state[name].numpy().tobytes())
    return digest.hexdigest()


def shipped_models() -> dict[str, Path]:
    """Names and checkpoint folders of the models that come with the package."""
    return {file.parent.name: file.parent for file in sorted(PRETRAINED.glob(f"*/{CARD}"))}
