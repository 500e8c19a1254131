"""Searches over baffle layouts, their check by the reference solver, and what leaves the building.

`gns-design optimize` (cli.py) runs a search, verifies its best layouts and writes a run folder;
run.py is the same from Python. `design.optimize` is the search alone, in memory, and
`design.cost_and_gradient` the derivative that it follows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from design.search import Result, cost_and_gradient, optimize

__all__ = ["Result", "cost_and_gradient", "optimize"]


def __getattr__(name: str) -> Any:
    """Import Optuna and torch when a search is wanted: `gns-design --help` answers at once."""
    if name in __all__:
        from design import search

        return getattr(search, name)
    raise AttributeError(f"module 'design' has no attribute {name!r}")
