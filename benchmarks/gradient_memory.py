"""Memory of a gradient through a whole rollout of the flume: with a checkpoint a step, and without.

    python benchmarks/gradient_memory.py [--model baffle-lite] [--limit 4096]

Every measurement is a process of its own, and what is told is the most memory that it ever held
(resident, imports and all). Without checkpoints a whole rollout would not fit here, so two short
ones give the memory of a step. Ends with 1 if the whole rollout takes more than --limit MB.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

FLUME = Path(__file__).parents[1] / "examples" / "flume.toml"
SHORT = (3, 5)  # frames of the rollouts that keep everything


def measure(model: str, frames: int | None, checkpoint: bool) -> None:
    """In a process of its own: one rollout and one backward pass, told as JSON."""
    import torch

    from gns_model import load_simulator
    from gns_model.scene import Scene

    torch.set_num_threads(1)
    scene = Scene.from_toml(FLUME)
    simulator: Any = load_simulator(model)
    for parameter in simulator.model.parameters():
        parameter.requires_grad_(False)  # as a search has it
    before = _peak()
    centres = torch.tensor(
        [b.center for b in scene.baffles], dtype=torch.float64, requires_grad=True
    )
    began = time.perf_counter()
    (track,) = simulator.rollout_tensor([scene], [centres], frames=frames, checkpoint=checkpoint)
    forward = time.perf_counter() - began
    track[-1, :, 0].mean().backward()
    assert centres.grad is not None
    assert centres.grad.isfinite().all()
    print(
        json.dumps(
            {
                "frames": len(track),
                "points": track.shape[1],
                "before": before,
                "peak": _peak(),
                "forward": forward,
                "backward": time.perf_counter() - began - forward,
            }
        )
    )


def _peak() -> float:
    """Most memory that this process has held [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(model: str, frames: int | None, checkpoint: bool) -> dict[str, float]:
    """`measure` in a new process."""
    command = [sys.executable, __file__, "--model", model, "--measure"]
    command += [str(frames or 0), str(int(checkpoint))]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    kind = "a checkpoint a step" if checkpoint else "everything kept   "
    print(
        f"{kind} {found['points']:5d} points {found['frames']:3d} frames: "
        f"peak {found['peak']:6.0f} MB, of which {found['before']:4.0f} MB before; "
        f"forward {found['forward']:5.1f} s, backward {found['backward']:5.1f} s"
    )
    return found


def main() -> int:
    """Print the table; 1 if the limit is passed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="baffle-lite")
    parser.add_argument("--limit", type=float, default=4096.0, help="MB for the whole rollout")
    parser.add_argument("--measure", nargs=2, type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        measure(given.model, given.measure[0] or None, bool(given.measure[1]))
        return 0
    whole = run(given.model, None, True)
    short, longer = (run(given.model, frames, False) for frames in SHORT)
    step = (longer["peak"] - short["peak"]) / (longer["frames"] - short["frames"])
    naive = short["peak"] + step * (whole["frames"] - short["frames"])
    print(
        f"A step that keeps everything holds {step:.0f} MB, so {whole['frames']} frames would take "
        f"{naive / 1024:.0f} GB (extrapolated): {naive / whole['peak']:.0f} times as much"
    )
    fits = whole["peak"] <= given.limit
    print(f"{whole['peak']:.0f} MB {'<=' if fits else '>'} {given.limit:.0f} MB")
    return 0 if fits else 1


if __name__ == "__main__":
    sys.exit(main())
