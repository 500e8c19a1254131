"""The searches by name, and which of them suits a task."""

from __future__ import annotations

from design import baselines, bayes, gradient, hybrid
from design.campaign import Search
from gns_model.errors import SimulatorError

METHODS: dict[str, Search] = {
    "random": baselines.random_search,
    "rows": baselines.rows_search,
    "bayes": bayes.search,
    "tpe": bayes.tpe,
    "gp": bayes.gp,
    "nsga2": bayes.nsga2,
    "gradient": gradient.search,
    "lbfgs": gradient.lbfgs,
    "hybrid": hybrid.search,
}

#: Methods that follow gradients: of one cost, through a simulator that has them.
FOLLOW = ("gradient", "lbfgs", "hybrid")


class MethodError(SimulatorError, ValueError):
    """A method that does not exist or cannot search this task."""


def choose(
    method: str | None, differentiable: bool, objectives: int, name: str, pattern: str = "free"
) -> str:
    """The method to use: `method` itself, or what suits the task if that is None.

    Args:
        differentiable: whether the simulator, called `name`, has a gradient.
        objectives: how many.
        pattern: "free" or "rows".

    Raises:
        MethodError: if there is no such method, or it cannot search this task.
    """
    if method is None:
        follows = differentiable and objectives == 1 and pattern == "free"
        return "hybrid" if follows else "bayes"
    if method not in METHODS:
        raise MethodError(f"no method {method!r}: give {', '.join(METHODS)}")
    if method in FOLLOW and not differentiable:
        raise MethodError(
            f"the simulator {name!r} has no gradient, so --method {method} cannot use it: choose "
            "a learned simulator such as baffle-lite, or --method bayes"
        )
    if method in FOLLOW and pattern == "rows":
        raise MethodError(
            f"--method {method} moves every baffle by itself, so it keeps no rows: give --method "
            "bayes, tpe, gp, nsga2, rows or random with --pattern rows, or --pattern free"
        )
    if method in FOLLOW and objectives > 1:
        raise MethodError(
            f"--method {method} follows the gradient of one cost, so it finds no Pareto front: "
            "give --method nsga2, tpe, gp or bayes with --objectives"
        )
    return method
