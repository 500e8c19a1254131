"""PPO on the vector env, in one file after CleanRL: an agent learns to place three baffles.

    python examples/ppo_vector.py                        # train, verify on the reference solver
    python examples/ppo_vector.py --rollouts 200 --no-verify

It trains on a coarse reference solver (a rollout in 0.1 s). A random agent gets as many rollouts in
the same env, which places baffle by baffle, and keeps its best layout; another places all baffles
at once and so sees as many layouts as rollouts. What they chose and the paper's staggered layout
are then judged on the reference solver at the paper's resolution (half a minute each). It ends in a
check of its own result: the agent beats the staggered layout and the random agent in its own env.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import gns_env
from gns_env.episode import flume
from gns_model.mpm import MpmSimulator

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument(
    "--rollouts", type=int, default=1200, help="of the agent, and of the random one"
)
parser.add_argument("--seed", type=int, nargs="+", default=[0], help="one training for each")
parser.add_argument("--spacing", type=float, default=0.0625, help="of the training solver [m]")
parser.add_argument("--num-envs", type=int, default=8)
parser.add_argument("--num-steps", type=int, default=8, help="of every env between updates")
parser.add_argument("--epochs", type=int, default=10)
parser.add_argument("--learning-rate", type=float, default=2e-3)
parser.add_argument("--clip", type=float, default=0.2)
parser.add_argument("--std", type=float, default=0.6, help="of the first actions")
parser.add_argument("--gae-lambda", type=float, default=0.95)
parser.add_argument("--no-verify", dest="verify", action="store_false")
parser.add_argument("--figure", type=Path, help="write the learning curve here")


def layer(inputs: int, outputs: int, gain: float = 2**0.5) -> nn.Linear:
    linear = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(linear.weight, gain)
    nn.init.zeros_(linear.bias)
    return linear


class Agent(nn.Module):
    """Actor and critic: what the last observation says, to a Gaussian over the next place."""

    def __init__(self, observations: int, actions: int, std: float) -> None:
        super().__init__()

        def network(outputs: int, gain: float) -> nn.Sequential:
            return nn.Sequential(
                *(layer(observations, 64), nn.Tanh(), layer(64, 64), nn.Tanh()),
                layer(64, outputs, gain),
            )

        self.actor, self.critic = network(actions, 0.01), network(1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), float(np.log(std))))

    def policy(self, observation: torch.Tensor) -> Normal:
        return Normal(self.actor(observation), self.log_std.exp())

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        return self.critic(observation).squeeze(-1)


def train(args: argparse.Namespace, seed: int) -> tuple[Agent, list[tuple[int, float]]]:
    """An agent, and the final cost of every episode with the rollouts that were run by then."""
    torch.manual_seed(seed)
    envs = gymnasium.make_vec(
        "GranularBaffle-v0",
        num_envs=args.num_envs,
        simulator=coarse(args),
        observation="flat",
        cache=gns_env.RolloutCache(),  # of its own: no rollouts for free from another training
    )
    task = envs.unwrapped.episodes[0].task
    agent = Agent(
        envs.single_observation_space.shape[0], envs.single_action_space.shape[0], args.std
    )
    networks = [*agent.actor.parameters(), *agent.critic.parameters()]
    rates = (args.learning_rate, 5 * args.learning_rate)  # exploration has to end in time
    optimizer = torch.optim.Adam(
        [{"params": p, "lr": lr} for p, lr in zip((networks, [agent.log_std]), rates, strict=True)],
        eps=1e-5,
    )
    episodes: list[tuple[int, float]] = []
    shape = (args.num_steps, args.num_envs)
    began, last_print = time.time(), 0.0

    observation, _ = envs.reset(seed=seed)
    observation = torch.as_tensor(observation)
    done = torch.zeros(args.num_envs, dtype=torch.bool)
    while task.rollouts < args.rollouts:
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - task.rollouts / args.rollouts)
        observations = torch.zeros((*shape, observation.shape[1]))
        actions = torch.zeros((*shape, envs.single_action_space.shape[0]))
        log_probs, rewards, values = torch.zeros(shape), torch.zeros(shape), torch.zeros(shape)
        real, ends = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape)
        for t in range(args.num_steps):
            with torch.no_grad():
                policy = agent.policy(observation)
                action = policy.sample()
                values[t] = agent.value(observation)
            observations[t], actions[t] = observation, action
            log_probs[t] = policy.log_prob(action).sum(-1)
            real[t] = ~done  # the step after an end begins the next episode: nothing to learn from
            observation, reward, terminated, truncated, info = envs.step(action.numpy())
            observation = torch.as_tensor(observation)
            done = torch.as_tensor(terminated | truncated)
            rewards[t], ends[t] = torch.as_tensor(reward), done.float()
            episodes += [(task.rollouts, float(cost)) for cost in info["cost"][done.numpy()]]

        # Generalised advantage estimation; no reward or advantage crosses an end.
        advantages, following = torch.zeros(shape), torch.zeros(args.num_envs)
        with torch.no_grad():
            next_value = agent.value(observation)
        for t in reversed(range(args.num_steps)):
            goes_on = 1 - ends[t]
            delta = rewards[t] + next_value * goes_on - values[t]
            following = delta + args.gae_lambda * goes_on * following
            advantages[t], next_value = following, values[t]
        returns = advantages + values

        keep = real.flatten()
        x, a = observations.flatten(0, 1)[keep], actions.flatten(0, 1)[keep]
        old, wanted = log_probs.flatten()[keep], returns.flatten()[keep]
        advantage = advantages.flatten()[keep]
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        for _ in range(args.epochs):
            policy = agent.policy(x)
            ratio = (policy.log_prob(a).sum(-1) - old).exp()
            clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
            loss = -torch.min(ratio * advantage, clipped * advantage).mean()
            loss = loss + 0.5 * (agent.value(x) - wanted).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()
        if episodes and time.time() - last_print > 10:
            last_print, recent = time.time(), np.mean([cost for _, cost in episodes[-32:]])
            print(
                f"seed {seed}: {task.rollouts} rollouts, cost {recent:.3f} over the last episodes, "
                f"std {agent.log_std.exp().mean():.2f}, {time.time() - began:.0f} s",
                flush=True,
            )
    envs.close()
    return agent, episodes


def chosen(args: argparse.Namespace, agent: Agent) -> tuple[np.ndarray, float]:
    """The layout that the agent places without exploring, and its cost in training."""
    env = gymnasium.make("GranularBaffle-v0", simulator=coarse(args), observation="flat")
    observation, info = env.reset()
    over = False
    while not over:
        with torch.no_grad():
            action = agent.policy(torch.as_tensor(observation)).mean
        observation, _, terminated, truncated, info = env.step(action.numpy())
        over = terminated or truncated
    env.close()
    return np.array(info["centres"]), info["cost"]


def guess(
    args: argparse.Namespace, seed: int, placement: str
) -> tuple[np.ndarray, list[tuple[int, float]]]:
    """The best layout of a random agent, and the cost of each with the rollouts run by then."""
    envs = gymnasium.make_vec(
        "GranularBaffle-v0",
        num_envs=args.num_envs,
        simulator=coarse(args),
        placement=placement,
        cache=gns_env.RolloutCache(),
    )
    task = envs.unwrapped.episodes[0].task
    envs.reset(seed=seed)
    envs.action_space.seed(seed)
    episodes: list[tuple[int, float]] = []
    best: tuple[float, np.ndarray] = (np.inf, np.zeros(0))
    while task.rollouts < args.rollouts:
        _, _, terminated, _, info = envs.step(envs.action_space.sample())
        for k in np.flatnonzero(terminated):
            episodes.append((task.rollouts, float(info["cost"][k])))
            if episodes[-1][1] < best[0]:
                best = episodes[-1][1], np.array(info["centres"][k])
    envs.close()
    return best[1], episodes


def coarse(args: argparse.Namespace) -> MpmSimulator:
    return MpmSimulator(spacing=args.spacing, frame_interval=0.02)


def learning_curve(
    path: Path,
    curves: list[list[tuple[int, float]]],
    chosen: list[float],
    guesses: list[tuple[int, float]],
    staggered: float,
) -> None:
    """Cost of the episodes against rollouts: the agents, the random agent, the paper's layout."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.0), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    seeds = f" ({len(curves)} seeds)" if len(curves) > 1 else ""
    for k, (episodes, final) in enumerate(zip(curves, chosen, strict=True)):
        at, cost = np.array(episodes).T
        first = k == 0
        axes.plot(at, cost, ".", ms=3, color="#d08b3c", alpha=0.5, mew=0)
        ends = np.unique(at)[1:]  # episodes end together: one mean for each time that they do
        mean = [cost[at <= end][-32:].mean() for end in ends]
        label = f"PPO exploring, mean of 32 episodes{seeds}"
        axes.plot(ends, mean, color="#a5561a", lw=1.8, label=label if first else None)
        label = f"PPO, the layout that it chooses{seeds}"
        axes.plot(
            guesses[-1][0], final, "D", ms=6, color="#a5561a", clip_on=False, zorder=5,
            label=label if first else None,
        )  # fmt: skip
    at, cost = np.array(guesses).T
    label = "random, a layout a rollout: best so far"
    axes.step(at, np.minimum.accumulate(cost), where="post", color="#2f4858", label=label)
    axes.axhline(cost.mean(), color="#2f4858", lw=1, ls=":", label="random, mean")
    axes.axhline(staggered, color="#6d675d", lw=1.2, ls="--", label="the paper's staggered layout")
    axes.set(xlabel="rollouts of the training solver", ylabel="cost (no baffles: 1.5)")
    axes.set(xlim=(0, at[-1]), ylim=(None, 1.52))
    axes.grid(color="#e6e0d5", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8.5, loc="outside upper center", ncols=2)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    print(f"learning curve: {path}")


def main() -> None:
    args = parser.parse_args()
    torch.set_num_threads(1)
    paper = np.array([baffle.center for baffle in flume().baffles])
    training = gns_env.BaffleTask(flume(), coarse(args))
    cost_of = {"the paper's staggered layout": training.evaluate([paper])[0].cost}
    layouts = {"the paper's staggered layout": paper}
    curves = []
    for seed in args.seed:
        agent, episodes = train(args, seed)
        curves.append(episodes)
        layouts[f"PPO, seed {seed}"], cost_of[f"PPO, seed {seed}"] = chosen(args, agent)
    rivals = {}
    for placement in ("sequential", "joint"):
        best, rivals[placement] = guess(args, args.seed[0], placement)
        name = f"best of {len(rivals[placement])} random layouts ({placement})"
        layouts[name], cost_of[name] = best, min(cost for _, cost in rivals[placement])
    if args.figure:
        finals = [cost for name, cost in cost_of.items() if name.startswith("PPO")]
        staggered = cost_of["the paper's staggered layout"]
        learning_curve(args.figure, curves, finals, rivals["joint"], staggered)
    print(f"{args.rollouts} rollouts each; cost where it was trained (no baffles: 1.5):")
    for name, cost in cost_of.items():
        print(f"  {cost:.3f}  {name}")
    if args.verify:
        reference = gns_env.BaffleTask(flume(), "mpm")
        print("on the reference solver at the paper's resolution:", flush=True)
        for name, layout in layouts.items():
            cost_of[name] = reference.evaluate([layout])[0].cost
            places = ", ".join(f"({x:.2f}, {z:.2f})" for x, z in layout)
            print(f"  {cost_of[name]:.3f}  {name}: {places}", flush=True)
        agents = [cost for name, cost in cost_of.items() if name.startswith("PPO")]
        others = [cost for name, cost in cost_of.items() if name.endswith(("layout", "tial)"))]
        assert max(agents) < min(others), "the agent did not beat both"


if __name__ == "__main__":
    main()
