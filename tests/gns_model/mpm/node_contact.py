"""Contact of the nodes by both solvers, from the same random velocities."""

import numpy as np
import torch

from gns_model.mpm.problem import Problem
from gns_model.mpm.torch_contact import node_contacts
from gns_model.mpm.transfer import update_grid
from gns_model.scene import Scene


def slide_nodes(scene: Scene, problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocities of all nodes before contact, after it by numba, and by torch, each (nodes, D)."""
    lattice, friction, axes = problem.lattice, scene.friction, slice(1, 1 + scene.dim)
    grid = np.zeros((len(problem.solid), 8))
    grid[:, 0] = 1.0
    grid[:, axes] = np.random.default_rng(0).normal(size=(len(grid), scene.dim))
    before, velocity = grid[:, axes].copy(), torch.tensor(grid[:, axes])
    bounds = np.array([0, lattice.nx, 0, lattice.ny, 0, lattice.nz])
    update_grid(
        grid, lattice, bounds, np.zeros(3), friction.base, friction.walls, friction.baffles,
        problem.solid, problem.turns, 0.0,
    )  # fmt: skip
    for contact in node_contacts([problem], torch.device("cpu")):
        contact.apply(velocity)
    return before, grid[:, axes], velocity.numpy()
