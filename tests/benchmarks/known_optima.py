"""How near every agent comes to the known optimum of tasks under limits that bind.

    OMP_NUM_THREADS=1 python tests/benchmarks/known_optima.py [agent ...] --seeds 50 51 --to rows.csv
    python tests/benchmarks/known_optima.py --table rows.csv

Every option has its default, but for those of ``--options``. A row of the CSV is one training and one of
three policies, by exact expected values of an episode. ``final`` is the policy that a sweep evaluates and
exports, ``last`` the one after the last update. ``mixture`` draws one of the policies of the last quarter of
the updates for each episode. The regret is J*(d) - J, the excess the largest cost above its limit (negative
if all are below).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from recrl.agents.agent import final_policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.finite.exact_solver import evaluate_policy
from recrl.environments.finite.finite_cmdp import FiniteVectorEnv
from recrl.environments.registry import make_vector, optimal_return

AGENTS = ("ppo-lag", "cpo", "trpo-lag", "pcpo", "focops", "p3o", "ipo", "crpo")
POLICIES = ("final", "last", "mixture")
# East along the river: the goal in 3 steps, 2 of them in the river. North: in 6 steps, 2 in the mud. First
# north, then east: in 18 steps, without cost. With both costs limited the optimum takes all three ways.
GATES = """
    ##################
    #G################
    #%################
    #%################
    #..............G##
    #.################
    #>~~G#############
    ##################
    """


@dataclass(frozen=True)
class Task:
    """A finite task, limits that bind in its optimum, and how long an agent learns.

    Args:
        name: in the registry.
        limits: one for each cost.
        num_envs: environments; the mean cost of as many episodes is what an agent sees of the cost.
        num_steps: steps of each environment before an update.
        updates: of the agent.
        options: of the task.
    """

    name: str
    limits: tuple[float, ...]
    num_envs: int
    num_steps: int
    updates: int
    options: Mapping[str, Any] = field(default_factory=dict)


TASKS = {
    "two-state": Task("two-state", (3.0,), 512, 20, 200),
    "two-state-2": Task("two-state-2", (5.0, 2.0), 512, 20, 400),
    "gates": Task("rivergrid", (1.0,), 256, 60, 120, {"map": GATES, "horizon": 60}),
    "gates-2": Task(
        "rivergrid",
        (1.0, 0.5),
        512,
        60,
        300,
        {"map": GATES, "horizon": 60, "costs": ["river", "mud"]},
    ),
}


def train(
    label: str, task: Task, agent_name: str, seed: int, options: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    """Train an agent with some options; yield a row for each policy."""
    limits = CostLimits(task.limits)
    optimum = optimal_return(task.name, task.options, limits)
    start = time.process_time()
    environment_seed, agent_seed, policy_seed = np.random.SeedSequence(seed).spawn(3)
    environments = make_vector(task.name, task.num_envs, options=task.options)
    assert isinstance(environments, FiniteVectorEnv)
    agent = make_agent(agent_name, environments.cmdp, options, agent_seed)
    collector = Collector(environments, num_steps=task.num_steps)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)

    def values(policy: Any) -> np.ndarray[Any, Any]:
        """Expected return and costs of an episode, [1 + k]."""
        exact = evaluate_policy(
            environments.finite_cmdp(), policy.action_probabilities(environments.observations)
        )
        return np.array([exact.episode_return, *exact.costs])

    late = []
    for update in range(task.updates):
        rollout, episodes = collector.collect(agent, generator)
        agent.update(rollout, episode_costs(episodes, len(task.limits)), CurriculumStep(limits))
        if update >= 0.75 * task.updates:
            late.append(values(agent))
    seconds = time.process_time() - start
    for policy, value in zip(
        POLICIES, (values(final_policy(agent)), late[-1], np.mean(late, axis=0)), strict=True
    ):
        yield {
            "agent": agent_name,
            "options": json.dumps(dict(options)),
            "task": label,
            "seed": seed,
            "policy": policy,
            "optimum": optimum,
            "regret": optimum - value[0],
            "excess": np.max(value[1:] - task.limits),
            "updates": task.updates,
            "cpu_seconds": seconds,
        }


def write_trainings(
    tasks: Mapping[str, Task],
    agents: Sequence[str],
    seeds: Sequence[int],
    options: Mapping[str, Any],
    *,
    to: Path | None,
) -> None:
    """Train agents on tasks; print each row, and write all of them to a CSV file."""
    written: list[dict[str, Any]] = []
    for label, task in tasks.items():
        for agent in agents:
            for seed in seeds:
                for row in train(label, task, agent, seed, options):
                    print(
                        "{task} {agent} {seed} {policy}: {regret:.3f} {excess:.3f}".format(**row), flush=True
                    )
                    written.append(row)
                if to:
                    pd.DataFrame(written).to_csv(to, index=False, float_format="%.4g", lineterminator="\n")


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return regret and excess by task, agent, options and policy: "mean (worst)" over the seeds."""
    groups = rows.groupby(["task", "agent", "options", "policy"], sort=False)[["regret", "excess"]]
    means, worst = groups.mean(), groups.max()
    cells = {
        name: [f"{a:.3f} ({b:.3f})" for a, b in zip(means[name], worst[name], strict=True)]
        for name in means.columns
    }
    flat = pd.DataFrame(cells, means.index).reset_index()
    return flat.pivot(index=["task", "agent", "options"], columns="policy", values=["regret", "excess"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and write rows, or print the table of rows."""
    parser = argparse.ArgumentParser(description="How near agents come to known optima under limits.")
    parser.add_argument("agents", nargs="*", metavar="AGENT", help="default: all")
    parser.add_argument("--only", nargs="+", default=list(TASKS), choices=TASKS, metavar="TASK")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument(
        "--options", type=json.loads, default={}, metavar="JSON", help="options of the agents"
    )
    parser.add_argument("--to", type=Path, help="the CSV file that the rows are written to")
    parser.add_argument(
        "--table", nargs="+", type=Path, help="print the table of these CSV files; do not train"
    )
    parsed = parser.parse_args(arguments)
    if parsed.table:
        rows = pd.concat([pd.read_csv(path) for path in parsed.table], ignore_index=True)
        print(table(rows).round(3).to_string())
        return
    torch.set_num_threads(1)
    chosen = {name: TASKS[name] for name in parsed.only}
    write_trainings(chosen, parsed.agents or AGENTS, parsed.seeds, parsed.options, to=parsed.to)


if __name__ == "__main__":
    main()
