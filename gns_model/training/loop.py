"""The training loop, from top to bottom: data, model, steps, validation, files."""

from __future__ import annotations

import os
import time
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import torch
from torch import Tensor

from gns_model.data.windows import WindowIndex
from gns_model.files import write_whole
from gns_model.learned.checkpoint import save_model
from gns_model.learned.model import LearnedModel
from gns_model.learned.precision import is_short
from gns_model.training import batches
from gns_model.training.claim import TrainingError, claim, tidy
from gns_model.training.distributed import RankError, Ranks, session
from gns_model.training.feeding import Feeder
from gns_model.training.flows import draw_flows, flow_gradient
from gns_model.training.heap import release_heap
from gns_model.training.kinematic import kinematic_spacing
from gns_model.training.launching import end_with_launcher
from gns_model.training.loss import Emphasis, step_error, unrolled_loss
from gns_model.training.progress import Display
from gns_model.training.recipe import Recipe
from gns_model.training.replay import Replay
from gns_model.training.schedule import learning_rate
from gns_model.training.setup import Run, begin, card, open_data
from gns_model.training.state import FILE, save_state
from gns_model.training.stopping import Abandoned, Stop, stop_on_signals
from gns_model.training.validation import Scores, Validator

#: Steps with a gradient that is not finite before a run gives up.
PATIENCE = 20
#: Steps between two looks for memory to give back to the system: in 50 of the flume a rank grew to
#: 8 GB, of which it used 2.
TIDY = 20


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
        TrainingError: if the loss stays not finite, or another run trains in `out`.
        RankError: if there is no such device, or another rank has died; what was saved is kept.
        KeyboardInterrupt: if it is told to stop before the first step.
    """
    folder = Path(out)
    with stop_on_signals() as stop, session(recipe.device, recipe.threads) as ranks:
        end_with_launcher()
        with claim(folder, stop) if ranks.rank == 0 else nullcontext():
            return _train(recipe, folder, resume, ranks, stop)


def _train(recipe: Recipe, out: Path, resume: bool, ranks: Ranks, stop: Stop) -> Path:
    # -- data and model ------------------------------------------------------------------------
    state_file = out / FILE
    try:
        with stop.may_abandon():
            data = open_data(recipe, recipe.train, learn=True)
            held_out = open_data(recipe, recipe.valid) if recipe.valid else None
            run = begin(recipe, data, state_file, ranks, resume)
    except (Abandoned, RankError):
        if stop.requested:
            raise KeyboardInterrupt from None  # nothing to save yet
        raise
    model, average, optimiser, position = run.model, run.average, run.optimiser, run.position
    config = model.config
    short = is_short(recipe.precision, ranks.device)
    if recipe.compile:
        model.network.compile(dynamic=True)
    judged = LearnedModel(config).to(ranks.device)  # holds the moving average
    validator = None
    if held_out is not None:
        validator = Validator(held_out, ranks, recipe.valid_rollouts, recipe.valid_windows)
        if validator.ruler != position.ruler:
            position.ruler, position.best_score = validator.ruler, None
    if ranks.rank == 0:
        tidy(out)
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
        if recipe.replay:
            replay.save(out, position.step)

    def validate() -> bool:
        """Whether it was finished."""
        assert validator is not None
        judged.load_state_dict(model.state_dict())
        average.copy_to(judged)
        release_heap()  # rollouts need little of what the steps held
        with stop.may_abandon():
            scores = validator(judged, lambda: stop.requested, display.validating)
        # Rank 0's time for all, or they would disagree about when the next one is due.
        now = torch.zeros(1, device=ranks.device)
        now += clock.read() if ranks.rank == 0 else 0.0
        position.seconds = position.validated_at = float(ranks.sum(now))
        if scores.complete:
            display.validation(position.step, position.seconds, scores.row())
            if position.best_score is None or scores.score < position.best_score:
                position.best_score = scores.score
                save("model", scores)
                save_all()  # or a run that is killed now would forget which score to beat
        return scores.complete

    # -- steps ---------------------------------------------------------------------------------
    budget = recipe.steps if recipe.steps is not None else 60 * (recipe.minutes or 0)
    clock = _Clock(position.seconds)
    parameters = [p for p in model.parameters() if p.requires_grad]
    sizes = [p.numel() for p in parameters]
    started_at, bad = position.step, 0
    unit, scale = ("steps", 1.0) if recipe.steps is not None else ("minutes", 60.0)
    spent = (position.step if recipe.steps is not None else position.seconds) / scale
    with Display(
        out, ranks, step=position.step, done=spent, total=budget / scale, unit=unit
    ) as display:
        if ranks.rank == 0:
            display.say(
                f"{recipe.name}: {sum(sizes)} parameters, {len(data.sources)} trajectories"
                + "".join(
                    f" ({count} that {why} left out)"
                    for why, count in Counter(data.skipped.values()).items()
                )
                + (f", {len(held_out.sources)} held out" if held_out else "")
                + f", {ranks.world} rank(s), {'bfloat16' if short else 'float32'}"
                + (f", resumed at step {position.step}" if position.step else "")
            )
        on_gpu = ranks.device.type == "cuda"
        feeder = Feeder(data, recipe, position.statistics, ranks, ahead=on_gpu)
        replay = Replay(data, recipe, position.statistics, ranks)
        if recipe.replay and position.step:
            replay.restore(out, position.step)
        try:
            while (done := position.step if recipe.steps else position.seconds) < budget:
                began = time.perf_counter()
                progress = done / budget
                with stop.may_abandon():
                    loss, edges = _forward_and_backward(
                        run, recipe, data, feeder, replay, ranks, progress, short
                    )
                rate = learning_rate(recipe, position.step, progress)

                # One message carries the gradients and all that the ranks have to agree on.
                now = clock.read() if ranks.rank == 0 else 0.0
                facts = torch.tensor([edges, now, float(stop.requested)], device=ranks.device)
                gradients = [
                    (torch.zeros_like(p) if p.grad is None else p.grad).flatten()
                    for p in parameters
                ]
                message = ranks.sum(torch.cat([*gradients, loss.detach()[None].float(), facts]))
                gradient = message[:-4] / ranks.world
                # The one place in a step where the host waits for a GPU.
                norm, loss_sum, edges, seconds, stopped = torch.cat(
                    [gradient.norm()[None], message[-4:]]
                ).tolist()
                finite = norm < float("inf")  # False for NaN, too
                if finite:
                    gradient *= min(1.0, recipe.clip_norm / (norm + 1e-12))
                    for p, part in zip(parameters, gradient.split(sizes), strict=True):
                        p.grad = part.view_as(p)
                    for group in optimiser.param_groups:
                        group["lr"] = rate
                    optimiser.step()
                    average.update(model, position.step)
                replay.keep()
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
                        "unrolled": recipe.unrolled(progress),
                    },
                )
                if bad >= PATIENCE:
                    raise TrainingError(
                        f"the loss was not finite {bad} steps in a row, until step "
                        f"{position.step}; lower learning_rate ({recipe.learning_rate:g})"
                    )
                if stopped:
                    raise Abandoned  # by all ranks, after the same step
                if position.step % TIDY == 0:
                    release_heap()
                due = seconds - position.validated_at >= 60 * recipe.validate_minutes
                if validator and due and not validate():
                    raise Abandoned
                if seconds - position.saved_at >= 60 * recipe.checkpoint_minutes:
                    save_all()
            if validator and (position.step > started_at or position.best_score is None):
                validate()
        except Abandoned:
            pass
        except RankError:
            # The step in progress is lost and all before it are not. A rank that was told to
            # stop may leave in the middle of a step; any other ends the run.
            if not stop.requested:
                save_all()
                raise
        finally:
            feeder.close()
        save_all()
        display.say(
            f"{'stopped' if stop.requested else 'finished'} at step {position.step} after "
            f"{position.seconds / 60:.1f} minutes"
            + ("; the same command goes on from here" if stop.requested else "")
        )
    return out / ("model" if position.best_score is not None else "last")


def _forward_and_backward(
    run: Run,
    recipe: Recipe,
    data: WindowIndex,
    feeder: Feeder,
    replay: Replay,
    ranks: Ranks,
    progress: float,
    short: bool,
) -> tuple[Tensor, float]:
    """Loss of this rank's share of the next step, with its gradients in the parameters.

    Args:
        progress: share of the budget that is spent.
        short: multiply in bfloat16.

    Returns:
        the loss, a scalar, and the number of edges.
    """
    step, model = run.position.step, run.model
    context = torch.autocast(ranks.device.type, torch.bfloat16) if short else nullcontext()
    unrolled = recipe.unrolled(progress)
    kinematic = kinematic_spacing(recipe.model)
    rng = batches.generator(recipe.seed, batches.REPLAY, step)  # the same on all ranks
    run.optimiser.zero_grad(set_to_none=True)
    if recipe.flow_share and unrolled and rng.random() < recipe.flow_share:
        flows = draw_flows(
            data,
            batches.generator(recipe.seed, batches.FLOWS, step),
            recipe,
            run.position.statistics,
            ranks=ranks.world,
        )[ranks.rank]
        loss = flow_gradient(
            model,
            [
                batches.read(data, flow.draw, unroll=flow.steps, kinematic=kinematic)
                for flow in flows
            ],
            [p for p in model.parameters() if p.requires_grad],
            clip_norm=recipe.clip_norm,
            context=context,
            device=ranks.device,
        )
        return loss, sum(flow.edges for flow in flows)
    if recipe.replay and unrolled and rng.random() < recipe.replay_share:
        loss, edges = _replayed(run, recipe, replay, context)
    else:
        windows, edges = feeder.take(step, progress)
        batch = batches.collate(
            windows,
            noise_std=model.config.noise_std,
            rng=batches.generator(recipe.seed, batches.NOISE, step, ranks.rank),
            device=ranks.device,
            spacing=model.config.spacing,
            acceleration_noise=recipe.acceleration_noise,
        )
        with context:
            loss = unrolled_loss(
                model,
                batch,
                Emphasis.of(recipe),
                steps=feeder.unroll(step, progress),
                backprop=recipe.backprop_through_unroll,
                return_steps=recipe.return_steps,
            )
    loss.backward()
    return loss, edges


def _replayed(
    run: Run, recipe: Recipe, replay: Replay, context: AbstractContextManager[None]
) -> tuple[Tensor, float]:
    """Loss of states that the model made, whose flows go on, and the number of edges."""
    step, model = run.position.step, run.model
    batch, edges = replay.take(step)
    recalled = replay.recall(step)
    if recalled is not None:
        with torch.no_grad(), context:
            replay.advanced(model.step(batch.history, batch.world))
        batch, edges = recalled
    with context:
        after = model.step(batch.history, batch.world)
        loss = step_error(
            model,
            batch.history,
            after,
            batch.moves[:, 0],
            Emphasis.of(recipe, replayed=True),
            batch=batch.world.batch,
            moving=batch.moving,
            back=batch.back,
        )
    if recalled is None:
        replay.advanced(after)
    return loss, edges


class _Clock:
    """Seconds of training, those of earlier runs included."""

    def __init__(self, before: float) -> None:
        self._start = time.monotonic() - before

    def read(self) -> float:
        return time.monotonic() - self._start
