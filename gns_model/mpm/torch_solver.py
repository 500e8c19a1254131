"""The reference solver for many scenes at once, on a GPU: scenes in, trajectories out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from gns_model.errors import SimulatorError
from gns_model.mpm.problem import DAMPING_RATE, Discretisation, Problem, pose, require_positive
from gns_model.mpm.torch_batch import Batch, State
from gns_model.mpm.torch_transfer import advance
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import Trajectory

#: Substeps before a graph is captured: libraries set themselves up in the first.
WARM_UP = 3


class TorchMpmSimulator:
    """Explicit MPM in torch, float64, many scenes at once: the scheme of `MpmSimulator`.

    A substep is 146 kernel launches in 2D and 189 in 3D with baffles, whatever the number of
    points, so a GPU is used well when it has a million points: 32 scenes of the paper's flume. On
    a CPU it is some ten times slower than `MpmSimulator` and good for checks only. Scenes of a
    batch may differ in everything but their dimension; each advances by its own substep, and the
    results are those of the scene alone. On CUDA two runs differ by round-off, see
    `torch_transfer`.

    Args:
        spacing, frame_interval, cfl, damping_rate, jitter, filling: see `Discretisation`.
        device: "cpu", or "cuda" (one with fast float64, such as an A100 or H100, is best).
        batch: scenes at once. A point takes some 5 KB of device memory in 3D and 2.5 KB in 2D, and
            12 or 8 bytes for every stored frame.
        cuda_graph: capture the substep in a CUDA graph and replay it, which spares small batches
            the time between launches. Not yet tried on a GPU; off by default.

    Raises:
        SimulatorError: if an argument makes no sense or there is no such device.
    """

    name = "mpm"

    def __init__(
        self,
        *,
        spacing: float | None = None,
        frame_interval: float = 0.01,
        cfl: float = 0.4,
        damping_rate: float = DAMPING_RATE,
        jitter: float = 0.0,
        filling: int = 0,
        device: str = "cpu",
        batch: int = 32,
        cuda_graph: bool = False,
    ) -> None:
        self.chosen = Discretisation(
            spacing=spacing, frame_interval=frame_interval, cfl=cfl, damping_rate=damping_rate,
            jitter=jitter, filling=filling,
        )  # fmt: skip
        require_positive(batch=batch)
        self.batch = batch
        self.device = _device(device)
        if cuda_graph and self.device.type != "cuda":
            raise SimulatorError(f"cuda_graph needs device cuda, not {device}")
        self.cuda_graph = cuda_graph

    @property
    def spacing(self) -> float | None:
        """The spacing asked for [m]; None is the default for the scene's dimension."""
        return self.chosen.spacing

    def settings(self) -> dict[str, Any]:
        """The arguments that this simulator was made with."""
        own = {"device": str(self.device), "batch": self.batch, "cuda_graph": self.cuda_graph}
        return {**asdict(self.chosen), **own}

    def refilled(self, jitter: float, filling: int) -> TorchMpmSimulator:
        """The same solver on starts off their lattice, see `Discretisation`."""
        return TorchMpmSimulator(**{**self.settings(), "jitter": jitter, "filling": filling})

    def check(self, scene: Scene) -> None:
        """Raise SimulatorError if `scene` would not fit in memory."""
        self.chosen.check(scene)

    def rollout(
        self,
        scenes: Sequence[Scene],
        *,
        fillings: Sequence[int] | None = None,
        progress: Progress | None = None,
    ) -> list[Trajectory]:
        """Simulate every scene for its duration.

        Args:
            scenes: any mixture of 2D and 3D.
            fillings: `filling` of every scene, in place of the simulator's.
            progress: called with the fraction done.

        Returns:
            One trajectory a scene, in order. A rollout that blows up has status "diverged" and
            repeats its last good frame; the others go on as if alone.

        Raises:
            SimulatorError: as `check`, or if the device's memory does not hold a batch.
        """
        for scene in scenes:
            self.check(scene)
        own = [self.chosen.filling] * len(scenes) if fillings is None else fillings
        choices = [replace(self.chosen, filling=filling) for filling in own]
        problems = [pose(scene, c) for scene, c in zip(scenes, choices, strict=True)]
        work = [p.count * p.frames * p.substeps for p in problems]
        finished = 0.0
        results: dict[int, Trajectory] = {}
        for group in self._groups(scenes):
            share = sum(work[k] for k in group)

            def report(fraction: float, finished: float = finished, share: float = share) -> None:
                if progress is not None:
                    progress(min(1.0, (finished + fraction * share) / sum(work)))

            chosen = [problems[k] for k in group]
            started = time.perf_counter()
            try:
                positions, bad_frames = roll_out(
                    chosen, self.device, cuda_graph=self.cuda_graph, progress=report
                )
            except torch.OutOfMemoryError:
                raise SimulatorError(
                    f"{self.device} has too little memory for {len(group)} scenes of "
                    f"{sum(p.count for p in chosen)} points at once: lower the batch"
                ) from None
            seconds = (time.perf_counter() - started) / len(group)
            for k, film, bad_frame in zip(group, positions, bad_frames, strict=True):
                settings = {**self.settings(), **asdict(choices[k]), "seconds": seconds}
                results[k] = problems[k].trajectory(film, bad_frame, settings)
            finished += share
        return [results[k] for k in range(len(scenes))]

    def _groups(self, scenes: Sequence[Scene]) -> list[list[int]]:
        """Indices of the scenes that go together: of one dimension, at most `batch`."""
        groups = []
        for dim in (2, 3):
            alike = [k for k, scene in enumerate(scenes) if scene.dim == dim]
            groups += [alike[k : k + self.batch] for k in range(0, len(alike), self.batch)]
        return groups


def roll_out(
    problems: Sequence[Problem],
    device: torch.device,
    *,
    cuda_graph: bool = False,
    progress: Progress | None = None,
) -> tuple[list[np.ndarray], list[int | None]]:
    """Advance scenes of one dimension together, each to its own end.

    The host looks at the device once in a frame of the scene with the most substeps. Scenes that
    are done, or have diverged, then leave the batch.

    Returns:
        positions: of every scene [m], shape (frames + 1, N, D), float32.
        bad_frames: for every scene the first frame in which a point had left physics, or None.
    """
    dim = problems[0].scene.dim
    total = [p.frames * p.substeps for p in problems]
    state = State.start(problems, device)
    films = [
        torch.empty(p.frames + 1, p.count, dim, dtype=torch.float32, device=device)
        for p in problems
    ]
    for film, p in zip(films, problems, strict=True):
        film[0] = torch.tensor(p.start.positions, device=device)
    most = max(p.frames for p in problems)
    speeds = torch.zeros(len(problems), most + 1, dtype=torch.float64, device=device)
    bad_frames: list[int | None] = [None] * len(problems)
    running = list(range(len(problems)))
    step = 0
    context = torch.cuda.device(device) if device.type == "cuda" else nullcontext()
    with torch.no_grad(), context:
        while running:
            group = [problems[k] for k in running]
            batch = Batch.of(group, device)
            advance_all = _substep(state, batch, cuda_graph)
            left: list[int] = running
            while left == running:
                for _ in range(max(p.substeps for p in group)):
                    advance_all()
                    step += 1
                    for k, part in zip(running, batch.parts, strict=True):
                        frame, rest = divmod(step, problems[k].substeps)
                        if rest == 0 and frame <= problems[k].frames:
                            films[k][frame] = state.position[part]
                            speeds[k, frame] = state.velocity[part].abs().amax()
                fast = speeds.cpu().numpy()
                for k in running:
                    reached = step // problems[k].substeps
                    wrong = ~(fast[k, 1 : reached + 1] < problems[k].limit)  # True for NaN, too
                    if wrong.any():
                        bad_frames[k] = 1 + int(wrong.argmax())
                left = [k for k in running if bad_frames[k] is None and step < total[k]]
                if progress is not None:
                    done = sum(min(step, t) if k in left else t for k, t in enumerate(total))
                    progress(done / sum(total))
            parts = [part for k, part in zip(running, batch.parts, strict=True) if k in left]
            if parts:
                state = state.pick(parts)
            running = left
        return [film.cpu().numpy() for film in films], bad_frames


def _substep(state: State, batch: Batch, cuda_graph: bool) -> Callable[[], None]:
    """What advances `state` by one substep when called."""
    if not cuda_graph:
        return lambda: advance(state, batch)
    before = [values.clone() for values in state.tensors()]
    aside = torch.cuda.Stream()
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):
        for _ in range(WARM_UP):
            advance(state, batch)
    torch.cuda.current_stream().wait_stream(aside)
    for values, saved in zip(state.tensors(), before, strict=True):
        values.copy_(saved)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        advance(state, batch)
    return graph.replay


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError:
        raise SimulatorError(f"no device {name!r}: give cpu or cuda") from None
    if device.type not in ("cpu", "cuda"):
        raise SimulatorError(f"device {name!r} cannot be used: give cpu or cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SimulatorError(f"device {name!r} is not there: give cpu, or cuda on a GPU machine")
    return device
