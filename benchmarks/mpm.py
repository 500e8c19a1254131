"""Reference solver: particle-substeps per CPU second, beside a plain NumPy transfer of the same
points in the same run, and what threads are worth. `python benchmarks/mpm.py`"""

from __future__ import annotations

import time

import numpy as np

from gns_model import paper
from gns_model.mpm import MpmSimulator, solver
from gns_model.mpm.problem import DEFAULT_SPACING
from gns_model.particles import fill


def solver_rate(scene, seconds_of_flow):
    """Particle-substeps per CPU second, compilation excluded."""
    simulator = MpmSimulator()
    simulator.rollout([scene.replace(duration=0.01)])
    began = time.process_time()
    trajectory = simulator.rollout([scene.replace(duration=seconds_of_flow)])[0]
    spent = time.process_time() - began
    substeps = seconds_of_flow / trajectory.settings["substep"]
    return substeps * trajectory.positions.shape[1] / spent


def numpy_rate(scene, repeats=3):
    """The same for one scatter and gather of mass and momentum in NumPy, without any stress: a
    lower bound on what a plain NumPy solver would cost."""
    points = fill(scene, DEFAULT_SPACING[scene.dim])
    dim, dx = scene.dim, 2 * points.spacing
    shape = tuple(int(s / dx) + 6 for s in scene.domain.size)
    grid_position = (points.positions - scene.domain.lower) / dx + 2
    began = time.process_time()
    for _ in range(repeats):
        base = (grid_position - 0.5).astype(int)
        f = grid_position - base
        weights = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
        grid = np.zeros((*shape, dim + 1))
        stencil = np.stack(np.meshgrid(*[range(3)] * dim, indexing="ij"), -1).reshape(-1, dim)
        values = np.concatenate([np.ones((len(f), 1)), points.velocities], axis=1)
        for offset in stencil:
            w = np.prod([weights[o][:, d] for d, o in enumerate(offset)], axis=0)
            np.add.at(grid, tuple((base + offset).T), w[:, None] * values)
        gathered = np.zeros_like(values)
        for offset in stencil:
            w = np.prod([weights[o][:, d] for d, o in enumerate(offset)], axis=0)
            gathered += w[:, None] * grid[tuple((base + offset).T)]
    return repeats * len(f) / (time.process_time() - began)


def threads_ratio(scene, spacing, seconds_of_flow, threads=4):
    """Number of points, and the time of `threads` threads in shares of that of one."""
    solver.THREAD_POINTS = 0
    spent = []
    for count in (1, threads):
        simulator = MpmSimulator(spacing=spacing, threads=count)
        simulator.rollout([scene.replace(duration=0.01)])
        began = time.perf_counter()
        simulator.rollout([scene.replace(duration=seconds_of_flow)])
        spent.append(time.perf_counter() - began)
    return len(fill(scene, spacing).positions), spent[1] / spent[0]


def main():
    cases = {
        "2D column a = 1": (paper.column_scene(paper.COLUMNS[2]), 0.3),
        "3D flume": (paper.flume_scene(), 0.1),
    }
    for name, (scene, duration) in cases.items():
        ours, plain = solver_rate(scene, duration), numpy_rate(scene)
        print(
            f"{name:16s} {ours / 1e6:5.2f} million particle-substeps per CPU second, "
            f"{ours / plain:4.1f} times NumPy's bare transfer ({plain / 1e6:.2f})"
        )
    column, flume = cases["2D column a = 1"][0], cases["3D flume"][0]
    print("time of four threads in shares of that of one:")
    for scene, spacings in ((column, (0.0125, 0.00625, 0.003)), (flume, (0.03, 0.02, 0.015625))):
        for spacing in spacings:
            points, ratio = threads_ratio(scene, spacing, 0.03)
            print(f"  {scene.dim}D {points:6d} points {ratio:5.2f}", flush=True)


if __name__ == "__main__":
    main()
