"""The training loop, from top to bottom: data, model, steps, validation, files."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch

from gns_model.errors import GnsError
from gns_model.learned.checkpoint import save_model
from gns_model.learned.config import Limits
from gns_model.learned.model import LearnedModel
from gns_model.scene import write_whole
from gns_model.training import batches
from gns_model.training.distributed import Ranks, release_heap, session
from gns_model.training.loss import unrolled_loss
from gns_model.training.progress import Display
from gns_model.training.recipe import Recipe
from gns_model.training.schedule import MovingAverage, learning_rate
from gns_model.training.setup import card, check_resumable, open_data
from gns_model.training.state import FILE, Position, load_state, read_position, save_state
from gns_model.training.statistics import measure
from gns_model.training.transfer import inherit
from gns_model.training.validation import Scores, Validator

#: Steps with a gradient that is not finite before a run gives up.
PATIENCE = 20
#: Steps between two looks for memory to give back to the system.
TIDY = 50


class TrainingError(GnsError, RuntimeError):
    """Training that cannot go on; what was saved is kept."""


def train(recipe: Recipe, out: str | os.PathLike[str], *, resume: bool = True) -> Path:
    """Train a learned simulator.

    Runs alone or as one of several ranks (torchrun's environment variables); every rank calls
    this with the same arguments. On SIGINT or SIGTERM the step is finished, the state is saved,
    and the function returns.

    Args:
        recipe: what to train.
        out: folder for `model/` (the best weights by rollout error), `last/` (the latest), both
            moving averages, `state.safetensors`, `log.csv`, `validation.csv`, `loss.png` and
            `recipe.json`.
        resume: go on from `state.safetensors`, if there is one. On a CPU with as many ranks and a
            budget in steps, the weights are then bit for bit those of a run that never stopped.

    Returns:
        The folder of the best model; of the latest, where no validation was finished.

    Raises:
        FileFormatError: for a data file or state that is truncated or foreign.
        RecipeError: if the state in `out` is of another model or seed, or data and model differ
            in dimension.
        TrainingError: if the loss stays not finite.
    """
    with session(recipe.device, recipe.threads) as ranks, _stop_signal() as stop:
        return _train(recipe, Path(out), resume, ranks, stop)


def _train(recipe: Recipe, out: Path, resume: bool, ranks: Ranks, stop: threading.Event) -> Path:
    # -- data ----------------------------------------------------------------------------------
    data = open_data(recipe, recipe.train)
    held_out = open_data(recipe, recipe.valid) if recipe.valid else None

    # -- model ---------------------------------------------------------------------------------
    torch.manual_seed(recipe.seed)
    limits = Limits.of(source.scene for source in data.sources)
    config = recipe.model.model_copy(update={"limits": limits})
    model = LearnedModel(config).to(ranks.device)
    average = MovingAverage(model, recipe.ema_decay)
    optimiser = torch.optim.AdamW(
        model.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay
    )
    state_file = out / FILE
    if resume and state_file.exists():
        check_resumable(recipe, read_position(state_file))
        position = load_state(state_file, model, average, optimiser)
    else:
        statistics = measure(
            data,
            windows=recipe.statistics_windows,
            radius=config.radius,
            noise_std=config.noise_std,
            subtract_gravity=config.subtract_gravity,
            seed=recipe.seed,
        )
        statistics.apply(model)
        if recipe.start_from is not None:
            inherit(model, recipe.start_from)
            average = MovingAverage(model, recipe.ema_decay)
        architecture = recipe.model.model_dump(mode="json")
        position = Position(0, 0.0, None, 0.0, 0.0, statistics, architecture, recipe.seed)
    if recipe.compile:
        model.network.compile(dynamic=True)
    judged = LearnedModel(config).to(ranks.device)  # holds the moving average
    validator = None
    if held_out is not None:
        validator = Validator(held_out, ranks, recipe.valid_rollouts, recipe.valid_windows)
        if validator.ruler != position.ruler:
            position.ruler, position.best_score = validator.ruler, None
    if ranks.rank == 0:
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "recipe.json", recipe.model_dump_json(indent=2).encode())

    def save(folder: str, scores: Scores | None) -> None:
        if ranks.rank == 0:
            judged.load_state_dict(model.state_dict())
            average.copy_to(judged)
            save_model(out / folder, judged, card(recipe, position, data, scores))

    def save_all() -> None:
        position.saved_at = position.seconds
        if ranks.rank == 0:
            save("last", None)
            save_state(state_file, position, model, average, optimiser)

    def validate() -> None:
        assert validator is not None
        judged.load_state_dict(model.state_dict())
        average.copy_to(judged)
        scores = validator(judged, stop.is_set)
        # Rank 0's time for all, or they would disagree about when the next one is due.
        now = torch.zeros(1, device=ranks.device)
        now += clock.read() if ranks.rank == 0 else 0.0
        position.seconds = position.validated_at = float(ranks.sum(now))
        if not scores.complete:
            return
        display.validation(position.step, position.seconds, scores.row())
        if position.best_score is None or scores.score < position.best_score:
            position.best_score = scores.score
            save("model", scores)

    # -- steps ---------------------------------------------------------------------------------
    budget = recipe.steps if recipe.steps is not None else 60 * (recipe.minutes or 0)
    clock = _Clock(position.seconds)
    parameters = [p for p in model.parameters() if p.requires_grad]
    sizes = [p.numel() for p in parameters]
    autocast = recipe.precision == "bfloat16"
    started_at, bad, interrupted = position.step, 0, False
    unit, scale = ("steps", 1.0) if recipe.steps is not None else ("minutes", 60.0)
    with Display(out, ranks, step=position.step, total=budget / scale, unit=unit) as display:
        if ranks.rank == 0:
            display.say(
                f"{recipe.name}: {sum(sizes)} parameters, {len(data.sources)} trajectories"
                + (f" ({len(data.skipped)} that ended badly left out)" if data.skipped else "")
                + (f", {len(held_out.sources)} held out" if held_out else "")
                + f", {ranks.world} rank(s)"
                + (f", resumed at step {position.step}" if position.step else "")
            )
        while (done := position.step if recipe.steps else position.seconds) < budget:
            began = time.perf_counter()
            progress = done / budget
            steps = 1
            if progress >= 1 - recipe.unroll_fraction and recipe.unroll > 1:
                rng = batches.generator(recipe.seed, batches.UNROLL, position.step)
                steps = int(rng.integers(1, recipe.unroll + 1))
            drawn = batches.draw(
                data,
                batches.generator(recipe.seed, batches.DRAW, position.step),
                ranks=ranks.world,
                edges_per_batch=recipe.edges_per_batch,
                statistics=position.statistics,
                mirror=recipe.mirror,
                early=recipe.early,
                early_steps=recipe.early_steps,
                unroll=steps,
            )[ranks.rank]
            batch = batches.collate(
                [batches.read(data, item, unroll=steps) for item in drawn],
                noise_std=config.noise_std,
                rng=batches.generator(recipe.seed, batches.NOISE, position.step, ranks.rank),
                device=ranks.device,
            )
            rate = learning_rate(recipe, position.step, progress)
            for group in optimiser.param_groups:
                group["lr"] = rate
            with torch.autocast(ranks.device.type, torch.bfloat16) if autocast else nullcontext():
                loss = unrolled_loss(
                    model,
                    batch,
                    steps=steps,
                    backprop=recipe.backprop_through_unroll,
                    linear_beyond=recipe.linear_beyond,
                    momentum_weight=recipe.momentum_weight,
                )
            optimiser.zero_grad(set_to_none=True)
            loss.backward()

            # One message carries the gradients and all that the ranks have to agree on.
            edges = sum(item.edges for item in drawn)
            now = clock.read() if ranks.rank == 0 else 0.0
            facts = [loss.item(), edges, now, float(stop.is_set())]
            message = torch.cat(
                [(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters]
                + [torch.tensor(facts, dtype=torch.float32, device=ranks.device)]
            )
            ranks.sum(message)
            gradient = message[: -len(facts)] / ranks.world
            loss_sum, edges, seconds, stopped = message[-len(facts) :].tolist()
            norm = gradient.norm().item()
            finite = norm < float("inf")  # False for NaN, too
            if finite:
                gradient *= min(1.0, recipe.clip_norm / (norm + 1e-12))
                for p, part in zip(parameters, gradient.split(sizes), strict=True):
                    p.grad = part.view_as(p)
                optimiser.step()
                average.update(model, position.step)
            bad = 0 if finite else bad + 1
            position.step += 1
            position.seconds = seconds
            display.step(
                position.step,
                seconds,
                (position.step if recipe.steps else seconds) / scale,
                {
                    "loss": loss_sum / ranks.world,
                    "learning_rate": rate,
                    "gradient_norm": norm,
                    "edges_per_second": edges / (time.perf_counter() - began),
                },
            )
            if bad >= PATIENCE:
                raise TrainingError(
                    f"the loss was not finite {bad} steps in a row, until step {position.step}; "
                    f"lower learning_rate ({recipe.learning_rate:g})"
                )
            if stopped:
                interrupted = True
                break
            if position.step % TIDY == 0:
                release_heap()
            if validator and seconds - position.validated_at >= 60 * recipe.validate_minutes:
                validate()
            if seconds - position.saved_at >= 60 * recipe.checkpoint_minutes:
                save_all()

        # -- the end ---------------------------------------------------------------------------
        if (
            validator
            and not interrupted
            and (position.step > started_at or position.best_score is None)
        ):
            validate()
        save_all()
        display.say(
            f"{'stopped' if stop.is_set() else 'finished'} at step {position.step} after "
            f"{position.seconds / 60:.1f} minutes"
            + ("; the same command goes on from here" if stop.is_set() else "")
        )
    return out / ("model" if position.best_score is not None else "last")


class _Clock:
    """Seconds of training, those of earlier runs included."""

    def __init__(self, before: float) -> None:
        self._start = time.monotonic() - before

    def read(self) -> float:
        return time.monotonic() - self._start


@contextmanager
def _stop_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, while this runs in the main thread."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
