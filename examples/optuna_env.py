"""An Optuna study through the env alone: a batch of layouts is asked for, stepped and told.

    python examples/optuna_env.py                                     # the shipped model
    python examples/optuna_env.py --simulator mpm --spacing 0.0625    # the solver, coarse and fast

`gns-design` does this and more; here stands what any optimiser needs of the env. It ends in a check
of its own result: the best layout can be built, and beats the best of the first, random batch.
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import optuna

import gns_env  # noqa: F401 (registers the env)
from gns_model import load_simulator

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--simulator", default="baffle-lite", help="mpm, a shipped model or a path")
parser.add_argument("--spacing", type=float, help="of the points of mpm [m]; coarser is faster")
parser.add_argument("--rollouts", type=int, default=48)
parser.add_argument("--batch", type=int, default=8)
parser.add_argument("--seed", type=int, default=0)


def main() -> None:
    arguments = parser.parse_args()
    options = {} if arguments.spacing is None else {"spacing": arguments.spacing}
    envs = gymnasium.make_vec(
        "GranularBaffle-v0",
        num_envs=arguments.batch,
        simulator=load_simulator(arguments.simulator, **options),
        placement="joint",
    )
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(
        seed=arguments.seed, n_startup_trials=arguments.batch, multivariate=True, constant_liar=True
    )
    study = optuna.create_study(sampler=sampler)
    envs.reset(seed=arguments.seed)
    numbers = range(envs.single_action_space.shape[0])
    while len(study.trials) < arguments.rollouts:
        trials = [study.ask() for _ in range(arguments.batch)]
        wishes = [[trial.suggest_float(f"a{k}", -1, 1) for k in numbers] for trial in trials]
        infos = envs.step(np.array(wishes, np.float32))[-1]
        for trial, cost, centres in zip(trials, infos["cost"], infos["centres"], strict=True):
            trial.set_user_attr("centres", centres)
            study.tell(trial, float(cost))
        print(f"{len(study.trials)} rollouts: cost {study.best_value:.3f}")
        envs.reset()  # every episode is one step long

    best = study.best_trial.user_attrs["centres"]
    print("best layout:", ", ".join(f"({x:.2f}, {z:.2f})" for x, z in best))
    first = min(trial.value for trial in study.trials[: arguments.batch])
    assert envs.unwrapped.episodes[0].task.space.check(best) == [], "the layout cannot be built"
    assert study.best_value < first, "the study is no better than its first, random batch"
    envs.close()


if __name__ == "__main__":
    main()
