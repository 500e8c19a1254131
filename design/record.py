"""What summary.json says of a run, at any stage of it: what was found, and what was asked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from design.constraints import constraints, to_blame
from design.front import front_entries, relative
from design.outcome import Trial
from design.pareto import front
from design.settings import Settings
from design.storage import public
from design.summary import results, versions
from design.verify import Judged

if TYPE_CHECKING:
    from design.run import Run


def record(run: Run, status: str, ranked: Sequence[Judged]) -> dict[str, Any]:
    """Plain values for summary.json.

    Args:
        status: one of those of `summary`.
        ranked: the layouts to tell of, best first.
    """
    trials = run.log.trials()
    total = time.perf_counter() - run.began
    found = {
        "status": status,
        **results(ranked, run.paper, run.none, trials, run.settings.objective),
        **_limits(run, ranked, trials),
        **_several(run, trials),
        **({"ensemble": run.ensemble.describe()} if run.ensemble else {}),
        **({"refined": run.rounds} if run.settings.refine else {}),
        "reference_rollouts": run.reference_rollouts,
        "seconds": {k: round(v, 2) for k, v in {**run.seconds, "total": total}.items()},
        "notes": run.notes,
        "command": run.command,
        "settings": _settings(run),
        "versions": versions(),
    }
    for spent in ("rollouts", "backwards"):
        found[spent] += sum(told[spent] for told in run.rounds)
    return found


def _limits(run: Run, ranked: Sequence[Judged], trials: Sequence[Trial]) -> dict[str, Any]:
    """The constraints of the best; which of them none keeps becomes a note."""
    if not ranked:
        return {}
    problem = run.problem
    scene = problem.built(problem.bare, ranked[0])
    line = to_blame(problem.rules, [t.outcome for t in trials if t.ok])
    if line:
        run.note(line)
    return {"constraints": constraints(scene, problem.rules, ranked[0])}


def _several(run: Run, trials: Sequence[Trial]) -> dict[str, Any]:
    """Of several objectives and of several flows."""
    s = run.settings
    found: dict[str, Any] = {}
    if s.objectives:
        found["objectives"] = [str(part) for part in s.parts]
        found["front"] = front_entries(
            front(trials), s.parts, s.objectives, run.ranked, run.problem.space
        )
        found["tried"] = [relative(t.outcome.costs, s.parts, s.objectives) for t in trials if t.ok]
    if s.scenarios:
        found["risk"] = str(s.risk)
        found["scenarios"] = [asdict(flow) for flow in run.problem.drawn]
    return found


def _settings(run: Run) -> dict[str, Any]:
    """What was chosen, as the command that would do it again has it."""
    s, problem = run.settings, run.problem
    return {
        "scene": problem.scene.name,
        "method": run.method,
        "baffles": problem.baffles,
        "budget": s.passes,
        "verify": s.verify,
        "seed": s.seed,
        "batch": s.batch,
        "workers": run.workers,
        "simulator": {**s.simulator.describe(), "device": s.simulator.device},
        "verify_with": s.verifier.describe(),
        "objective": {**asdict(s.objective), "text": problem.objective_text},
        **({"objectives": ",".join(s.objectives)} if s.objectives else {}),
        **_freed(s),
        **({"scenarios": s.scenarios.describe()} if s.scenarios else {}),
        **_trusted(s),
        "storage": public(run.storage),
        "study": s.study,
    }


def _freed(s: Settings) -> dict[str, Any]:
    """The options of variables, limits and prices.

    What they put into the placement stands in scene.toml of the run.
    """
    return {
        **({"pattern": s.pattern} if s.pattern != "free" else {}),
        **({"baffle_cost": s.baffle_cost} if s.baffle_cost else {}),
        **({"concrete_cost": s.concrete_cost} if s.concrete_cost else {}),
    }


def _trusted(s: Settings) -> dict[str, Any]:
    """The options of ensemble and refinement."""
    values: dict[str, Any] = {}
    if s.ensemble is not None:
        values["ensemble"] = ",".join(s.ensemble)
    if s.refine:
        values |= {"refine": s.refine, "refine_minutes": s.refine_minutes}
        values |= {"refine_data": str(s.refine_data)} if s.refine_data else {}
    return values
