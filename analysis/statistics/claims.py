"""The paper's claims about RiverGrid's two instances, counted: with how many seeds does each hold?

The paper (sections 5, 5.1 and 5.3) tells what happens on its figure 1a, where the only way leads through the
river, and on 1b, where a dry way exists, in words. Here each sentence is a predicate of a trial's deployment
phase, and the table says with how many of the seeds it holds, and Wilson's interval of that share.

What the words are taken to mean is fixed by the two tolerances of ``recrl.analysis.statistics.metrics``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from recrl.analysis.statistics.intervals import wilson_interval
from recrl.analysis.statistics.metrics import OPTIMAL_EXCESS, Measure, optimal, within_limits

STATIC = ("linear", "cosine", "exponential")


def violates(rows: pd.DataFrame) -> pd.Series[bool]:
    """A mean cost above d_d + 0.05."""
    return ~within_limits(rows, excess=OPTIMAL_EXCESS)


def stays(rows: pd.DataFrame) -> pd.Series[bool]:
    """A return below 0: most episodes end without the goal, which alone is worth 10."""
    return rows["episode_return"] < 0.0


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper.

    Attributes:
        section: where it is.
        text: what it says.
        task: whom it is about.
        methods: likewise, of the grid's names.
        holds: for which rows of ``metrics.outcomes``.
    """

    section: str
    text: str
    task: str
    methods: tuple[str, ...]
    holds: Callable[[pd.DataFrame], pd.Series[bool]]


CLAIMS = (
    Claim("5", "the plain student stays at the start on 1a", "rivergrid-1a", ("none",), stays),
    Claim("5.1", "every static curriculum finds the crossing on 1a", "rivergrid-1a", STATIC, optimal),
    Claim("5.3", "every static curriculum violates d_d on 1b", "rivergrid-1b", STATIC, violates),
    Claim("5.3", "the plain student finds the optimum on 1b", "rivergrid-1b", ("none",), optimal),
    Claim("5.3", "the dynamic curriculum finds the optimum on 1b", "rivergrid-1b", ("dynamic",), optimal),
    Claim("5.3", "the dynamic curriculum finds the crossing on 1a", "rivergrid-1a", ("dynamic",), optimal),
)


def weigh(rows: pd.DataFrame) -> pd.DataFrame:
    """With how many trials each claim holds, a row a claim and student.

    Args:
        rows: of ``metrics.outcomes``.

    Returns:
        section, claim, agent, trials, held, share, share_low, share_high (95%); no row where a grid has no
        such trial.
    """
    lines = []
    deployed = rows[rows["measure"] == Measure.DEPLOYMENT.value]
    for claim in CLAIMS:
        about = deployed[(deployed["task"] == claim.task) & deployed["method"].isin(claim.methods)]
        for agent, chosen in about.groupby("agent", observed=True, sort=False):
            held = int(claim.holds(chosen).sum())
            interval = wilson_interval(held, len(chosen))
            lines.append(
                {
                    "section": claim.section,
                    "claim": claim.text,
                    "agent": str(agent),
                    "trials": len(chosen),
                    "held": held,
                    "share": interval.estimate,
                    "share_low": interval.low,
                    "share_high": interval.high,
                }
            )
    return pd.DataFrame(lines)


def claims_table(weighed: pd.DataFrame) -> pd.DataFrame:
    """``weigh`` as text: "4 of 5 (38–96%)"."""
    ends = zip(weighed["share_low"], weighed["share_high"], strict=True)
    held = [f"{row.held} of {row.trials}" for row in weighed.itertuples()]
    return pd.DataFrame(
        {
            "section": weighed["section"],
            "claim": weighed["claim"],
            "agent": weighed["agent"],
            "holds with": [
                f"{count} ({round(100 * low)}–{round(100 * high)}%)"
                for count, (low, high) in zip(held, ends, strict=True)
            ],
        }
    )
