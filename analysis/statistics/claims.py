"""Count in how many seeds the paper's claims hold.

RiverGrid (sections 5, 5.1 and 5.3): on figure 1a every path crosses the river, and 1b has a safe path. Each
sentence is a predicate of a trial's final policy. A claim about several curricula holds in a seed if it holds
in the trials of all of them: trials with the same seed are not independent. If a sweep has only some of them,
the claim names these, and a seed without one of them is not counted.

Safety Gym (section 6): which agents keep the limit is a predicate, too. Which of two curricula returns more,
or costs more in training, is a comparison of the two trials of each seed. It has the mean paired difference,
and beside it the paper's relative gains. Only trials with the labels ``ppo-lag`` and ``cpo`` are counted. Not
counted are which static curriculum is the best in how many tasks, and that the costs of training of
``dynamic`` and ``linear`` are comparable.

Only trials of the paper's tasks are counted: under its deployment limit (``PAPER_LIMITS``) and with one cost.
Their labels must be their names: a task or curriculum that has only the label of one of the paper's is
another one. So is an agent that has only the label ``ppo-lag`` or ``cpo``.

The fraction of seeds has Wilson's interval. Beside it is the count for the deployment phase, in which
learning goes on. The predicates use the tolerance of ``recrl.analysis.statistics.verdicts``. A failed trial
has no final policy and an incomplete training: a claim does not hold in a seed with one.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.statistics.intervals import (
    Interval,
    mean_interval,
    paired_difference,
    wilson_interval,
)
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdicts import ROUNDING, solved, within_limits
from recrl.environments.cmdp import Floats
from recrl.orchestrator.spec import TrialStatus

STATIC = ("linear", "cosine", "exponential")
CURRICULA = (*STATIC, "dynamic")
PAPER_TASKS = ("CarButton2", "CarGoal2", "CarPush2")
PAPER_AGENTS = ("ppo-lag", "cpo")
PAPER_LIMITS = {"rivergrid-1a": 5.0, "rivergrid-1b": 1.0} | dict.fromkeys(PAPER_TASKS, 25.0)  # d_d
RETURN = "episode_return"
TRAINING_COST = "training_cost"
FEASIBLE_PAIRS = ("feasible_pairs", "deployment_feasible_pairs")


def violates(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether a mean cost is above d_d, beyond the tolerance."""
    return ~within_limits(rows)


def stays(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether the return is below 0: most episodes end without the goal, whose reward is 10."""
    return rows[RETURN] < 0.0


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper about single trials.

    Attributes:
        section: of the paper.
        text: the claim.
        task: of the claim.
        methods: of the claim, by their labels.
        holds: predicate on rows of ``metrics.outcomes``.
        agent: of the claim; every agent if empty.
    """

    section: str
    text: str
    task: str
    methods: tuple[str, ...]
    holds: Callable[[pd.DataFrame], pd.Series[bool]]
    agent: str = ""


@dataclass(frozen=True)
class Comparison:
    """A sentence of the paper that compares two trials of each seed.

    Attributes:
        section: of the paper.
        text: the claim.
        task: of the claim.
        agent: of the claim.
        method: it is claimed to have more.
        against: than this.
        quantity: RETURN of the final policy, or TRAINING_COST, the mean cost of an episode of training.
        paper: the relative gain that the paper gives for its three tasks, or empty.
    """

    section: str
    text: str
    task: str
    agent: str
    method: str
    against: str
    quantity: str = RETURN
    paper: str = ""


GAINS = {
    ("ppo-lag", "linear"): "20% to 600%",
    ("ppo-lag", "cosine"): "20% to 400%",
    ("ppo-lag", "exponential"): "10% to 300%",
    ("ppo-lag", "dynamic"): "40% to 900%",
    ("cpo", "linear"): "5% to 60%",
    ("cpo", "cosine"): "10% to 40%",
    ("cpo", "exponential"): "3% to 30%",
    ("cpo", "dynamic"): "15% to 80%",
}
RIVERGRID_CLAIMS = (
    Claim("5", "the plain agent stays at the start on 1a", "rivergrid-1a", ("none",), stays),
    Claim("5.1", "every static curriculum finds the crossing on 1a", "rivergrid-1a", STATIC, solved),
    Claim("5.3", "every static curriculum violates d_d on 1b", "rivergrid-1b", STATIC, violates),
    Claim("5.3", "the plain agent finds the optimum on 1b", "rivergrid-1b", ("none",), solved),
    Claim("5.3", "the dynamic curriculum finds the optimum on 1b", "rivergrid-1b", ("dynamic",), solved),
)


def _safety_gym_claims(task: str, agent: str) -> Iterator[Claim | Comparison]:
    everything = ("none", *CURRICULA)
    if agent == "ppo-lag":
        yield Claim("6", f"ppo-lag keeps d_d on {task}", task, everything, within_limits, agent)
    else:
        yield Claim("6", f"cpo violates d_d on {task}", task, everything, violates, agent)
    for method in CURRICULA:
        text = f"{method} returns more than none on {task}"
        yield Comparison("6", text, task, agent, method, "none", paper=GAINS[agent, method])
    for method in STATIC:
        text = f"dynamic returns more than {method} on {task}"
        yield Comparison("6", text, task, agent, "dynamic", method)
    for method, against in (("linear", "exponential"), ("cosine", "exponential"), ("cosine", "linear")):
        text = f"{method} costs more in training than {against} on {task}"
        yield Comparison("6", text, task, agent, method, against, quantity=TRAINING_COST)


CLAIMS = (
    *RIVERGRID_CLAIMS,
    *(claim for task in PAPER_TASKS for agent in PAPER_AGENTS for claim in _safety_gym_claims(task, agent)),
)


def count_claims(rows: pd.DataFrame, training: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Count the seeds in which each claim holds, one row per claim and agent.

    Args:
        rows: of ``metrics.outcomes``.
        training: of ``metrics.training_totals``; only those of complete trials are compared.
        trials: of the sweep, complete or not.

    Returns:
        section, claim, agent, seeds (all of whose trials have ended; of a comparison, that have both trials),
        failed (seeds with a failed trial), held, share, share_low, share_high (95%); deployment_seeds and
        deployment_held, the same for the deployment phase. Of a comparison also difference, the mean over the
        seeds without a failed trial, with Student's interval; relative_difference, where the other
        curriculum's mean is above 0 beyond its interval; and the paper's range. Of a comparison of returns
        feasible_pairs and deployment_feasible_pairs, the seeds whose two policies are feasible; the others
        count, too. No row without such seeds.
    """
    trials = trials[_is_of_the_paper(trials)]
    final, deployed = (
        _of_trials(rows[rows["measure"] == measure.value], trials)
        for measure in (Measure.STOCHASTIC, Measure.DEPLOYMENT)
    )
    costs = _of_trials(training, trials[trials["status"] == TrialStatus.COMPLETE.value])
    costs = costs.assign(**{TRAINING_COST: costs["cost_0_total"] / costs["episodes"]})
    lines = []
    for claim in CLAIMS:
        of_training = isinstance(claim, Comparison) and claim.quantity == TRAINING_COST
        chosen, beside, planned = (
            _about(frame, claim) for frame in (costs if of_training else final, deployed, trials)
        )
        for agent in dict.fromkeys(planned["agent"]):
            own, same, its = (frame[frame["agent"] == agent] for frame in (chosen, beside, planned))
            counted = (
                _compared(own, same, its, claim)
                if isinstance(claim, Comparison)
                else _held(own, same, its, claim)
            )
            if counted["seeds"]:
                named = {"section": claim.section, "claim": _text(claim, its), "agent": str(agent)}
                lines.append(named | counted)
    table = pd.DataFrame(lines)
    return table.astype(dict.fromkeys(FEASIBLE_PAIRS, "Int64")) if lines else table


def _is_of_the_paper(trials: pd.DataFrame) -> pd.Series[bool]:
    """Whether each trial is of one of the paper's tasks, under the paper's limit and with one cost."""
    others = [name for name in trials if str(name).startswith("deploy_limit_") and name != "deploy_limit_0"]
    limits = trials["task"].astype(str).map(PAPER_LIMITS)
    task, agent, method = (trials[f"{part}_name"] == trials[part].astype(str) for part in GROUP)
    is_named = task & method & (agent | ~trials["agent"].isin(PAPER_AGENTS))  # RiverGrid's are of any agent
    return (trials["deploy_limit_0"] == limits) & trials[others].isna().all(axis=1) & is_named


def _of_trials(rows: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that belong to some trials."""
    known = set(_keys(trials))
    return rows[np.array([key in known for key in _keys(rows)], dtype=bool)]


def _keys(rows: pd.DataFrame) -> list[tuple[Any, ...]]:
    return list(rows[list(KEY)].itertuples(index=False, name=None))


def _about(rows: pd.DataFrame, claim: Claim | Comparison) -> pd.DataFrame:
    methods = claim.methods if isinstance(claim, Claim) else (claim.method, claim.against)
    agents = (rows["agent"] == claim.agent) | (claim.agent == "")
    return rows[(rows["task"] == claim.task) & agents & rows["method"].isin(methods)]


def _text(claim: Claim | Comparison, trials: pd.DataFrame) -> str:
    """Return the claim, and which of its curricula the sweep has, if not all."""
    if isinstance(claim, Comparison):
        return claim.text
    there = [method for method in claim.methods if (trials["method"] == method).any()]
    return claim.text if len(there) == len(claim.methods) else f"{claim.text} (here: {', '.join(there)})"


def _held(final: pd.DataFrame, deployed: pd.DataFrame, trials: pd.DataFrame, claim: Claim) -> dict[str, Any]:
    nothing = _ends(Interval(math.nan, math.nan, math.nan, 0, True))
    methods = trials.groupby("seed")["method"].nunique()
    whole = methods.index[methods == trials["method"].nunique()]
    failed = _failed_seeds(trials) & set(whole)
    final, deployed = (rows[rows["seed"].isin(whole)] for rows in (final, deployed))
    held, beside = (_of_all(rows, claim, trials) for rows in (final, deployed))
    counted = _counted(held, beside, failed=len(failed))
    pairs = dict.fromkeys(FEASIBLE_PAIRS)
    return {**counted, **nothing, "relative_difference": math.nan, "paper": "", **pairs}


def _of_all(rows: pd.DataFrame, claim: Claim, trials: pd.DataFrame) -> pd.Series[bool]:
    """Whether a claim holds in all trials of a seed, for the seeds whose trials all have an outcome."""
    planned = trials.drop_duplicates(list(KEY)).groupby("seed").size()
    holds = claim.holds(rows).groupby(rows["seed"])
    measured = holds.size()
    ended = measured.index[measured == planned.reindex(measured.index)]
    return holds.all().loc[ended]


def _failed_seeds(trials: pd.DataFrame) -> set[int]:
    return set(trials.loc[trials["status"] == TrialStatus.FAILED.value, "seed"])


def _compared(
    final: pd.DataFrame, deployed: pd.DataFrame, trials: pd.DataFrame, claim: Comparison
) -> dict[str, Any]:
    of_training = claim.quantity == TRAINING_COST
    deployed = deployed.iloc[:0] if of_training else deployed
    values, base = _pairs(final, claim)
    differences = values - base
    beside = operator.sub(*_pairs(deployed.assign(**{claim.quantity: deployed[RETURN]}), claim))
    pairs = [
        None if of_training else int((~of.index.isin(rows.loc[~rows["feasible"].astype(bool), "seed"])).sum())
        for of, rows in ((differences, final), (beside, deployed))
    ]
    both = set.intersection(
        *(set(trials.loc[trials["method"] == name, "seed"]) for name in (claim.method, claim.against))
    )
    interval, ground = paired_difference(_numbers(values), _numbers(base)), mean_interval(_numbers(base))
    relative = interval.estimate / ground.estimate if ground.low > 0.0 else math.nan
    return {
        **_counted(differences > ROUNDING, beside > ROUNDING, failed=len(_failed_seeds(trials) & both)),
        **_ends(interval),
        "relative_difference": relative,
        "paper": claim.paper,
        **dict(zip(FEASIBLE_PAIRS, pairs, strict=True)),
    }


def _counted(held: pd.Series[bool], deployed: pd.Series[bool], *, failed: int) -> dict[str, Any]:
    """Count where a claim holds; a seed with a failed trial is one where it does not."""
    count, seeds = int(held.sum()), len(held) + failed
    share = wilson_interval(count, seeds)
    return {
        "seeds": seeds,
        "failed": failed,
        "held": count,
        "share": share.estimate,
        "share_low": share.low,
        "share_high": share.high,
        "deployment_seeds": len(deployed) + failed if len(deployed) else 0,
        "deployment_held": int(deployed.sum()),
    }


def _pairs(rows: pd.DataFrame, claim: Comparison) -> tuple[pd.Series[float], pd.Series[float]]:
    """Return the value of the method and of the other one, for each seed with both."""
    table = rows.pivot_table(index="seed", columns="method", values=claim.quantity, observed=True)
    table = table.reindex(columns=[claim.method, claim.against]).dropna()
    return table[claim.method], table[claim.against]


def _numbers(values: pd.Series[float]) -> Floats:
    return np.asarray(values, dtype=np.float64)


def _ends(interval: Interval) -> dict[str, float]:
    ends = (interval.estimate, interval.low, interval.high)
    return dict(zip(("difference", "difference_low", "difference_high"), ends, strict=True))
