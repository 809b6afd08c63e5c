"""What a policy update costs, beside the arithmetic that it cannot do without: CPU time, one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_update.py [--samples 30000] [--agents ppo-lag cpo ...]

First on RiverGrid, where a rollout of 200 steps of 16 environments holds a few hundred distinct observations:
the aim is at most 60 ms to collect it and learn from it. Then on a batch of distinct observations of 72
numbers with 2 continuous actions, networks of 256 x 256 units, under both presets: ``recommended`` is to
take at most a fifth of ``paper``'s time, and ``paper`` at most 1.3 times its bound.

The bound is the time of the matrix products of the networks alone, at a rate measured meanwhile: once that of
products of the networks' own shapes into memory that is there already (``bare``), once the rate that this
machine reaches on a product of two 1024 x 1024 matrices, just before and after (``square``). Products that
the algorithm asks for are counted, by hand: not those that an implementation may do besides.

A machine's rate changes by a third from second to second, with its neighbours and its clock. So an update is
interrupted at each of its steps of Adam by the bare products of one pass, whose time is not counted as its
own; and the passes that ``paper`` consists of are measured once more by themselves, in turn with bare ones.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from gymnasium.spaces import Box

from recrl.agents.agent import Rollout
from recrl.agents.building_blocks.critics import Critics
from recrl.agents.building_blocks.learning_batch import find_repeated
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.networks.architecture import NetworkArchitecture, xavier
from recrl.agents.networks.flat_parameters import Adam
from recrl.agents.registry import AGENTS, agent_config, make_agent
from recrl.agents.shared_options import ActorCriticConfig, AscentConfig, TrustRegionConfig
from recrl.environments.cmdp import CMDPSpec, CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

NUM_ENVS, NUM_STEPS, UPDATES = 16, 200, 30
STEP = CurriculumStep(CostLimits((5.0,)))
OPTIONS: list[dict[str, Any]] = [{}, {"compaction": False}]
NUM_OBSERVATIONS, NUM_ACTIONS = 72, 2
LARGE_STEP, EPISODE_STEPS = CurriculumStep(CostLimits((25.0,))), 1000
HIDDEN = (256, 256)
# The policy is evaluated before and after its improvement, the critics before theirs.
EVALUATIONS = 2


def milliseconds(work: Callable[[], object]) -> float:
    """The CPU time of one call, in milliseconds."""
    before = time.thread_time()
    work()
    return (time.thread_time() - before) * 1e3


def measure(agent_name: str, options: dict[str, Any]) -> tuple[list[float], list[float], float, int]:
    """Collecting and updating, each a list of milliseconds; mean policy steps; most distinct rows."""
    environments = make_vector("rivergrid-1a", NUM_ENVS)
    agent = make_agent(agent_name, environments.cmdp, options, np.random.SeedSequence(0))
    collector = Collector(environments, num_steps=NUM_STEPS)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    collecting, updating, steps, rows = [], [], [], 0
    for _ in range(UPDATES):
        before = time.thread_time()
        rollout, episodes = collector.collect(agent, generator)
        middle = time.thread_time()
        metrics = agent.update(rollout, episode_costs(episodes, 1), STEP)
        collecting.append((middle - before) * 1e3)
        updating.append((time.thread_time() - middle) * 1e3)
        steps.append(metrics["policy_steps"])
        found = find_repeated(rollout.observations.reshape(NUM_ENVS * NUM_STEPS, -1))
        rows = max(rows, NUM_ENVS * NUM_STEPS if found is None else len(found[0]))
    return collecting, updating, float(np.mean(steps)), rows


def flops_a_millisecond() -> float:
    """Floating-point operations a millisecond in a product of two 1024 x 1024 matrices."""
    matrix = torch.ones(1024, 1024)
    return 2.0 * 1024**3 / float(np.median([milliseconds(lambda: matrix @ matrix) for _ in range(15)]))


def bare_pass(rows: int) -> Callable[[], object]:
    """The products of one pass of a critic, and nothing else."""
    sizes = (NUM_OBSERVATIONS, *HIDDEN, 1)
    layers = [torch.ones(1, rows, size) for size in sizes]
    weights = [torch.ones(1, inputs, outputs) for inputs, outputs in pairwise(sizes)]
    gradients = [torch.empty_like(weight) for weight in weights]

    def products() -> None:
        for layer, weight in enumerate(weights):
            torch.bmm(layers[layer], weight, out=layers[layer + 1])
        for layer in range(len(weights) - 1, -1, -1):
            torch.bmm(layers[layer].transpose(1, 2), layers[layer + 1], out=gradients[layer])
            if layer > 0:
                torch.bmm(layers[layer + 1], weights[layer].transpose(1, 2), out=layers[layer])

    for layer in layers:
        layer.zero_()
    return products


def forward_flops(rows: float, sizes: tuple[int, ...]) -> float:
    """Of one evaluation of a network: a product a layer."""
    return sum(2.0 * rows * inputs * outputs for inputs, outputs in pairwise(sizes))


def backward_flops(rows: float, sizes: tuple[int, ...]) -> float:
    """Of one gradient: two products a layer, but the inputs need none."""
    return 2.0 * forward_flops(rows, sizes) - forward_flops(rows, sizes[:2])


def pass_flops(rows: float, sizes: tuple[int, ...]) -> float:
    """Of one evaluation and its gradient."""
    return forward_flops(rows, sizes) + backward_flops(rows, sizes)


def update_flops(config: ActorCriticConfig, metrics: dict[str, float], samples: int) -> float:
    """Of all products that one update with two critics asks for."""
    critic = (NUM_OBSERVATIONS, *config.hidden_sizes, 1)
    policy = (NUM_OBSERVATIONS, *config.hidden_sizes, NUM_ACTIONS)
    rows = min(config.minibatch_size or samples, samples)
    steps = max(config.critic_steps, config.critic_passes * -(-samples // rows))
    flops = 2.0 * (forward_flops(samples, critic) + pass_flops(steps * rows, critic))
    flops += EVALUATIONS * forward_flops(samples, policy)
    if isinstance(config, AscentConfig):
        return flops + pass_flops(metrics["policy_steps"] * rows, policy)
    assert isinstance(config, TrustRegionConfig)
    directions = 2 if "case" in metrics else 1
    products = directions * (config.conjugate_gradient_steps + 1)
    seen = min(config.metric_samples or samples, samples)
    flops += pass_flops(samples, policy) + (directions - 1) * backward_flops(samples, policy)
    # Along a change of the parameters, a product asks for what a gradient asks for.
    flops += forward_flops(seen, policy) + products * 2.0 * backward_flops(seen, policy)
    return flops + (metrics["line_search_steps"] + 1.0) * forward_flops(samples, policy)


def distinct_rollout(samples: int, generator: np.random.Generator) -> Rollout:
    """Noise that looks like a rollout of 1,000-step episodes: no observation comes twice."""
    shape = (EPISODE_STEPS, samples // EPISODE_STEPS)
    observations = generator.normal(size=(*shape, NUM_OBSERVATIONS)).astype(np.float32)
    truncated = np.zeros(shape, np.bool_)
    truncated[-1] = True
    return Rollout(
        observations=observations,
        actions=generator.normal(0.0, 0.6, size=(*shape, NUM_ACTIONS)).astype(np.float32),
        rewards=observations[..., 0] + generator.normal(size=shape),
        costs=(observations[..., 1:2] > 1.5).astype(np.float64),
        terminated=np.zeros(shape, np.bool_),
        truncated=truncated,
        final_observations=observations[-1],
        last_observations=observations[0],
        carried_costs=np.zeros((shape[1], 1)),
        carried_lengths=np.zeros(shape[1], np.int64),
    )


def measure_large(agent_name: str, preset: str, samples: int) -> tuple[float, float, float, float]:
    """Seconds of one update, those of its bounds, bare and square, and the policy steps it took."""
    options = {"preset": preset, "hidden_sizes": list(HIDDEN)}
    config = agent_config(agent_name, options)
    assert isinstance(config, ActorCriticConfig)
    box = Box(-np.inf, np.inf, (NUM_OBSERVATIONS,), np.float32)
    cmdp = CMDPSpec("noise", box, Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32), ("cost",), EPISODE_STEPS)
    agent = make_agent(agent_name, cmdp, options, np.random.SeedSequence(0))
    rollout = distinct_rollout(samples, np.random.default_rng(0))
    metrics: dict[str, float] = {}
    costs = rollout.costs.sum(axis=0)
    rows = min(config.minibatch_size or samples, samples)
    products, step = bare_pass(rows), Adam.step
    products()
    turns: list[float] = []

    def step_and_pause(optimiser: Adam) -> None:
        step(optimiser)
        turns.append(milliseconds(products))

    square_rates = [flops_a_millisecond()]
    with patch.object(Adam, "step", step_and_pause):
        spent = milliseconds(lambda: metrics.update(agent.update(rollout, costs, LARGE_STEP))) - sum(turns)
    square_rates.append(flops_a_millisecond())
    bare_rate = pass_flops(rows, (NUM_OBSERVATIONS, *HIDDEN, 1)) / float(np.mean(turns))
    flops = update_flops(config, metrics, samples) / 1e3
    return spent / 1e3, flops / bare_rate, flops / float(np.mean(square_rates)), metrics["policy_steps"]


def passes_in_turn(samples: int, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of passes over all samples: of two critics, of a policy, and of what bounds them."""
    generator = torch.Generator().manual_seed(0)
    form = NetworkArchitecture(HIDDEN, xavier)
    critics = Critics(NUM_OBSERVATIONS, 1, form, generator)
    actions = Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)
    policy = make_policy(NUM_OBSERVATIONS, actions, form, 1.0, generator)
    rows = torch.randn(samples, NUM_OBSERVATIONS, generator=generator)
    targets = torch.randn(2, samples, generator=generator)
    shares = torch.full((samples,), 1.0 / samples)
    critics_optimiser, policy_optimiser = Adam(critics.parameters, 1e-3), Adam(policy.parameters, 3e-4)
    chosen = torch.randn(samples, NUM_ACTIONS, generator=generator)
    old_log_probs = policy.distribution(rows).log_prob(chosen, None)

    def fit() -> None:
        critics.differentiate(rows, shares, targets)
        critics_optimiser.step()

    def climb() -> None:
        now = policy.evaluate(rows)
        ratios = torch.exp(now.distribution.log_prob(chosen, None) - old_log_probs)
        now.gradient(-torch.dot(ratios.clamp(0.8, 1.2), shares))
        policy_optimiser.step()

    bare = bare_pass(samples)
    works: dict[str, Callable[[], object]] = {
        "bare": bare,
        "two critics": fit,
        "bare again": bare,
        "policy": climb,
    }
    spent: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            milliseconds_taken = milliseconds(work)
            if turn > 0:
                spent[name].append(milliseconds_taken)
    return spent


def print_passes(samples: int, rounds: int) -> None:
    """The table of passes over all samples, each beside the bare products of as many networks."""
    spent = passes_in_turn(samples, rounds)
    bare = np.array([spent["bare"], spent["bare again"]])
    print(f"\n{samples:,} rows, {HIDDEN[0]} x {HIDDEN[1]}, a pass with its step of Adam, {rounds} rounds")
    print(
        f"{'pass':<14}{'median ms':>10}{'bare ms':>9}{'times':>7}{'least ms':>10}{'bare ms':>9}{'times':>7}"
    )
    for name, networks in (("two critics", 2), ("policy", 1)):
        median, least = np.median(spent[name]), np.min(spent[name])
        bounds = networks * np.median(bare), networks * np.min(bare)
        print(
            f"{name:<14}{median:>10.0f}{bounds[0]:>9.0f}{median / bounds[0]:>7.2f}"
            f"{least:>10.0f}{bounds[1]:>9.0f}{least / bounds[1]:>7.2f}",
            flush=True,
        )


def print_rivergrid() -> None:
    """The table of small batches with repeated observations."""
    rate = flops_a_millisecond()
    print(
        f"{'agent':<10}{'options':<24}{'collect ms':>12}{'update ms':>12}{'policy steps':>14}{'bound ms':>10}"
    )
    for agent_name in ("ppo-lag", "cpo"):
        for options in OPTIONS:
            collecting, updating, policy_steps, rows = measure(agent_name, options)
            used = NUM_ENVS * NUM_STEPS if options else rows
            critic_sweeps, sweeps_a_direction = 40 * 2, 11 * 2
            policy_sweeps = policy_steps if agent_name == "ppo-lag" else sweeps_a_direction
            flops = critic_sweeps * pass_flops(used, (22, 64, 64, 1))
            flops += policy_sweeps * pass_flops(used, (22, 64, 64, 3))
            print(
                f"{agent_name:<10}{options or '(recommended)'!s:<24}{np.median(collecting):>12.1f}"
                f"{np.median(updating):>12.1f}{policy_steps:>14.1f}{flops / rate:>10.1f}"
            )


def print_large(agents: list[str], samples: int) -> None:
    """The table of one large batch of distinct observations, under both presets."""
    print(
        f"\n{samples:,} distinct observations, {HIDDEN[0]} x {HIDDEN[1]}\n{'agent':<10}{'preset':<14}"
        f"{'update s':>10}{'bare s':>9}{'times':>7}{'square s':>10}{'times':>7}{'policy steps':>14}"
        f"{'of paper':>10}"
    )
    for agent_name in agents:
        paper = 0.0
        for preset in ("paper", "recommended"):
            spent, bare, square, steps = measure_large(agent_name, preset, samples)
            paper = paper or spent
            print(
                f"{agent_name:<10}{preset:<14}{spent:>10.2f}{bare:>9.2f}{spent / bare:>7.2f}{square:>10.2f}"
                f"{spent / square:>7.2f}{steps:>14.0f}{spent / paper:>10.3f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=30_000, help="a multiple of 1,000")
    parser.add_argument("--agents", nargs="+", default=["ppo-lag", "cpo"], choices=list(AGENTS))
    parser.add_argument("--rounds", type=int, default=15, help="turns of the passes beside the bare products")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print_rivergrid()
    print_passes(arguments.samples, arguments.rounds)
    print_large(arguments.agents, arguments.samples)


if __name__ == "__main__":
    main()
