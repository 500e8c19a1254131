"""A flume whose physics is a formula, so that a search can be tested in milliseconds.

The grains of a release slide down the flume; every baffle shortens the travel of the grains that
meet it, of more the wider it is, most at one best place. It answers `rollout` and `rollout_tensor`,
as a simulator does, and is smooth in the layout. Real simulators are used in test_run.py and
test_cli.py.
"""

from types import SimpleNamespace

import numpy as np
import torch

from design.campaign import Campaign
from design.evaluators import InProcess
from design.storage import sqlite_url
from design.trials import TrialLog
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.trajectory import DIVERGED, OK, Trajectory

FRAMES = 5
#: Where a baffle shortens the travel most [m].
BEST_X = 0.95


def formula_scene(**changes) -> Scene:
    """A flume of the paper's shape with two baffles."""
    values = {
        "name": "formula",
        "duration": 0.4,
        "section": 1.0,
        "domain": {"lower": [0.0, 0.0, 0.0], "upper": [2.0, 0.6, 1.6]},
        # High enough to pass over the baffles: the formula knows no contact.
        "release": [{"lower": [0.0, 0.35, 0.3], "upper": [0.3, 0.5, 1.3], "velocity": [1, 0, 0]}],
        "baffle": [
            {"center": [1.4, 0.4], "size": [0.15, 0.3, 0.15]},
            {"center": [1.4, 1.2], "size": [0.15, 0.3, 0.15]},
        ],
        "placement": {"lower": [0.5, 0.0], "upper": [1.8, 1.6], "gap": 0.1},
    }
    return Scene.from_dict({**values, **changes})


class FormulaSimulator:
    """See the module. `fails` decides which scenes diverge."""

    name = "formula"

    def __init__(self, *, spacing=0.05, fails=lambda scene: False):
        self.config = SimpleNamespace(dt=0.1, spacing=spacing)
        self.fails, self.seen = fails, []

    def check(self, scene):
        pass

    def rollout(self, scenes, *, progress=None):
        trajectories = []
        for scene in scenes:
            self.seen.append(scene)
            centres = torch.tensor([b.center for b in scene.baffles], dtype=torch.float64)
            across = torch.tensor([b.size[-1] for b in scene.baffles], dtype=torch.float64)
            positions = self._positions(scene, centres.reshape(-1, scene.dim - 1), across).numpy()
            trajectories.append(
                Trajectory(
                    positions=positions,
                    time=np.arange(FRAMES) * self.config.dt,
                    particle_type=np.full(positions.shape[1], MOVING, np.int8),
                    scene=scene,
                    point_volume=self.config.spacing**scene.dim,
                    simulator=self.name,
                    status=DIVERGED if self.fails(scene) else OK,
                )
            )
        return trajectories

    def _positions(self, scene, centres, across):
        start = torch.as_tensor(fill(scene, self.config.spacing).positions)
        meets = torch.exp(-(((start[:, None, 2] - centres[None, :, 1]) / (0.1 + across)) ** 2))
        near = torch.exp(-(((centres[:, 0] - BEST_X) / 0.3) ** 2))
        held = 1 - torch.prod(1 - 0.5 * meets * near, dim=1)
        shift = torch.linspace(0, 1, FRAMES, dtype=start.dtype)[:, None] * (0.9 - 0.6 * held)
        return torch.cat([(start[:, 0] + shift)[..., None], start[:, 1:].expand(FRAMES, -1, 2)], -1)

    def rollout_tensor(self, scenes, centres=None, *, sizes=None, yaws=None, **options):
        if sizes is None:
            sizes = [torch.tensor([b.size for b in scene.baffles]) for scene in scenes]
        return [
            self._positions(scene, c.to(torch.float64), size[:, -1].to(torch.float64))
            for scene, c, size in zip(scenes, centres, sizes, strict=True)
        ]


class PlainFormula:
    """The same without a gradient."""

    name = "formula"

    def __init__(self, **options):
        self._inner = FormulaSimulator(**options)
        self.rollout, self.check = self._inner.rollout, self._inner.check


def campaign(folder, *, simulator=None, scene=None, n=2, resume=False, **options) -> Campaign:
    """A campaign on the formula, its study in `folder`; travel alone counts."""
    scene = scene or formula_scene()
    simulator = simulator or FormulaSimulator()
    task = BaffleTask(scene, simulator, n_baffles=n, objective=Objective(depth_weight=0.0))
    evaluator = InProcess(task)
    url = sqlite_url(folder / "study.db")
    log = TrialLog.open(url, "test", evaluator.space, {"n": n}, resume=resume, owned=True)
    return Campaign(log=log, evaluator=evaluator, **{"budget": 20, **options})
