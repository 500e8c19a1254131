"""Flows that the model itself keeps rolling while it is trained.

A model that sees true states only is one-step perfect and goes astray by itself: a heap sinks by a
hair each step and is a puddle after fifty, a front lags. Unrolling K steps for every gradient shows
K steps of that and costs K times as much. Here a pool of flows goes on instead: every optimiser
step advances some of them by one step of the model, with the gradient of that very step, so that
states of any age cost no more than true ones (dataset aggregation, Ross et al. 2011, for rollouts).

What is asked of a state that has drifted is the true acceleration and the way back, critically
damped: with e(t) = x - x_true of a point and tau = `return_steps` dt,

    a = a_true - 2 e'/tau - e/tau².

Asking for the true place in the next step instead would ask for accelerations of e/dt², which are
tens of g for the wanderings of single grains that nobody can foretell.

With `replay_exchange` x_true is not the place of the same grain but of one that stands for it
(`exchange`), so that grains of one kind may trade places.

The way back closes a control loop, and the pool is its delay: what the weights of now do wrong
shows at the end of a flow, after `replay_steps` turns of that flow. So keep few flows, about as
many as a batch holds.

That delay makes the loop swing: heaps stand, then slump, then stand. A memory damps it, by which
the aggregation is one of all the models so far and no longer of the last alone: a turn rolls the
flows on without a gradient, every state of theirs is kept in place of a random older one, and the
gradient is of states drawn from all that are kept. Its horizon, the turns in which the memory
is replaced, should be several times as long as a flow.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load, save
from torch import Tensor

from gns_model.data.windows import Window, WindowIndex
from gns_model.files import write_whole
from gns_model.training import batches
from gns_model.training.batches import Batch, Draw
from gns_model.training.distributed import Ranks
from gns_model.training.exchange import least_way_back
from gns_model.training.kinematic import kinematic_spacing
from gns_model.training.recipe import Recipe
from gns_model.training.statistics import Statistics

#: A flow whose points have strayed this far on average is let go [spacings].
ASTRAY = 6.0
#: Steps of a flow after which its grains are paired anew; a pairing of a thousand takes some tenths
#: of a second.
EXCHANGE = 8


@dataclass
class Rolling:
    """One flow under way.

    Attributes:
        draw: its source, mixture of tracers and present frame.
        left: steps until it is let go.
        history: the model's positions [m], shape (N, H+1, D); None: it begins with the true ones.
        order: the true point that each of the model's is compared with, shape (N,); None: itself.
    """

    draw: Draw
    left: int
    history: np.ndarray | None = None
    order: np.ndarray | None = None


@dataclass(frozen=True)
class Memory:
    """A state that the model made once.

    Attributes:
        draw: its source, mixture of tracers and frame.
        history: the model's positions [m], shape (N, H+1, D).
        order: as of `Rolling`.
    """

    draw: Draw
    history: np.ndarray
    order: np.ndarray | None = None


class Replay:
    """This rank's flows. What is drawn follows from the seed and from how many were drawn before.

    Args:
        data: where flows begin, and what they should have done.
        recipe: `replay` flows are kept, for up to `replay_steps` steps each, and `replay_memory`
            states of them.
    """

    def __init__(
        self, data: WindowIndex, recipe: Recipe, statistics: Statistics, ranks: Ranks
    ) -> None:
        self._data, self._recipe, self._statistics = data, recipe, statistics
        self._ranks = ranks
        self._kinematic = kinematic_spacing(recipe.model)
        self.drawn = 0
        self.flows: list[Rolling] = []
        self.remembered = 0
        self.memories: list[Memory] = []
        self._taken: list[tuple[Rolling, Window]] = []
        self._after: Tensor | None = None

    def take(self, step: int) -> tuple[Batch, float]:
        """The flows of optimiser step `step` as a batch, and about how many edges it has.

        The batch's history is the model's own, and its one move leads towards the truth.
        """
        recipe = self._recipe
        while len(self.flows) < recipe.replay:
            self.flows.append(self._begin())
        self._taken, edges = [], 0.0
        for flow in self.flows:
            if self._taken and edges + flow.draw.edges / 2 > recipe.edges_per_batch:
                break
            edges += flow.draw.edges
            truth = self._truth(flow.draw, flow.order)
            if flow.history is None:
                rng = self._rng(batches.NOISE, step, len(self._taken))
                flow.history = _noisy(truth, recipe.model.noise_std, rng)
            self._taken.append((flow, truth))
        states = [(flow.history, truth) for flow, truth in self._taken if flow.history is not None]
        return self._asked(states), edges

    def recall(self, step: int) -> tuple[Batch, float] | None:
        """States from memory as a batch, and about how many edges it has; None: there are none
        yet."""
        if not self.memories:
            return None
        rng, edges = self._rng(batches.RECALL, step), 0.0
        states: list[tuple[np.ndarray, Window]] = []
        while True:
            memory = self.memories[int(rng.integers(len(self.memories)))]
            if states and edges + memory.draw.edges / 2 > self._recipe.edges_per_batch:
                return self._asked(states), edges
            edges += memory.draw.edges
            states.append((memory.history, self._truth(memory.draw, memory.order)))

    def _truth(self, draw: Draw, order: np.ndarray | None) -> Window:
        truth = batches.read(self._data, draw, unroll=1, kinematic=self._kinematic)
        return truth if order is None else truth.reordered(order)

    def _asked(self, states: list[tuple[np.ndarray, Window]]) -> Batch:
        """The model's histories with what is asked of them."""
        own, backs = [], []
        for history, truth in states:
            move, back = wish(history, truth, self._recipe.return_steps or 1.0)
            after = history[:, -1:] + move[:, None]
            own.append(dataclasses.replace(truth, history=history, future=after))
            backs.append(back)
        device, rng = self._ranks.device, self._rng(batches.NOISE)
        batch = batches.collate(own, noise_std=0.0, rng=rng, device=device)  # they have their own
        return dataclasses.replace(batch, back=torch.from_numpy(np.concatenate(backs)).to(device))

    def advanced(self, after: Tensor) -> None:
        """What the model makes of the flows taken: positions [m], shape (N, D)."""
        self._after = after.detach()

    def keep(self) -> None:
        """Go on from there, once the step counts; a step that is abandoned leaves no trace."""
        if self._after is None:
            return
        positions = self._after.float().cpu().numpy()
        flows, start = self.flows[len(self._taken) :], 0
        for flow, truth in self._taken:
            assert flow.history is not None
            now = positions[start : start + len(flow.history)]
            start += len(now)
            frame = flow.draw.frame + self._data.stride(flow.draw.source)
            strayed = np.abs(now - truth.future[:, 0]).mean()
            if (
                flow.left <= 1
                or not strayed <= ASTRAY * self._recipe.model.spacing
                or frame >= self._data.starts(flow.draw.source, 1)
            ):
                flows.append(self._begin())
                continue
            history = np.concatenate([flow.history[:, 1:], now[:, None]], axis=1)
            draw = dataclasses.replace(flow.draw, frame=frame)
            order = self._paired(flow, draw, history)
            flows.append(Rolling(draw, flow.left - 1, history, order))
            self._remember(Memory(draw, history, order))
        self.flows, self._after = flows, None

    def _paired(self, flow: Rolling, draw: Draw, history: np.ndarray) -> np.ndarray | None:
        """The order of a flow after a step of it."""
        if not self._recipe.replay_exchange or flow.left % EXCHANGE:
            return flow.order
        order = np.arange(len(history), dtype=np.int32) if flow.order is None else flow.order
        return least_way_back(
            history, self._truth(draw, None), order, self._recipe.return_steps or 1.0
        )

    def _remember(self, memory: Memory) -> None:
        room = self._recipe.replay_memory
        if len(self.memories) < room:
            self.memories.append(memory)
        elif room:
            place = int(self._rng(batches.REMEMBER, self.remembered).integers(room))
            self.memories[place] = memory
        self.remembered += 1

    # -- files ---------------------------------------------------------------------------------

    def save(self, folder: Path, step: int) -> None:
        """Write the flows whole, beside the state of the same step."""
        tensors = {str(k): f.history for k, f in enumerate(self.flows) if f.history is not None}
        tensors |= {f"memory-{k}": m.history for k, m in enumerate(self.memories)}
        orders = {f"order-{k}": f.order for k, f in enumerate(self.flows)}
        orders |= {f"memory-order-{k}": m.order for k, m in enumerate(self.memories)}
        tensors |= {name: order for name, order in orders.items() if order is not None}
        about = [[dataclasses.asdict(f.draw), f.left] for f in self.flows]
        metadata = {
            "step": str(step),
            "data": self._data_told,
            "drawn": str(self.drawn),
            "flows": json.dumps(about),
            "remembered": str(self.remembered),
            "memories": json.dumps([dataclasses.asdict(m.draw) for m in self.memories]),
        }
        write_whole(folder / self._file, save(tensors, metadata=metadata))

    def restore(self, folder: Path, step: int) -> None:
        """Go on with what `save` wrote at `step`; with new flows if that is not what there is.

        A run that was killed between two files, or goes on with other data, loses no more than
        that: flows begin again from true states.
        """
        try:
            content = (folder / self._file).read_bytes()
            tensors = load(content)
            size = int.from_bytes(content[:8], "little")
            metadata = json.loads(content[8 : 8 + size])["__metadata__"]
            if int(metadata["step"]) != step or metadata["data"] != self._data_told:
                return
            flows = [
                Rolling(Draw(**draw), left, tensors.get(str(k)), tensors.get(f"order-{k}"))
                for k, (draw, left) in enumerate(json.loads(metadata["flows"]))
            ]
            memories = [
                Memory(Draw(**draw), tensors[f"memory-{k}"], tensors.get(f"memory-order-{k}"))
                for k, draw in enumerate(json.loads(metadata["memories"]))
            ]
            drawn, remembered = int(metadata["drawn"]), int(metadata["remembered"])
        except (OSError, SafetensorError, KeyError, TypeError, ValueError):
            return
        self.flows, self.drawn = flows[: self._recipe.replay], drawn
        self.memories, self.remembered = memories[: self._recipe.replay_memory], remembered

    @property
    def _data_told(self) -> str:
        """What changes with the flows that a `Draw` counts, and not with where they are kept: a
        state of one flow that is asked the way back to another learns nonsense, if not fails."""
        told = hashlib.sha256()
        for k, source in enumerate(self._data.sources):
            about = (len(source.residue), self._data.starts(k, 1), source.jitter, source.plane)
            told.update(f"{source.scene.model_dump_json()} {about}\n".encode())
        return told.hexdigest()

    @property
    def _file(self) -> str:
        return f"replay-{self._ranks.rank}.safetensors"

    def _begin(self) -> Rolling:
        recipe = self._recipe
        rng = self._rng(batches.UNROLL, self.drawn)
        self.drawn += 1
        [[draw]] = batches.draw(
            self._data,
            rng,
            ranks=1,
            edges_per_batch=1,
            statistics=self._statistics,
            mirror=recipe.mirror,
            early=recipe.early,
            early_steps=recipe.early_steps,
            halves=recipe.halves,
        )
        return Rolling(draw, int(rng.integers(1, recipe.replay_steps + 1)))

    def _rng(self, purpose: int, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self._recipe.seed, purpose, *numbers, self._ranks.rank])


def wish(history: np.ndarray, window: Window, return_steps: float) -> tuple[np.ndarray, np.ndarray]:
    """The displacement to ask for [m], shape (N, D): the module's equation, times dt², and v dt;
    and the part of it that leads back.

    Args:
        history: the model's positions [m], shape (N, H+1, D).
        window: the truth at the same frame, with one step of future.
    """
    truth = window.history
    error, before = history[:, -1] - truth[:, -1], history[:, -2] - truth[:, -2]
    acceleration = window.future[:, 0] - 2 * truth[:, -1] + truth[:, -2]
    back = -(2 * (error - before) / return_steps + error / return_steps**2)
    move = history[:, -1] - history[:, -2] + acceleration + back
    return move.astype(np.float32), back.astype(np.float32)


def _noisy(window: Window, std: float, rng: np.random.Generator) -> np.ndarray:
    """The true history of a flow that begins, with the noise of the training."""
    moving = window.particle_type != batches.STATIONARY
    points, frames, dim = window.history.shape
    if std == 0:
        return window.history
    walk = batches.random_walk(rng, points, frames - 1, dim, std)
    noisy: np.ndarray = (window.history + walk * moving[:, None, None]).astype(np.float32)
    return noisy
