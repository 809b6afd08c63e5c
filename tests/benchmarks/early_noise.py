"""How many noises of ``dynamic`` came before an episode could begin and end under the present limit?

    python tests/benchmarks/early_noise.py results/velocity/curricula.zip

Noise after an update is early if fewer steps of an environment lie between it and the last change of limits
or policy than the mean episode of the trial has. All judged episodes then began before that change.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from recrl.analysis.data import export
from recrl.analysis.data.labels import KEY
from recrl.environments.cmdp import Phase


def early_noises(updates: pd.DataFrame, num_envs: int) -> tuple[int, int]:
    """The number of early noises of one trial, and that of all.

    Args:
        updates: of the trial, in order; ``noise`` and ``limit_0`` are those in force in the update.
        num_envs: of the trial.
    """
    training = updates[updates["phase"] == Phase.TRAINING.value]
    steps = int(training["end_step"].diff().median()) // num_envs
    length = training["end_step"].iloc[-1] / max(1, training["episodes"].sum())
    changed, early, noises = 0, 0, 0
    rows = training[["noise", "limit_0"]].to_numpy().tolist()
    for index, (noise, limit) in enumerate(rows[1:], start=1):
        if noise > 0.0:
            noises += 1
            early += (index - changed) * steps < length
        if noise > 0.0 or limit != rows[index - 1][1]:
            changed = index
    return early, noises


def main() -> None:
    """Print the counts of each file, task and agent."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("exports", nargs="+", type=Path)
    for path in parser.parse_args().exports:
        sweep = export.load(path)
        rows = []
        for spec in (trial.spec for trial in sweep.facts):
            if spec.method.name == "dynamic":
                key = (spec.task.label, spec.agent.label, spec.method.label, spec.seed)
                chosen = sweep.updates
                for name, value in zip(KEY, key, strict=True):
                    chosen = chosen[chosen[name] == value]
                if len(chosen):
                    rows.append((*key[:2], *early_noises(chosen, spec.num_envs)))
        counts = pd.DataFrame(rows, columns=["task", "agent", "early", "noises"])
        print(f"{path}: {counts['early'].sum()} of {counts['noises'].sum()} noises are early")
        print(counts.groupby(["task", "agent"]).sum().to_string(), end="\n\n")


if __name__ == "__main__":
    main()
