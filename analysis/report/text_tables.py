"""Tables for people of what the statistics of the same names count and bound; every cell is text."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP
from recrl.analysis.report.table_formats import names_of
from recrl.analysis.statistics.claims import CLAIMS, Comparison
from recrl.analysis.statistics.intervals import share_text
from recrl.environments.cmdp import Phase
from recrl.orchestrator.files.trial_reader import TrialReader
from recrl.orchestrator.number_texts import DASH, number

SUM_COLUMNS = {
    "cost": "cost_sum",
    "limits in force": "limit_sum",
    "net above limits in force": "over_limits_sum",
    "positive parts": "overshoot_sum",
    "net above the limit": "over_deploy_sum",
}
BOUND_COLUMNS = {
    "bound": "bound",
    "discounted bound": "discounted_bound",
    "trivial bound": "ceiling_sum",
}


def claims_table(counted: pd.DataFrame) -> pd.DataFrame:
    """Format the result of ``count_claims``: "mixed", "4 of 5 (38–96%)", "+1.2 (+0.3 to +2.1)", "+40%".

    Only a claim about single trials holds or does not. A comparison of returns has a dash where a policy of
    a pair is infeasible, because more return is then no gain. There is a column of failed seeds if there are
    any.
    """
    shares = zip(counted["held"], counted["seeds"], counted["share_low"], counted["share_high"], strict=True)
    beside = zip(counted["deployment_held"], counted["deployment_seeds"], strict=True)
    compared = counted["claim"].isin([claim.text for claim in CLAIMS if isinstance(claim, Comparison)])
    gains = compared & counted["feasible_pairs"].notna()
    ended = counted["seeds"] - counted["failed"]
    no_gain = gains & (counted["feasible_pairs"] < ended)
    no_gain_deployed = gains & (
        counted["deployment_feasible_pairs"] < counted["deployment_seeds"] - counted["failed"]
    )
    columns = {
        "section": counted["section"],
        "claim": counted["claim"],
        "agent": counted["agent"],
        "holds here": [
            "" if pair else "yes" if held == seeds else "mixed" if held else "no"
            for held, seeds, pair in zip(counted["held"], counted["seeds"], compared, strict=True)
        ],
        "holds in": [
            DASH if dashed else share_text(*share) for share, dashed in zip(shares, no_gain, strict=True)
        ],
        "deployment phase (learning goes on)": [
            "" if not seeds else DASH if dashed else f"{held} of {seeds}"
            for (held, seeds), dashed in zip(beside, no_gain_deployed, strict=True)
        ],
    }
    if (counted["failed"] > 0).any():
        columns["failed"] = counted["failed"].astype(str)
    if compared.any():
        pairs = zip(counted["feasible_pairs"], ended, strict=True)
        columns["feasible pairs"] = [f"{known} of {all_}" if pd.notna(known) else "" for known, all_ in pairs]
        columns["difference"] = [
            DASH if dashed else _difference_text(row)
            for (_, row), dashed in zip(counted.iterrows(), no_gain, strict=True)
        ]
        relative = counted["relative_difference"].mask(no_gain)
        columns["relative"] = [f"{value:+.0%}" if math.isfinite(value) else "" for value in relative]
        columns["paper, over its three tasks"] = counted["paper"]
    return pd.DataFrame(columns)


def _difference_text(row: pd.Series) -> str:
    if not math.isfinite(row["difference"]):
        return ""
    if not math.isfinite(row["difference_low"]):
        return f"{row['difference']:+.2f}"
    return f"{row['difference']:+.2f} ({row['difference_low']:+.2f} to {row['difference_high']:+.2f})"


def bound_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Format the sums of ``cumulative_costs``: one row per GROUP, means over its runs.

    A bound that is known for no row has no column.
    """
    known = [(title, name) for title, name in BOUND_COLUMNS.items() if rows[name].notna().any()]
    lines = []
    for _, runs in rows.groupby(list(GROUP), observed=True, sort=False):
        line = names_of(runs.iloc[0]) | {"n": str(len(runs)), "policies": str(int(runs["policies"].iloc[0]))}
        line["episodes per policy"] = number(float(runs["episodes_per_policy"].mean()))
        for title, name in (*SUM_COLUMNS.items(), *known):
            line[title] = number(float(runs[name].mean()))
        lines.append(line)
    return pd.DataFrame(lines)


def admissible_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Format the limits of ``admissible_limits``."""
    lines = []
    for _, row in rows.iterrows():
        limit = float(row["largest_train_limit"])
        lines.append(
            names_of(row)
            | {"episodes per policy": number(row["episodes_per_policy"])}
            | {"overshoot per policy": number(row["overshoot"])}
            | {"net above d_d, worst run": number(row["measured_over_deploy"])}
            | {"d_t of the runs": number(row["used_train_limit"])}
            | {"largest d_t": "any" if math.isinf(limit) else "none" if math.isnan(limit) else number(limit)}
        )
    return pd.DataFrame(lines)


def replay_summary(trial: TrialReader, rows: pd.DataFrame) -> pd.DataFrame:
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
            | {"reaches d_d": _reached(training, own, deploy, train_steps=trial.spec.train_steps)}
            | {"replayed reaches d_d": _reached(training, other, deploy, train_steps=trial.spec.train_steps)}
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


def _reached(training: pd.DataFrame, limits: np.ndarray, deploy: float, *, train_steps: int) -> str:
    """Return when a limit first equals d_d, as a percentage of the training phase."""
    begins = training["end_step"].shift(fill_value=0)[limits <= deploy]
    if len(begins):
        return f"{begins.iloc[0] / train_steps:.0%}"
    return "at its end" if training["end_step"].iloc[-1] >= train_steps else "not yet"


def _times(noise: pd.Series) -> str:
    return str(int((noise > 0.0).sum()))
