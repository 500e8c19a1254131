"""A run folder as a search leaves it, with made-up grains: for tests of what reads one.

The motion is kinematic (slide, slow down, slump, pile up before baffles), so that it costs
milliseconds; the numbers in summary.json are the real measures of these trajectories.
"""

import csv
import json
from pathlib import Path

import numpy as np

from gns_model import measures, particles
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

OWN = [(0.775, 0.375), (0.775, 1.625), (1.275, 1.0)]
BEST = [(0.80, 0.55), (0.82, 1.02), (0.79, 1.47)]
SECOND = [(0.72, 0.60), (0.95, 1.00), (0.72, 1.40)]


def flume():
    return Scene.from_dict(
        {
            "name": "flume <of the paper>",
            "domain": {"lower": [0.1, 0.1, 0.1], "upper": [1.9, 0.9, 1.9]},
            "release": [
                {"lower": [0.1, 0.1, 0.3], "upper": [0.45, 0.35, 1.7], "velocity": [2.0, 0, 0]}
            ],
            "baffle": [{"center": c, "size": [0.15, 0.30, 0.15]} for c in OWN],
            "placement": {
                "lower": [0.6, 0.1],
                "upper": [1.5, 1.9],
                "keep_out": [[1.2, 0.1, 1.5, 0.4]],
            },
            "duration": 0.9,
        }
    )


def channel():
    """The plane-strain sibling."""
    return Scene.from_dict(
        {
            "name": "channel",
            "domain": {"lower": [0.0, 0.0], "upper": [2.0, 0.8]},
            "release": [{"lower": [0.0, 0.0], "upper": [0.4, 0.3], "velocity": [2.0, 0.0]}],
            "baffle": [{"center": [1.2], "size": [0.1, 0.2]}],
            "placement": {"lower": [0.6], "upper": [1.6]},
            "duration": 0.9,
        }
    )


def slide(scene, *, spacing=0.05, frames=19, gain=1.0, simulator="mpm", seed=0):
    """Made-up grains that stop on the base and pile up before the baffles of `scene`."""
    points = particles.fill(scene, spacing)
    rng = np.random.default_rng(seed)
    start = points.positions
    time = np.linspace(0.0, scene.duration, frames)
    base = scene.base
    rise = (start[:, 1] - base) / np.ptp(start[:, 1])
    ahead = (start[:, 0] - start[:, 0].min()) / np.ptp(start[:, 0])
    reach = gain * (0.35 + 0.35 * rise + 0.45 * ahead + 0.04 * rng.standard_normal(len(start)))
    positions = np.empty((frames, *start.shape))
    for k, t in enumerate(time):
        x = start.copy()
        eased = 1 - np.exp(-((t / 0.22) ** 1.2))
        x[:, 0] += reach * eased
        x[:, 1] = base + (x[:, 1] - base) * (1 - 0.75 * eased)
        if scene.dim == 3:
            middle = (scene.domain.lower[2] + scene.domain.upper[2]) / 2
            x[:, 2] += 0.12 * eased * (x[:, 2] - middle)
        for lower, upper in scene.baffle_boxes():
            across = np.ones(len(x), bool)
            if scene.dim == 3:
                across = (x[:, 2] > lower[2]) & (x[:, 2] < upper[2])
            inside = across & (x[:, 0] > lower[0])
            over = x[inside, 0] - lower[0]
            x[inside, 0] = lower[0] - 0.08 * np.tanh(over)
            x[inside, 1] += 0.5 * over * (0.3 + rise[inside])
        positions[k] = np.clip(x, scene.domain.lower, scene.domain.upper)
    return Trajectory(
        positions=positions.astype(np.float32),
        time=time,
        particle_type=np.full(len(start), particles.MOVING),
        scene=scene,
        point_volume=points.volume,
        simulator=simulator,
        settings={"spacing": spacing},
        lattice=points.lattice,
    )


def write_run(
    folder, scene=None, *, layouts=(BEST, SECOND), verified=True, trials=30, **slide_options
):
    """Write a complete (or, with verified=False, an interrupted) run folder; return its path."""
    folder = Path(folder)
    scene = scene or flume()
    named = {"best": layouts[0], "paper": None, "none": []}
    named.update({f"rank-{k}": layout for k, layout in enumerate(layouts[1:], start=2)})
    entries = {}
    reference = {}
    for key in ("none", *(k for k in named if k != "none")):
        layout = named[key]
        placed = scene if layout is None else scene.with_baffles(layout)
        entry = {"layout": [list(b.center) for b in placed.baffles]}
        for name, simulator, gain in (("surrogate", "learned", 0.97), ("verified", "mpm", 1.0)):
            if name == "verified" and not verified:
                continue
            run = slide(placed, gain=gain, simulator=simulator, **slide_options)
            run.save(folder / "trajectories" / f"{key}-{simulator}.h5")
            entry[name] = measures.summary(run)
            reference.setdefault(name, entry[name])
            cost = sum(
                weight * entry[name][m] / reference[name][m]
                for m, weight in (("centroid_travel", 1.0), ("upstream_depth", 0.05))
            )
            entry["cost" if name == "surrogate" else "verified_cost"] = cost
        entries[key] = entry
        if key in ("best", "rank-2"):
            placed.to_toml(folder / "layouts" / f"{key}.toml")
    best_cost = entries["best"]["cost"]
    rng = np.random.default_rng(1)
    with (folder / "trials.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        placed = entries["best"]["layout"]
        axes = ("x", "z")[: len(placed[0])]
        columns = [f"{axis}{k}" for k in range(1, len(placed) + 1) for axis in axes]
        rows.writerow(["number", "origin", "status", "cost", *measures.UNITS, *columns])
        for k in range(trials):
            origin = "baseline" if k < 4 else ("gradient" if k % 3 == 0 else "bayes")
            cost = best_cost + 0.15 * rng.random() * np.exp(-k / trials) + 0.002 * (trials - 1 - k)
            failed = k == 7
            values = [
                v * (1 + 0.1 * (cost - best_cost) + 0.03 * rng.standard_normal())
                for v in entries["best"]["surrogate"].values()
            ]
            rows.writerow(
                [
                    k,
                    origin,
                    "diverged" if failed else "ok",
                    "" if failed else cost,
                    *values,
                    *(c + 0.001 * k for centre in placed for c in centre),
                ]
            )
    summary = {
        "status": "complete" if verified else "interrupted",
        "best": entries["best"],
        "paper_layout": entries["paper"],
        "no_baffles": entries["none"],
        "ranked": [entries[k] for k in named if k not in ("paper", "none")],
        "rollouts": trials,
        "seconds": {"search": 93.4, "verify": 61.0, "total": 158.2},
        "versions": {"gns_model": "0.1.0", "torch": "2.13.0", "optuna": "5.0.0"},
        "settings": {
            "method": "hybrid",
            "baffles": 3,
            "budget": trials,
            "verify": 2,
            "seed": 0,
            "simulator": {"name": "models/<mine> & co", "device": "cpu"},
            "objective": {
                "runout_weight": 1.0,
                "depth_weight": 0.05,
                "text": "centroid travel + 0.05 x upstream depth",
            },
        },
        "notes": ["the scene is 5 % faster than <baffle-lite> was trained for"],
    }
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    scene.to_toml(folder / "scene.toml")
    return folder
