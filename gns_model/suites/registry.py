"""Which suites there are, which of them fit a simulator, and what a run of them leaves behind."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gns_model.errors import GnsError, SimulatorError
from gns_model.files import write_whole
from gns_model.simulator import Simulator
from gns_model.suites import columns, flume, friction, speed, training, upscaled
from gns_model.suites.result import SuiteResult, finite
from gns_model.suites.setup import Setup, dimension

#: All suites that fit.
ALL = "all"
RESULTS = "results.json"


@dataclass(frozen=True)
class Suite:
    """A suite by name.

    Attributes:
        run: does it.
        dim: of the scenes that it simulates; None if it fits every model.
        useless: why a simulator of that dimension cannot say anything here, or None.
    """

    run: Callable[[Simulator, Setup], SuiteResult]
    dim: int | None = None
    useless: Callable[[Simulator], str | None] = lambda simulator: None

    def misfit(self, simulator: Simulator) -> str | None:
        """Why the simulator cannot run this suite; None if it can."""
        dim = dimension(simulator)
        if self.dim is None or dim is None or dim == self.dim:
            return None
        return f"its scenes are {self.dim}D and {simulator.name} is a {dim}D model"


SUITES = {
    "columns": Suite(columns.run, dim=2),
    "upscaled": Suite(upscaled.run, dim=2),
    "friction": Suite(friction.run, dim=2, useless=friction.blind),
    "flume": Suite(flume.run, dim=3),
    "speed": Suite(speed.run),
    "training": Suite(training.run),
}


def chosen(name: str, simulator: Simulator) -> tuple[list[str], dict[str, str]]:
    """The suites that `name` means for a simulator, and those left out with the reason.

    Raises:
        SimulatorError: if there is no such suite, or the one asked for does not fit.
    """
    if name == ALL:
        reasons = {n: s.misfit(simulator) or s.useless(simulator) for n, s in SUITES.items()}
        return [n for n in SUITES if not reasons[n]], {n: r for n, r in reasons.items() if r}
    if name not in SUITES:
        raise SimulatorError(f"no suite named {name!r}: give {', '.join([*SUITES, ALL])}")
    reason = SUITES[name].misfit(simulator)
    if reason is not None:
        raise SimulatorError(f"suite {name!r} does not fit: {reason}")
    return [name], {}


def run_suites(
    simulator: Simulator,
    name: str,
    setup: Setup,
    *,
    finished: Callable[[SuiteResult], None] = lambda result: None,
) -> dict[str, Any]:
    """Run a suite, or all that fit, and write tables, figures and `results.json` into `setup.out`.

    Everything is written suite by suite, so that an interrupt keeps what is done; suites of the
    same model that an earlier run left in the folder stay in `results.json`.

    Args:
        name: of a suite, or "all".
        finished: called with every result.

    Returns:
        what `results.json` holds, but for suites of earlier runs.

    Raises:
        SimulatorError: if there is no such suite, it does not fit, or the simulator cannot run it.
    """
    names, left_out = chosen(name, simulator)
    report: dict[str, Any] = {
        "model": simulator.name,
        "weights_sha256": getattr(simulator, "card", {}).get("weights_sha256"),
        "reference": {"simulator": "mpm", "spacing": setup.spacing},
        "suites": {},
        "left_out": left_out,
    }
    for each in names:
        try:
            result = run_suite(each, simulator, setup)
        except GnsError as error:
            if name != ALL:
                raise
            left_out[each] = str(error)
            continue
        report["suites"][each] = result.to_dict()
        _write(setup.out / RESULTS, report)
        finished(result)
    return finite(report)


def run_suite(name: str, simulator: Simulator, setup: Setup) -> SuiteResult:
    """Run one suite and write its tables."""
    began = time.perf_counter()
    with warnings.catch_warnings():
        # A model says so once and then no more; the result says so every time.
        warnings.filterwarnings("ignore", message=".*is outside what")
        result = SUITES[name].run(simulator, setup)
    result.write_tables(setup.out)
    result.seconds = time.perf_counter() - began
    return result


def _write(path: Path, report: dict[str, Any]) -> None:
    """Write the report, with the suites of earlier runs of the same model and settings added."""
    whole = {**report, "suites": {**_earlier(path, report), **report["suites"]}}
    write_whole(path, (json.dumps(finite(whole), indent=2) + "\n").encode())


def _earlier(path: Path, report: dict[str, Any]) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
        same = all(content[k] == report[k] for k in ("model", "weights_sha256", "reference"))
        return dict(content["suites"]) if same else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
