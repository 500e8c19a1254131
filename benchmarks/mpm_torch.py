"""The batched torch solver against the numba one in the same run: particle-substeps per second
over those of numba on one thread. `python benchmarks/mpm_torch.py [--quick]`

On a GPU machine the scenes are the paper's at its spacing, with and without a CUDA graph; without
a GPU they are coarse, because torch on a CPU is there for checks only.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from gns_model import paper
from gns_model.data.scenes import draw
from gns_model.mpm import MpmSimulator
from gns_model.mpm.torch_solver import TorchMpmSimulator
from gns_model.simulator import Simulator

BATCHES = (1, 8, 32)
#: Spacings without a GPU [m]: 144 points of the column, 980 of the flume.
COARSE = {2: 0.025, 3: 0.05}


def rate(simulator: Simulator, scenes: list, clock: Callable[[], float]) -> float:
    """Particle-substeps per second of `clock`, compilation and warm-up excluded."""
    simulator.rollout([scene.replace(duration=0.01) for scene in scenes])
    began = clock()
    trajectories = simulator.rollout(scenes)
    spent = clock() - began
    done = sum(t.positions.shape[1] * t.time[-1] / t.settings["substep"] for t in trajectories)
    return done / spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="batches of 1 and 8 only")
    batches = BATCHES[:2] if parser.parse_args().quick else BATCHES
    torch.set_num_threads(1)
    cuda = torch.cuda.is_available()
    print(f"GPU: {torch.cuda.get_device_name() if cuda else 'none'}")
    cases = {
        "2D column a = 1": ([paper.column_scene(paper.COLUMNS[2])] * max(batches), 0.05),
        "3D flume": ([draw("layouts", 0, i) for i in range(max(batches))], 0.02),
    }
    for name, (scenes, seconds) in cases.items():
        spacing = None if cuda else COARSE[scenes[0].dim]
        scenes = [scene.replace(duration=seconds) for scene in scenes]
        numba = rate(MpmSimulator(spacing=spacing), scenes[:1], time.process_time)
        print(f"{name}: numba, one thread, {numba / 1e6:.3f} million particle-substeps a second")
        variants = [("cuda", False), ("cuda", True)] if cuda else [("cpu", False)]
        for device, graph in variants:
            for batch in batches:
                simulator = TorchMpmSimulator(
                    spacing=spacing, device=device, batch=batch, cuda_graph=graph
                )
                # A rollout ends with a copy to the host, so a plain clock sees the whole of it.
                clock = time.perf_counter if device == "cuda" else time.process_time
                ours = rate(simulator, scenes[:batch], clock)
                label = device + (" graph" if graph else "")
                print(f"  {label:10s} batch {batch:2d}: {ours / numba:8.2f} times numba")


if __name__ == "__main__":
    main()
