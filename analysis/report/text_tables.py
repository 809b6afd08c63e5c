"""Tables for people of what the statistics of the same names count and bound; every cell is text."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP
from recrl.analysis.data.number_texts import number
from recrl.analysis.statistics.intervals import share_text
from recrl.environments.cmdp import Phase
from recrl.orchestrator.files.trial_store import TrialStore


def claims_table(weighed: pd.DataFrame) -> pd.DataFrame:
    """Format the result of ``count_claims``: "mixed", "4 of 5 (38–96%)", "+1.2 (+0.3 to +2.1)", "+40%".

    There is a column of failed trials if there are any.
    """
    shares = zip(weighed["held"], weighed["trials"], weighed["share_low"], weighed["share_high"], strict=True)
    beside = zip(weighed["deployment_held"], weighed["deployment_trials"], strict=True)
    columns = {
        "section": weighed["section"],
        "claim": weighed["claim"],
        "agent": weighed["agent"],
        "holds here": [
            "yes" if held == trials else "mixed" if held else "no"
            for held, trials in zip(weighed["held"], weighed["trials"], strict=True)
        ],
        "holds in": [share_text(*share) for share in shares],
        "deployment phase (learning goes on)": [
            f"{held} of {trials}" if trials else "" for held, trials in beside
        ],
    }
    if (weighed["failed"] > 0).any():
        columns["failed"] = weighed["failed"].astype(str)
    if weighed["difference"].notna().any():
        pairs = zip(weighed["feasible_pairs"], weighed["trials"] - weighed["failed"], strict=True)
        columns["feasible pairs"] = [f"{known} of {all_}" if pd.notna(known) else "" for known, all_ in pairs]
        columns["difference"] = [_difference_text(row) for _, row in weighed.iterrows()]
        relative = weighed["relative_difference"]
        columns["relative"] = [f"{value:+.0%}" if math.isfinite(value) else "" for value in relative]
        columns["paper, over its three tasks"] = weighed["paper"]
    return pd.DataFrame(columns)


def _difference_text(row: pd.Series) -> str:
    if not math.isfinite(row["difference"]):
        return ""
    if not math.isfinite(row["difference_low"]):
        return f"{row['difference']:+.2f}"
    return f"{row['difference']:+.2f} ({row['difference_low']:+.2f} to {row['difference_high']:+.2f})"


def bound_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Format the sums of ``cumulative_costs``: one row per GROUP, means over its runs."""
    lines = []
    for group, runs in rows.groupby(list(GROUP), observed=True, sort=False):
        line = dict(zip(("task", "agent", "curriculum"), map(str, group), strict=True))
        line |= {"n": str(len(runs)), "policies": str(int(runs["policies"].iloc[0]))}
        for title, name in (
            ("cost", "cost_sum"),
            ("limits in force", "limit_sum"),
            ("above limits in force", "overshoot_sum"),
            ("above the limit", "violation_sum"),
            ("bound", "bound"),
            ("discounted bound", "discounted_bound"),
            ("trivial bound", "ceiling_sum"),
        ):
            line[title] = number(float(runs[name].mean()))
        lines.append(line)
    return pd.DataFrame(lines)


def admissible_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Format the limits of ``admissible_limits``."""
    lines = []
    for _, row in rows.iterrows():
        limit = float(row["largest_train_limit"])
        lines.append(
            dict(zip(("task", "agent", "curriculum"), (str(row[name]) for name in GROUP), strict=True))
            | {"overshoot per policy": number(row["overshoot"])}
            | {"violation of the worst run": number(row["measured_violation"])}
            | {"d_t of the runs": number(row["used_train_limit"])}
            | {"largest d_t": "any" if math.isinf(limit) else "none" if math.isnan(limit) else number(limit)}
        )
    return pd.DataFrame(lines)


def replay_summary(trial: TrialStore, rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise the differences between replay and record: one row per cost, as text.

    Args:
        trial: the run.
        rows: of ``replay``.
    """
    training = rows[rows["phase"] == Phase.TRAINING.value]
    lines = []
    for i, deploy in enumerate(trial.spec.deploy_limits):
        own = training[f"limit_{i}"].to_numpy(np.float64)
        other = training[f"replayed_limit_{i}"].to_numpy(np.float64)
        differ = own != other
        lines.append(
            {"trial": trial.spec.title, "cost": str(i), "updates": str(len(training))}
            | {"other limit": str(int(differ.sum()))}
            | {"mean limit": _mean(own), "replayed": _mean(other)}
            | {"reaches d_d": _reached(training, own, deploy)}
            | {"replayed reaches d_d": _reached(training, other, deploy)}
            | {
                "noise": str(_times(training["noise"])),
                "replayed noise": str(_times(training["replayed_noise"])),
            }
        )
    return pd.DataFrame(lines)


def _mean(limits: Sequence[float] | np.ndarray) -> str:
    """Return the mean of the finite limits."""
    finite = np.asarray(limits)[np.isfinite(limits)]
    return number(float(finite.mean())) if len(finite) else "∞"


def _reached(training: pd.DataFrame, limits: np.ndarray, deploy: float) -> str:
    """Return when a limit first equals d_d, as a percentage of the training phase."""
    steps = training.loc[limits <= deploy, "end_step"]
    return f"{steps.iloc[0] / training['end_step'].iloc[-1]:.0%}" if len(steps) else "at its end"


def _times(noise: pd.Series) -> str:
    return str(int((noise > 0.0).sum()))
