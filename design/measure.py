"""Measure one layout beside the flow without baffles: the whole of `gns-design evaluate`."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from design.evaluators import SimulatorSpec
from design.store import RolloutStore
from gns_env.objective import Objective
from gns_model.console import progress_bar
from gns_model.errors import SimulatorError
from gns_model.scene import Scene
from gns_model.trajectory import OK, Trajectory
from gns_model.vtkhdf import save_vtkhdf
from gns_model.workers import Workers, as_completed, default_count


def measure(
    scene: Scene,
    spec: SimulatorSpec,
    *,
    objective: Objective | None = None,
    workers: int | None = None,
    vtk: Path | None = None,
    quiet: bool = True,
) -> dict[str, Any]:
    """Simulate `scene` with and without its baffles, side by side.

    Args:
        scene: what to measure; `spec` and `objective`: by whom and how it is weighed.
        workers: processes; default: one for each of the two flows.
        vtk: where to write the flow with baffles for ParaView, if anywhere.
        quiet: no progress.

    Returns:
        `measures` and `no_baffles` (each as `gns_model.measures.summary`), `relative` (their ratio,
        where no baffles is not zero), `cost`, `cost_no_baffles`, and what was simulated.

    Raises:
        SimulatorError: if the simulator cannot run the scene, or a rollout fails.
    """
    spec.load().check(scene)
    objective = objective or Objective()
    scenes = [scene, scene.with_baffles([])] if scene.baffles else [scene]
    count = workers or min(len(scenes), default_count())
    with (
        tempfile.TemporaryDirectory() as folder,
        progress_bar(quiet=quiet) as bar,
        Workers(count) as pool,
    ):
        store = RolloutStore(Path(folder), pool)
        pending = [store.start(spec, s) for s in scenes]
        task = bar.add_task(f"{spec.name}: with and without baffles", total=len(scenes))
        jobs = [p.job for p in pending if p.job is not None]
        for _ in as_completed(
            jobs, lambda: bar.update(task, completed=sum(p.fraction for p in pending))
        ):
            pass
        rolled = [p.result() for p in pending]
        if vtk is not None and rolled[0].status == OK:
            save_vtkhdf(Trajectory.load(rolled[0].path), vtk)
    for s, r in zip(scenes, rolled, strict=True):
        if r.status != OK:
            raise SimulatorError(
                f"the rollout of {spec.name} with {len(s.baffles)} baffles ended as {r.status!r}"
            )
    own, none = rolled[0].measures, rolled[-1].measures
    return {
        "scene": scene.name,
        "baffles": len(scene.baffles),
        "layout": json.loads(json.dumps([b.center for b in scene.baffles])),
        "size": [list(b.size) for b in scene.baffles],
        "yaw": [b.yaw for b in scene.baffles],
        "simulator": spec.name,
        "measures": own,
        "no_baffles": none,
        "relative": {k: own[k] / none[k] for k in own if abs(none[k]) > 1e-12},
        "cost": objective.cost(own, none),
        "cost_no_baffles": objective.baseline,
        "objective": str(objective),
        "seconds": round(sum(r.seconds for r in rolled), 2),
    }
