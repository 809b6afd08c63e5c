"""Content of MLflow's runs, as pure functions of the trials' files; independent of MLflow.

The part before the slash is the UI's chart section. Metrics over environment steps:

    train/return, train/cost_0            means over the episodes of an update, training phase
    train/limit_0                         limit in force meanwhile, beside its cost
    perf/episodes                         number of these episodes
    deploy/return, deploy/cost_0, ...     the same, deployment phase
    curriculum/limit_0, curriculum/noise  output of the curriculum; entropy_coefficient, if any
    agent/<name>                          metrics of the agent: kl, entropy, multiplier_0, ...
    perf/steps_per_second                 environment steps per CPU second

Metrics with one value are at step 0. The UI draws bars if the last step of a metric is 0 in all runs, else a
line, which would be a single dot:

    final/return, final/cost_0, final/limit_0    the final policy as in the report (``final_outcomes``): exact
                                          where the task is finite
    summary/deploy_return, ..._cost_0     mean over the episodes of the deployment phase
    evaluation/<policy>_return, ..._cost_0    mean over the final evaluation's episodes

MLflow stores an infinite value as 1.8e308 and draws it. So values that are not finite (an infinite limit, the
mean of no episodes) are left out, and the chart has no point there.

A trial of many updates is thinned to about ``POINTS_PER_METRIC`` points per metric, because the database
takes CPU time from training. The selection depends only on the number of updates, not on the times of passes.
So a rebuild from the files gives the same points.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice

import pandas as pd

from recrl.environments.cmdp import Phase
from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.trial_files import UPDATE_COLUMNS
from recrl.orchestrator.spec import TrialSpec

POINTS_PER_METRIC = 100
MAX_PARAMS = 100  # in one request
MAX_NOTE = 7_500  # characters; MLflow takes 8,000 in a tag

GROUP_TAG = "recrl.group"

Row = Mapping[str, str]


@dataclass(frozen=True)
class Point:
    """One value of one metric.

    Attributes:
        key: the metric's name.
        value: finite.
        milliseconds: wall time of the update, since 1970, from its row, so that a repeated point is
            identical.
        step: environment steps; 0 for a metric with one value.
    """

    key: str
    value: float
    milliseconds: int
    step: int


def rows_after(data: bytes, offset: int) -> Iterator[tuple[int, Row]]:
    """Yield the rows of a CSV file after an offset.

    Args:
        data: the file's committed bytes; whole lines, the first one with the columns.
        offset: end of a row, or 0 for all rows.

    Yields:
        The offset after the row, and the row.
    """
    header, _, _ = data.partition(b"\n")
    columns = header.decode().split(",")
    end = max(offset, len(header) + 1)
    for line in data[end:].splitlines(keepends=True):
        end += len(line)
        yield end, dict(zip(columns, line.decode().rstrip("\n").split(","), strict=True))


def thinned(rows: Iterable[tuple[int, Row]], num_updates: int) -> Iterator[tuple[int, Row]]:
    """Select rows: the first, the last, and every n-th between.

    Args:
        rows: rows of ``updates.csv`` with the offset after each; no row before a selected one is missing.
        num_updates: updates of the whole trial, at least 1.

    Yields:
        The selected rows, with their offsets; ``noise`` is the largest since the previous selected row, so
        that short noise is visible.
    """
    stride = -(-num_updates // POINTS_PER_METRIC)
    noise = 0.0
    for end, row in rows:
        update = int(row["update"])
        noise = max(noise, float(row["noise"]))
        if update in (1, num_updates) or update % stride == 0:
            yield end, {**row, "noise": str(noise)}
            noise = 0.0


def points(row: Row, spec: TrialSpec) -> list[Point]:
    """Return the points of one row of ``updates.csv``."""
    section = "train" if row["phase"] == Phase.TRAINING else "deploy"
    values = {
        f"{section}/return": float(row["episode_return"]),
        "perf/episodes": float(row["episodes"]),
        "curriculum/noise": float(row["noise"]),
    }
    cpu_seconds = float(row["collect_seconds"]) + float(row["update_seconds"])
    if cpu_seconds > 0.0:
        values["perf/steps_per_second"] = spec.steps_per_update / cpu_seconds
    for column in row.keys() - set(UPDATE_COLUMNS):
        if re.fullmatch(r"cost_\d+", column):
            values[f"{section}/{column}"] = float(row[column])
        elif re.fullmatch(r"limit_\d+", column):
            values[f"{section}/{column}"] = values[f"curriculum/{column}"] = float(row[column])
        elif column == "entropy_coefficient":
            values[f"curriculum/{column}"] = float(row[column])
        else:
            values[f"agent/{_safe(column)}"] = float(row[column])
    return _points_at(int(row["end_step"]), values, float(row["time"]))


def final_points(updates: pd.DataFrame, evaluation: pd.DataFrame, last_row: Row) -> list[Point]:
    """Return the points of a complete trial's summary and evaluations, as single values.

    Args:
        updates: ``TrialStore.updates()``.
        evaluation: ``TrialStore.evaluation()``.
        last_row: the last row of ``updates.csv``.
    """
    values: dict[str, float] = {}
    deployed = updates[(updates["phase"] == Phase.DEPLOYMENT) & (updates["episodes"] > 0)]
    costs = [column for column in updates.columns if re.fullmatch(r"cost_\d+", column)]
    for column in ("episode_return", *costs):
        name = column.removeprefix("episode_")
        if not deployed.empty:
            total = float((deployed[column] * deployed["episodes"]).sum())
            values[f"summary/deploy_{name}"] = total / int(deployed["episodes"].sum())
        for policy, episodes in evaluation.groupby("policy"):
            values[f"evaluation/{policy}_{name}"] = float(episodes[column].mean())
    return single_values(values, float(last_row["time"]))


def params(spec: TrialSpec) -> dict[str, str]:
    """Return a trial's params for the UI's table: few and flat, for sorting, filtering and grouping.

    Numbers are exact, as in the grid. An infinite training limit d_t is ``auto``: the curriculum measures it.
    """
    choices = {"task": spec.task, "agent": spec.agent, "method": spec.method}
    flat = {name: choice.label for name, choice in choices.items()} | {
        "seed": str(spec.seed),
        "train_limits": ", ".join(map(_limit, spec.train_limits)),
        "deploy_limits": ", ".join(map(_limit, spec.deploy_limits)),
        "total_steps": str(spec.total_steps),
        "train_steps": str(spec.train_steps),
        "deploy_steps": str(spec.deploy_steps),
        "num_envs": str(spec.num_envs),
        "rollout_steps": str(spec.rollout_steps),
        "evaluation_episodes": str(spec.evaluation_episodes),
    }
    for name, choice in choices.items():
        for key, value in choice.options.items():
            flat[_safe(f"{name}.{key}")] = value if isinstance(value, str) else json.dumps(value)
    return dict(islice(flat.items(), MAX_PARAMS))


def group_tag(spec: TrialSpec, *, is_in_grid: bool) -> str:
    """Return a run's group in the charts, which average the runs of a group.

    Args:
        spec: the trial.
        is_in_grid: whether it is one of the last launch's grid. The labels of others may have meant other
            settings, so they are not averaged with it.
    """
    group = f"{spec.method.label}, {spec.agent.label}, {spec.task.label}"
    return group if is_in_grid else f"{group}, no longer in the grid"


def report_page(experiment_id: str, run_id: str) -> str:
    """Return the address of the report among a run's artifacts, after the ``#`` of the UI's address."""
    return f"/experiments/{experiment_id}/runs/{run_id}/artifacts/figures/report.html"


def note(name: str, counts: Mapping[str, int], *, charts: str, report: str, report_text: str) -> str:
    """Return the sweep's note in Markdown: progress, links, and the first part of the report.

    Args:
        name: the sweep.
        counts: number of trials by status: complete, running, ...
        charts: address of the page of charts.
        report: address of the report.
        report_text: the report as Markdown; empty if none has been drawn of these results. Its first part,
            before any section, has the answers and the verdicts.
    """
    total = sum(counts.values())
    states = ", ".join(f"{count} {state}" for state, count in counts.items() if count) or "none yet"
    lines = [f"**{name}**: {counted(total, 'trial')} ({states}). [Charts, seeds averaged]({charts})."]
    if report_text:
        lines.append(f"[Report]({report}); its figures are artifacts of this run.")
    else:
        lines.append(f"No report of these results yet: `recrl-sweep figures {name}` draws it.")
    opening = report_text.split("\n## ", 1)[0].splitlines()[1:]  # without the title
    for line in opening:
        if sum(map(len, lines)) + len(lines) + len(line) > MAX_NOTE:
            lines += ["", "More than fits here: see the report."]
            break
        lines.append(line)
    return "\n".join(lines)


def single_values(values: Mapping[str, float], seconds: float) -> list[Point]:
    """Return the finite values as points at step 0, so that the UI draws bars.

    Args:
        values: by the names of their metrics, each once in a trial.
        seconds: the time of the points. Of several points at one step MLflow shows the one with the latest
            time, so a value that is sent again needs a later one.
    """
    return _points_at(0, values, seconds)


def _points_at(step: int, values: Mapping[str, float], seconds: float) -> list[Point]:
    """Return the finite values as points at a step and a time."""
    milliseconds = round(seconds * 1000)
    return [
        Point(key, value, milliseconds, step) for key, value in sorted(values.items()) if math.isfinite(value)
    ]


def _safe(name: str) -> str:
    """Return a name with only the characters that MLflow accepts."""
    return re.sub(r"[^A-Za-z0-9_. -]", "_", name)[:200]


def _limit(limit: float) -> str:
    """Return a limit as in a grid, with all its digits: ``0.1234567``, ``25``, ``auto``."""
    return repr(limit).removesuffix(".0") if math.isfinite(limit) else "auto"
