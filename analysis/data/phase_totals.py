"""Totals of a trial's episodes by phase: a few numbers instead of up to 500,000 rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from recrl.environments.cmdp import Phase


def phase_totals(episodes: pd.DataFrame, deploy_limits: Sequence[float]) -> list[dict[str, Any]]:
    """Sum over a trial's episodes, one row per phase with episodes.

    Args:
        episodes: ``TrialReader.episodes()``.
        deploy_limits: d_d, [k].

    Returns:
        phase, episodes, steps, episode_return and its standard deviation over episodes (``_std``, NaN for
        one episode), then for each cost i: cost_i and cost_i_std likewise, cost_i_total, and
        excess_i_total, the sum of max(0, C_i - d_d,i).
    """
    rows = []
    for phase in Phase if len(episodes) else ():
        chosen = episodes[episodes["phase"] == phase.value]
        if not len(chosen):
            continue
        row: dict[str, Any] = {
            "phase": phase.value,
            "episodes": len(chosen),
            "steps": int(chosen["length"].sum()),
            "episode_return": float(chosen["episode_return"].mean()),
            "episode_return_std": float(chosen["episode_return"].std()),
        }
        for i, limit in enumerate(deploy_limits):
            costs = chosen[f"cost_{i}"].to_numpy(np.float64)
            row |= {
                f"cost_{i}": float(costs.mean()),
                f"cost_{i}_std": float(chosen[f"cost_{i}"].std()),
                f"cost_{i}_total": float(costs.sum()),
                f"excess_{i}_total": float(np.maximum(costs - limit, 0.0).sum()),
            }
        rows.append(row)
    return rows
