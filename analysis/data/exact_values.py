"""Exact values of the final policies of finite tasks, computed from their tables instead of sampled.

The recorded table pi(a | s) is the stochastic policy. The deterministic one takes its most probable action.
"""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import KEY, listed
from recrl.environments.cmdp import Floats
from recrl.environments.finite.exact_solver import evaluate_policy
from recrl.environments.finite.finite_cmdp import FiniteCMDP, FiniteVectorEnv
from recrl.environments.registry import find_task, make_vector, task_options
from recrl.orchestrator.errors import USERS_ERRORS

logger = logging.getLogger("recrl.sweep_data")

STOCHASTIC, DETERMINISTIC = "stochastic", "deterministic"
MISFIT = "policy tables that do not fit their task, so that the values are sampled"
NAMED = 3  # largest number of trials in a note


def exact_values(policies: pd.DataFrame, models: Mapping[str, FiniteCMDP | None]) -> pd.DataFrame:
    """Evaluate every final policy that has a table and a model: one row per trial and policy.

    Args:
        policies: of a ``Sweep``.
        models: of each task, by its label; None if the task is not finite or cannot be built here.

    Returns:
        KEY, policy (STOCHASTIC or DETERMINISTIC), episode_return, cost_i. Tables that do not fit their
        model are left out (``misfit_note``).
    """
    lines = []
    for key, run in policies.groupby(list(KEY), observed=True, sort=False):
        labels = dict(zip(KEY, key, strict=True))
        model = models.get(str(labels["task"]))
        table = None if model is None else policy_table(run, model)
        if model is None or table is None:
            continue
        for policy, probabilities in ((STOCHASTIC, table), (DETERMINISTIC, _greedy(table))):
            value = evaluate_policy(model, probabilities)
            costs = {f"cost_{i}": float(cost) for i, cost in enumerate(value.costs)}
            lines.append({**labels, "policy": policy, "episode_return": value.episode_return, **costs})
    return pd.DataFrame(lines, columns=None if lines else [*KEY, "policy", "episode_return"])


def misfit_note(policies: pd.DataFrame, models: Mapping[str, FiniteCMDP | None]) -> str:
    """Name the trials whose policy table does not fit their task; empty if there are none.

    Args:
        policies: of a ``Sweep``.
        models: as for ``exact_values``.
    """
    titles = []
    for key, run in policies.groupby(list(KEY), observed=True, sort=False):
        labels = dict(zip(KEY, key, strict=True))
        model = models.get(str(labels["task"]))
        if model is not None and policy_table(run, model) is None:
            titles.append("{task} {agent} {method} seed {seed}".format(**labels))
    return f"{MISFIT}: {listed(titles, NAMED)}" if titles else ""


def finite_model(name: str, options: Mapping[str, Any]) -> FiniteCMDP | None:
    """Return the tables of a task with a known optimum, or None.

    Other tasks are not built: they can be slow to build, and few of them are finite. A task that is not
    installed, or whose options this version cannot read, has none: ``optima_of`` makes a note of it.

    Args:
        name: of the task.
        options: of the task.
    """
    try:
        if find_task(name).optimum is None:
            return None
        return _model(name, task_options(name, options).model_dump_json())
    except USERS_ERRORS:
        logger.debug("tables of %s", name, exc_info=True)
        return None


@functools.lru_cache(maxsize=256)
def _model(name: str, canonical: str) -> FiniteCMDP | None:
    environment = make_vector(name, 1, options=json.loads(canonical))
    return environment.finite_cmdp() if isinstance(environment, FiniteVectorEnv) else None


def policy_table(run: pd.DataFrame, model: FiniteCMDP) -> Floats | None:
    """Return pi, [S, A], with rows normalised after rounding; None if it does not fit the model.

    Args:
        run: rows of ``Sweep.policies``, of one trial.
        model: of the task.
    """
    columns = [f"action_{j}" for j in range(model.num_actions)]
    if len(run) != model.num_states or not set(columns) <= set(run):
        return None
    table = run.sort_values("state")[columns].to_numpy(np.float64)
    sums = table.sum(axis=1, keepdims=True)
    fits = bool((table >= 0.0).all() and (np.abs(sums - 1.0) < 1e-3).all())
    return table / sums if fits else None


def _greedy(table: Floats) -> Floats:
    greedy: Floats = np.eye(table.shape[1])[table.argmax(axis=1)]
    return greedy
