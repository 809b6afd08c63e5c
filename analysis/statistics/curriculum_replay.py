"""Limits that another curriculum would have set on the recorded episodes of a run.

A teacher is a pure function of the trial's reports, so it can be called again with a run's files. Every
policy update becomes the ``ProgressReport`` that the trial sent. A run's own teacher gives the run's own
limits, if the teacher has not changed since.

The replay does not predict the agent's results under the other limits: the episodes are still those under the
recorded limits. It shows the effect of a curriculum's options on given episodes, for example of a dynamic
curriculum's window or tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.files.trial_reader import TrialReader
from recrl.orchestrator.spec import Choice
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import AnswerCheck, ProgressReport


def replay(trial: TrialReader, method: Choice) -> pd.DataFrame:
    """Compute a curriculum's limits on a run's recorded episodes: one row per policy update.

    Args:
        trial: the run, finished or not.
        method: the curriculum and its options.

    Returns:
        update, phase, end_step, cost_i, limit_i and noise as recorded, replayed_limit_i and replayed_noise.

    Raises:
        RecrlError: the run has no update yet.
        UnknownNameError: the curriculum is not known.
        pydantic.ValidationError: its options are wrong.
        TypeError, ValueError: it gives limits or a state that a trial would refuse.
    """
    updates = trial.updates()
    if not len(updates):
        raise RecrlError(f"{trial.spec.title}: cannot be replayed, because it has no policy update yet")
    spec = trial.spec
    teacher = make_teacher(replace(spec, method=method).teacher)
    costs = range(len(spec.deploy_limits))
    names = [f"cost {i}" for i in costs]
    check = AnswerCheck(method.label, names, spec.train_limits, spec.deploy_limits)
    step, state = check.checked(teacher.start())
    steps = []
    for report in progress_reports(trial, updates):
        steps.append(step)
        if report.env_steps < spec.train_steps:
            answer = teacher.step(state, report)
            step, state = check.checked(answer, before=step.limits, update=report.update)
        else:
            step = CurriculumStep(spec.deploy_limits)
    recorded = (f"{name}_{i}" for name in ("cost", "limit") for i in costs)
    columns = ["update", "phase", "end_step", *recorded, "noise"]
    limits = {f"replayed_limit_{i}": [each.limits[i] for each in steps] for i in costs}
    return updates[columns].assign(**limits, replayed_noise=[each.policy_noise for each in steps])


def progress_reports(trial: TrialReader, updates: pd.DataFrame) -> Iterator[ProgressReport]:
    """Yield the trial's report to its teacher after each policy update.

    Args:
        trial: the run.
        updates: its committed updates.
    """
    episodes = trial.episodes()
    num_costs = len(trial.spec.deploy_limits)
    ends = np.cumsum(updates["episodes"].to_numpy(np.int64)).tolist()
    starts = [0, *ends[:-1]]
    rows = episodes.to_dict("records") if len(episodes) else []
    for update, end_step, first, last in zip(
        updates["update"], updates["end_step"], starts, ends, strict=True
    ):
        batch = tuple(_episode(row, num_costs, trial.spec.num_envs) for row in rows[first:last])
        yield ProgressReport(update=int(update), env_steps=int(end_step), episodes=batch)


def _episode(row: dict[Any, Any], num_costs: int, num_envs: int) -> EpisodeStats:
    return EpisodeStats(
        index=row["index"],
        phase=Phase(row["phase"]),
        end_step=row["end_step"],
        length=row["length"],
        episode_return=row["episode_return"],
        costs=tuple(row[f"cost_{i}"] for i in range(num_costs)),
        limits=CostLimits(tuple(row[f"limit_{i}"] for i in range(num_costs))),
        noise=row["noise"],
        begin_step=row["end_step"] - row["length"] * num_envs,
    )
