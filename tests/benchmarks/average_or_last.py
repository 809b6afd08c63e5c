"""The last policy of each complete trial beside the average that is its final policy; training is the same.

Finite tasks: exact return and cost. Others: fresh episodes, the same seeds for both.

python tests/benchmarks/average_or_last.py runs/safety-gym-agents --to results/safety-gym/average-or-last.csv
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from recrl.agents.agent import FinalPolicy, final_policy
from recrl.agents.evaluation import PolicyKind
from recrl.agents.learning.actor_critic import ActorCritic
from recrl.agents.registry import make_agent
from recrl.environments.finite.exact_solver import evaluate_policy
from recrl.environments.finite.finite_cmdp import FiniteVectorEnv
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import TrialSeeds, evaluation_rows, policy_table


def policies(trial: TrialStore) -> Iterator[tuple[str, FinalPolicy]]:
    """The last and the averaged policy of a trial; nothing where it is not complete."""
    spec, checkpoint = trial.spec, trial.latest_checkpoint()
    if checkpoint is None or checkpoint["trial"]["update"] < spec.num_updates:
        return
    cmdp = make_vector(spec.task.name, 1, options=spec.task.options).cmdp
    agent = make_agent(spec.agent.name, cmdp, spec.agent.options, TrialSeeds.of(spec).agent)
    assert isinstance(agent, ActorCritic)
    agent.load_state_dict(checkpoint["trial"]["agent"])
    yield "last", agent
    yield "average", final_policy(agent)


def value(policy: FinalPolicy, spec: TrialSpec, episodes: int | None) -> dict[str, float]:
    """Return and first cost of the stochastic policy, with their standard errors; exact ones have none."""
    environments = make_vector(spec.task.name, 1, options=spec.task.options)
    if probabilities := policy_table(policy, environments):
        assert isinstance(environments, FiniteVectorEnv)
        exact = evaluate_policy(environments.finite_cmdp(), pd.DataFrame(probabilities).to_numpy())
        return {"return": exact.episode_return, "cost": float(exact.costs[0])}
    rows = evaluation_rows(
        policy,
        spec,
        [PolicyKind.STOCHASTIC],
        num_episodes=episodes or spec.evaluation_episodes,
        seed=TrialSeeds.of(spec).evaluation,
    )
    table = pd.DataFrame(rows)[["episode_return", "cost_0"]]
    means, errors = table.mean(), table.sem()
    return {
        "return": means["episode_return"],
        "return_se": errors["episode_return"],
        "cost": means["cost_0"],
        "cost_se": errors["cost_0"],
    }


def labels_of(spec: TrialSpec) -> dict[str, Any]:
    """The first columns of the rows of a trial."""
    return {
        "task": spec.task.label,
        "agent": spec.agent.label,
        "method": spec.method.label,
        "seed": spec.seed,
        "limit": spec.deploy_limits.array[0],
    }


def compared(sweep: Path, episodes: int | None = None) -> pd.DataFrame:
    """A row a trial and policy."""
    rows: list[dict[str, Any]] = []
    for trial in SweepStore(sweep.parent, sweep.name).trials():
        spec = trial.spec
        rows += [
            {**labels_of(spec), "policy": name, **value(each, spec, episodes)}
            for name, each in policies(trial)
        ]
    return pd.DataFrame(rows).round(4)


def main() -> None:
    """Read, print a summary, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument(
        "--episodes", type=int, help="episodes a policy; as many as the sweep's trials without it"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = compared(arguments.sweep, arguments.episodes)
    table.to_csv(arguments.to, index=False, lineterminator="\n")
    table["relative_error"] = np.abs(table["cost"] / table["limit"] - 1.0)
    keys = ["task", "agent", "method", "policy"]
    print(table.groupby(keys)[["return", "cost", "relative_error"]].agg(["mean", "std"]).round(3).to_string())


if __name__ == "__main__":
    main()
