"""Three final policies of each trial: the last, the average, and an average of those under its last limits.

    export OMP_NUM_THREADS=1
    python -m tests.benchmarks.average_restart results/velocity/average-restart.yaml \
        --to results/velocity/average-restart.csv

The average that is a trial's final policy does not begin anew when the limits change. Here a second one does,
so that all its policies learnt under d_d; training is the same. The trials of the grid run one after the
other in this process. Those whose rows are in the table already are left out, so an interrupted run goes on
with the next trial. Policies are evaluated as by ``average_or_last.py``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import pandas as pd
import torch

from recrl.agents.agent import FinalPolicy, final_policy
from recrl.agents.learning.actor_critic import ActorCritic
from recrl.agents.learning.final_policy import NetworkPolicy, PolicyAverage
from recrl.agents.registry import make_agent
from recrl.analysis.data.labels import KEY
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import Trial, TrialSeeds
from recrl.teachers.registry import make_teacher
from tests.benchmarks.average_or_last import labels_of, value

DECAY = 0.9  # of both averages, the default of policy_average


def final_policies(spec: TrialSpec, folder: Path) -> dict[str, FinalPolicy]:
    """Train, and return the three policies by name."""
    trial = Trial(spec, TrialStore(folder).begin(spec), make_teacher(spec.teacher))
    agent = trial._agent
    spare = make_agent(spec.agent.name, trial._cmdp, spec.agent.options, TrialSeeds.of(spec).agent)
    assert isinstance(agent, ActorCritic)
    assert isinstance(spare, ActorCritic)
    assert agent._config.policy_average == DECAY
    restarted, limits = PolicyAverage(spare._network, DECAY), trial._step.limits
    while not trial.learned:
        if trial._step.limits != limits:
            restarted, limits = PolicyAverage(spare._network, DECAY), trial._step.limits
        trial.advance()
        restarted.add(agent._network.parameters.to_numpy(), agent._encoder.statistics)
    trial.close()
    encoder = agent._encoder.with_statistics(restarted.statistics)
    return {
        "last": agent,
        "average": final_policy(agent),
        "restarted": NetworkPolicy(encoder, restarted.network()),
    }


def rows_of(spec: TrialSpec) -> pd.DataFrame:
    """Train and evaluate; a row a policy."""
    with tempfile.TemporaryDirectory() as folder:
        policies = final_policies(spec, Path(folder) / spec.trial_id)
        values = [
            {**labels_of(spec), "policy": name, **value(it, spec, None)} for name, it in policies.items()
        ]
    return pd.DataFrame(values).round(4)


def main() -> None:
    """Run the trials that are missing, and add their rows to the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("grid", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = pd.read_csv(arguments.to) if arguments.to.exists() else pd.DataFrame()
    done = set() if table.empty else set(table[list(KEY)].itertuples(index=False, name=None))
    for spec in read_grid(arguments.grid).trials():
        if (spec.task.label, spec.agent.label, spec.method.label, spec.seed) not in done:
            table = pd.concat([table, rows_of(spec)], ignore_index=True)
            table.to_csv(arguments.to, index=False, lineterminator="\n")
            print(table.tail(3).to_string(header=False), flush=True)


if __name__ == "__main__":
    main()
