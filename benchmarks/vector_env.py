"""The vector env against single envs one after another: the same layouts, in the same run.

    python benchmarks/vector_env.py                          # baffle-lite, the whole flume
    python benchmarks/vector_env.py --duration 0.2 --envs 4

Every row steps N envs once, all layouts new. The first row is N single envs in turn; the ratio says
how many times as fast the others are. On the CPU that is one batch in this process and one shared
by one-thread worker processes; on a GPU one batch. Results are compared too.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch

import gns_env
from gns_env.episode import flume

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--simulator", default="baffle-lite", help="mpm, a shipped model or a path")
parser.add_argument("--envs", type=int, default=8)
parser.add_argument("--duration", type=float, default=0.9, help="of the flow [s]")
parser.add_argument("--threads", type=int, default=1, help="torch threads in this process")
parser.add_argument("--workers", type=int, default=min(8, os.cpu_count() or 1))


def main() -> None:
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    scene = flume().replace(duration=arguments.duration)
    common: dict[str, Any] = {
        "scene": scene, "simulator": arguments.simulator, "placement": "joint",
    }  # fmt: skip
    n = arguments.envs
    space = gns_env.BaffleTask(scene, "mpm").space
    rng = np.random.default_rng(0)
    layouts = [space.encode(space.random(rng)) * 2 - 1 for _ in range(n)]
    actions = np.array(layouts, np.float32)

    def singles(device: str) -> Callable[[], list[float]]:
        cache = gns_env.RolloutCache()
        make = {**common, "device": device, "cache": cache}
        envs = [gymnasium.make("GranularBaffle-v0", **make) for _ in range(n)]
        for env in envs:
            env.reset(seed=0)
        return lambda: [float(env.step(a)[1]) for env, a in zip(envs, actions, strict=True)]

    def vector(device: str, workers: int = 1) -> Callable[[], list[float]]:
        make = {**common, "device": device, "workers": workers, "cache": gns_env.RolloutCache()}
        envs = gymnasium.make_vec("GranularBaffle-v0", num_envs=n, **make)
        envs.reset(seed=0)
        if workers > 1 or device != "cpu":
            # Processes start and kernels load in a batch that does not count.
            envs.step(-actions)
            envs.reset(seed=0)

        def step() -> list[float]:
            rewards = envs.step(actions)[1].tolist()
            envs.close()
            return rewards

        return step

    devices = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
    for device in devices:
        name = torch.cuda.get_device_name() if device == "cuda" else f"{os.cpu_count()} cores"
        print(
            f"{arguments.simulator} on {device} ({name}), {n} flows of {arguments.duration:g} s, "
            f"{arguments.threads} torch threads in this process, "
            f"load average {os.getloadavg()[0]:.1f} by others and us"
        )
        rows = [("single envs in turn", singles(device)), ("one batch", vector(device))]
        if device == "cpu" and arguments.workers > 1:
            workers = arguments.workers
            rows.append((f"{workers} one-thread workers", vector(device, workers)))
        first: tuple[float, list[float]] | None = None
        for label, step in rows:
            began = time.perf_counter()
            rewards = step()
            seconds = time.perf_counter() - began
            first = first or (seconds, rewards)
            difference = float(np.abs(np.array(rewards) - first[1]).max())
            print(
                f"  {label:24s} {seconds:8.2f} s  {first[0] / seconds:5.2f} times as fast, "
                f"rewards within {difference:.1e}",
                flush=True,
            )
            assert difference < (1e-5 if device == "cpu" else 1e-2), "not the same results"


if __name__ == "__main__":
    main()
