"""Granular flows around baffles: scenes, the reference solver and the learned simulator.

Everything named in `__all__` loads on first use, so that `import gns_model` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from gns_model import measures
    from gns_model.learned.graph import radius_graph
    from gns_model.mpm import MpmSimulator
    from gns_model.scene import Scene
    from gns_model.simulator import load_simulator
    from gns_model.trajectory import Trajectory

_HOME = {
    "MpmSimulator": "gns_model.mpm",
    "Scene": "gns_model.scene",
    "Trajectory": "gns_model.trajectory",
    "load_simulator": "gns_model.simulator",
    "radius_graph": "gns_model.learned.graph",
}

__all__ = [
    "MpmSimulator",
    "Scene",
    "Trajectory",
    "__version__",
    "load_simulator",
    "measures",
    "radius_graph",
]


def __getattr__(name: str) -> Any:
    if name == "measures":
        return import_module("gns_model.measures")
    if name not in _HOME:
        raise AttributeError(f"module 'gns_model' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
