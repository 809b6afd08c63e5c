"""What MLflow shows of a sweep, as pure functions of the trials' files; nothing here knows MLflow.

Metrics are drawn against environment steps and sorted into the UI's chart sections by their first word:

    train/return, train/cost_0            means over the episodes of an update, training phase
    train/episodes                        how many those are
    deploy/return, deploy/cost_0, ...     the same, deployment phase
    curriculum/limit_0, curriculum/noise  what the teacher set; curriculum/temperature if it has one
    agent/<name>                        what the agent reported: kl, entropy, multiplier_0, ...
    perf/steps_per_second                 environment steps per CPU second
    summary/deploy_return, ..._cost_0     mean over the episodes of the deployment phase; once, at the end
    evaluation/<policy>_return, ..._cost_0    mean over a frozen policy's episodes; once, at the end

MLflow stores an infinite value as 1.8e308 and draws it: so a value that is not finite (a limit that
constrains nothing, the mean of no episodes) is left out, and the chart has no point there.

A trial of many updates is thinned to about ``POINTS_PER_METRIC`` points a metric, because the database costs
CPU that training wants. Which updates are shown depends on their number alone, never on when the mirror
looked: a view rebuilt from the files equals one that grew with them.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import pandas as pd

from recrl.environments.cmdp import Phase
from recrl.orchestrator.files.trial_tables import UPDATE_COLUMNS
from recrl.orchestrator.spec import TrialSpec

POINTS_PER_METRIC = 100
MAX_PARAMS = 100  # of a request
MAX_NOTE = 7_500  # characters; MLflow takes 8,000 in a tag

VIEW = "recrl"  # key of the prepared chart view

# The UI's own state, in its own words (MLflow 3.17; undocumented, so a link without it must do as well).
VIEW_STATE = {
    "runsHiddenMode": "SHOW_ALL",
    "selectedColumns": [
        *(f"params.`{name}`" for name in ("task", "agent", "method")),
        *(f"metrics.`{name}`" for name in ("summary/deploy_return", "summary/deploy_cost_0")),
    ],
    "compareRunCharts": [],
    "compareRunSections": [
        {
            "uuid": f"recrl-{name}",
            "name": name,
            "display": True,
            "isReordered": False,
            "deleted": False,
            "isGenerated": True,
        }
        for name in ("train", "curriculum", "deploy", "summary", "evaluation", "agent", "perf")
    ],
    "isAccordionReordered": True,
}

Row = Mapping[str, str]


GROUPED = {
    "aggregateFunction": "average",
    "groupByKeys": [{"mode": "tag", "groupByData": "recrl.group"}],
}


def view_state(specs: Iterable[TrialSpec]) -> Mapping[str, Any]:
    """Return the state of the prepared chart view: seeds averaged, where there are several.

    Groups of one run each would only hide the runs' names.

    Args:
        specs: the sweep's trials.
    """
    sizes = Counter(spec.group for spec in specs)
    return {**VIEW_STATE, "groupBy": GROUPED if any(size > 1 for size in sizes.values()) else None}


@dataclass(frozen=True)
class Point:
    """One value of one metric.

    Attributes:
        key: the metric's name.
        value: finite.
        milliseconds: wall time of the update, since 1970; read from its row, so that a point that is sent
            again is the same point.
        step: environment steps.
    """

    key: str
    value: float
    milliseconds: int
    step: int


def rows_after(data: bytes, offset: int) -> Iterator[tuple[int, Row]]:
    """The rows of a CSV file behind a byte.

    Args:
        data: the file's committed bytes; whole lines, the first one names the columns.
        offset: end of a row, or 0 for all rows.

    Yields:
        The byte behind the row, and the row.
    """
    header, _, _ = data.partition(b"\n")
    columns = header.decode().split(",")
    end = max(offset, len(header) + 1)
    for line in data[end:].splitlines(keepends=True):
        end += len(line)
        yield end, dict(zip(columns, line.decode().rstrip("\n").split(","), strict=True))


def thinned(rows: Iterable[tuple[int, Row]], num_updates: int) -> Iterator[tuple[int, Row]]:
    """The rows to show: the first, the last, and every n-th between.

    Args:
        rows: rows of ``updates.csv`` and the byte behind each; none before a shown row is left out.
        num_updates: updates of the whole trial, at least 1.

    Yields:
        The shown rows, with their byte; ``noise`` is the largest since the row shown before, so that a short
        burst of noise is seen.
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
    """The points of one row of ``updates.csv``."""
    section = "train" if row["phase"] == Phase.TRAINING else "deploy"
    values = {
        f"{section}/return": float(row["episode_return"]),
        f"{section}/episodes": float(row["episodes"]),
        "curriculum/noise": float(row["noise"]),
    }
    cpu_seconds = float(row["collect_seconds"]) + float(row["update_seconds"])
    if cpu_seconds > 0.0:
        values["perf/steps_per_second"] = spec.steps_per_update / cpu_seconds
    for column in row.keys() - set(UPDATE_COLUMNS):
        if re.fullmatch(r"cost_\d+", column):
            values[f"{section}/{column}"] = float(row[column])
        elif re.fullmatch(r"limit_\d+|temperature", column):
            values[f"curriculum/{column}"] = float(row[column])
        else:
            values[f"agent/{_safe(column)}"] = float(row[column])
    return _points(values, row)


def final_points(updates: pd.DataFrame, evaluation: pd.DataFrame, last_row: Row) -> list[Point]:
    """The points of a complete trial's summary and evaluations, at its last step.

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
    return _points(values, last_row)


def params(spec: TrialSpec) -> dict[str, str]:
    """Few and flat: what the UI's table is sorted, filtered and grouped by."""
    choices = {"task": spec.task, "agent": spec.agent, "method": spec.method}
    flat = {name: choice.label for name, choice in choices.items()} | {
        "seed": str(spec.seed),
        "train_limits": _numbers(spec.train_limits),
        "deploy_limits": _numbers(spec.deploy_limits),
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


@dataclass(frozen=True)
class Summary:
    """What the note on a sweep says of one complete trial.

    Attributes:
        group: task, agent and method, as people call them.
        values: ``summary/...`` by name.
    """

    group: tuple[str, str, str]
    values: Mapping[str, float]


def charts_page(experiment_id: str) -> str:
    """The UI's page of the sweep's charts, seeds averaged, as it stands behind the ``#`` of its address."""
    page = f"/experiments/{experiment_id}/runs?viewStateShareKey={VIEW}"
    return f"{page}&compareRunsMode=CHART&workflowType=machine_learning"


def note(name: str, counts: Mapping[str, int], complete: Sequence[Summary], *, charts: str) -> str:
    """The sweep's description in Markdown: how far it is, and a line for every group that has an end.

    Args:
        name: the sweep.
        counts: trials by what they are: complete, running, ...
        complete: one for each complete trial.
        charts: address of the page of charts.
    """
    total = sum(counts.values())
    states = ", ".join(f"{count} {state}" for state, count in counts.items() if count) or "none yet"
    lines = [
        f"**{name}**: {total} trials ({states}). [Charts, seeds averaged]({charts}); "
        "the figures are artifacts of this run."
    ]
    names = sorted({value.removeprefix("summary/") for trial in complete for value in trial.values})
    if names:
        heads = ["task", "agent", "method", "seeds", *(value.replace("_", " ") for value in names)]
        lines += ["", "Means over the deployment phase of complete trials:", ""]
        lines += ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for group in sorted({trial.group for trial in complete}):
        trials = [trial.values for trial in complete if trial.group == group]
        means = [
            _mean_text([values[f"summary/{value}"] for values in trials if f"summary/{value}" in values])
            for value in names
        ]
        line = "| " + " | ".join([*group, str(len(trials)), *means]) + " |"
        if sum(map(len, lines)) + len(lines) + len(line) > MAX_NOTE:
            lines += ["", "More groups than fit here: see the table figure."]
            break
        lines.append(line)
    return "\n".join(lines)


def _points(values: Mapping[str, float], row: Row) -> list[Point]:
    milliseconds, step = round(float(row["time"]) * 1000), int(row["end_step"])
    return [
        Point(key, value, milliseconds, step) for key, value in sorted(values.items()) if math.isfinite(value)
    ]


def _safe(name: str) -> str:
    """A name with only the characters that MLflow takes."""
    return re.sub(r"[^A-Za-z0-9_. -]", "_", name)[:200]


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _mean_text(values: Sequence[float]) -> str:
    return f"{sum(values) / len(values):.2f}" if values else ""
