"""A random agent places three baffles in the paper's flume, through the Gymnasium env alone.

    python examples/random_agent.py                                    # the shipped model
    python examples/random_agent.py --simulator mpm --spacing 0.0625   # the solver, coarse, fast

It ends in a check of its own result: rewards add up to the cost saved, and baffles hold mass back.
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np

import gns_env  # noqa: F401 (registers the env)
from gns_model import load_simulator

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--simulator", default="baffle-lite", help="mpm, a shipped model or a path")
parser.add_argument("--spacing", type=float, help="of the points of mpm [m]; coarser is faster")
parser.add_argument("--episodes", type=int, default=5)
parser.add_argument("--seed", type=int, default=0)


def main() -> None:
    arguments = parser.parse_args()
    options = {} if arguments.spacing is None else {"spacing": arguments.spacing}
    simulator = load_simulator(arguments.simulator, **options)
    env = gymnasium.make("GranularBaffle-v0", simulator=simulator)
    env.action_space.seed(arguments.seed)
    best_cost, best_centres, kept = np.inf, (), np.inf

    for episode in range(arguments.episodes):
        _, info = env.reset(seed=arguments.seed)
        nothing, rewards, over = info["cost"], 0.0, False
        while not over:
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            rewards += reward
            over = terminated or truncated
        assert np.isclose(rewards, nothing - info["cost"]), "rewards must add up to the cost saved"
        places = ", ".join(f"({x:.2f}, {z:.2f})" for x, z in info["centres"])
        print(f"episode {episode}: cost {nothing:.3f} -> {info['cost']:.3f}, baffles at {places}")
        if info["cost"] < best_cost and not info["diverged"]:
            best_cost, best_centres = info["cost"], info["centres"]
            kept = info["measures"]["centroid_travel"]

    task = env.unwrapped.task
    free = task.reference["centroid_travel"]
    print(f"best of {arguments.episodes}: centroid travel {kept:.3f} m, {free:.3f} m without")
    assert len(best_centres) == 3, "no episode ended with all its baffles"
    assert task.space.check(best_centres) == [], "the layout cannot be built"
    assert kept < free, "baffles must hold the flow back"
    env.close()


if __name__ == "__main__":
    main()
