"""Count in how many seeds each of the paper's claims about RiverGrid's two instances holds.

The paper (sections 5, 5.1 and 5.3) describes results on its figure 1a, where every path crosses the river,
and on 1b, which has a safe path. Here each sentence is a predicate of a trial's final policy. The table has
the fraction of seeds in which it holds, with Wilson's interval. It also has the count for the deployment
phase, in which learning goes on.

The predicates use the tolerance of ``recrl.analysis.statistics.verdicts``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from recrl.analysis.statistics.intervals import share_text, wilson_interval
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdicts import solved, within_limits

STATIC = ("linear", "cosine", "exponential")


def violates(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether a mean cost is above d_d, beyond the tolerance."""
    return ~within_limits(rows)


def stays(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether the return is below 0: most episodes end without the goal, whose reward is 10."""
    return rows["episode_return"] < 0.0


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper.

    Attributes:
        section: of the paper.
        text: the claim.
        task: of the claim.
        methods: of the claim, by the grid's names.
        holds: predicate on rows of ``metrics.outcomes``.
    """

    section: str
    text: str
    task: str
    methods: tuple[str, ...]
    holds: Callable[[pd.DataFrame], pd.Series[bool]]


CLAIMS = (
    Claim("5", "the plain agent stays at the start on 1a", "rivergrid-1a", ("none",), stays),
    Claim("5.1", "every static curriculum finds the crossing on 1a", "rivergrid-1a", STATIC, solved),
    Claim("5.3", "every static curriculum violates d_d on 1b", "rivergrid-1b", STATIC, violates),
    Claim("5.3", "the plain agent finds the optimum on 1b", "rivergrid-1b", ("none",), solved),
    Claim("5.3", "the dynamic curriculum finds the optimum on 1b", "rivergrid-1b", ("dynamic",), solved),
    Claim("5.3", "the dynamic curriculum finds the crossing on 1a", "rivergrid-1a", ("dynamic",), solved),
)


def weigh(rows: pd.DataFrame) -> pd.DataFrame:
    """Count the trials in which each claim holds, one row per claim and agent.

    Args:
        rows: of ``metrics.outcomes``.

    Returns:
        section, claim, agent, trials, held, share, share_low, share_high (95%), deployment_held (for the
        deployment phase instead of the final policy); no row without such trials.
    """
    lines = []
    final, deployed = (
        rows[rows["measure"] == measure.value] for measure in (Measure.STOCHASTIC, Measure.DEPLOYMENT)
    )
    for claim in CLAIMS:
        for agent, chosen in _about(final, claim).groupby("agent", observed=True, sort=False):
            held = int(claim.holds(chosen).sum())
            interval = wilson_interval(held, len(chosen))
            beside = _about(deployed, claim)
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
                    "deployment_held": int(claim.holds(beside[beside["agent"] == agent]).sum()),
                }
            )
    return pd.DataFrame(lines)


def _about(rows: pd.DataFrame, claim: Claim) -> pd.DataFrame:
    return rows[(rows["task"] == claim.task) & rows["method"].isin(claim.methods)]


def claims_table(weighed: pd.DataFrame) -> pd.DataFrame:
    """Format the result of ``weigh``: "mixed", "4 of 5 (38–96%)"."""
    shares = zip(weighed["held"], weighed["trials"], weighed["share_low"], weighed["share_high"], strict=True)
    beside = zip(weighed["deployment_held"], weighed["trials"], strict=True)
    return pd.DataFrame(
        {
            "section": weighed["section"],
            "claim": weighed["claim"],
            "agent": weighed["agent"],
            "holds here": [
                "yes" if held == trials else "mixed" if held else "no"
                for held, trials in zip(weighed["held"], weighed["trials"], strict=True)
            ],
            "final policy": [share_text(*share) for share in shares],
            "deployment phase (learning goes on)": [f"{held} of {trials}" for held, trials in beside],
        }
    )
