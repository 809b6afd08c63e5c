"""Judge experiments on Safety Gym by the rules that their grids set before they ran.

    python -m tests.benchmarks.confirmations results/safety-gym/button-confirm.csv \
        --earlier results/safety-gym/curricula-today.csv results/safety-gym/table.csv

The tables are those of ``final_policies.py``; the first one's name says which rule it has. Printed are the
conditions of the rule, for ppo-lag's final stochastic policies. Then come the differences of linear from
none in return and cost, with 95% intervals, paired (Student) and as two groups (Welch): of these seeds, of
these with the first earlier table if there is one, and of all. A table whose seeds suggested the question
comes last. With ``--shorter``, a table of trials with fewer steps and other seeds, each curriculum is
compared with itself after fewer steps. That was not planned.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from recrl.analysis.statistics.intervals import Difference, group_difference, paired_difference
from tests.benchmarks.differences import weighted_sum
from tests.benchmarks.velocity_table import Cell

AGENT, LIMIT, METHODS = "ppo-lag", 25.0, ["none", "linear"]


def every_pair_earns_more(seeds: pd.DataFrame) -> tuple[bool, str]:
    """Whether linear earns more than none with each seed."""
    earned = seeds["return", "linear"] - seeds["return", "none"]
    each = ", ".join(f"{value:.2f} (seed {seed})" for seed, value in earned.items())
    said = f"return under linear above none: {each}: {(earned > 0).sum()} of {len(earned)} pairs earn more"
    return bool((earned > 0).all()), said


def groups_earn_less(seeds: pd.DataFrame) -> tuple[bool, str]:
    """Whether linear earns less than none, by the 95% interval for two independent groups."""
    it, said = _difference_of_groups(seeds)
    return it.high < 0.0, said


def groups_earn_less_or_more(seeds: pd.DataFrame) -> tuple[bool, str]:
    """Whether linear earns less or more than none, by the same interval."""
    it, said = _difference_of_groups(seeds)
    return it.high < 0.0 or it.low > 0.0, said


def _difference_of_groups(seeds: pd.DataFrame) -> tuple[Difference, str]:
    it = group_difference(*(seeds["return", method].to_numpy() for method in reversed(METHODS)))
    said = f"return under linear above none, two groups: {it.estimate:.2f} ({it.low:.2f} to {it.high:.2f})"
    return it, f"{said}, p = {it.p_value:.2g}"


@dataclass(frozen=True)
class Rule:
    """What was planned.

    Attributes:
        task: on which ppo-lag is judged.
        seeds: of both curricula.
        condition: on the returns, and a sentence about it. The other one is on linear's mean cost.
    """

    task: str
    seeds: list[int]
    condition: Callable[[pd.DataFrame], tuple[bool, str]]


RULES = {
    "button-confirm": Rule("CarButton2", [120, 121, 122], every_pair_earns_more),
    "goal-confirm": Rule("CarGoal2", [120, 121, 122, 123, 124, 125], groups_earn_less),
    "level1": Rule("CarGoal1", [117, 118, 119], groups_earn_less),
    "long-curricula": Rule("CarGoal2", [126, 127, 128, 129, 130, 131], groups_earn_less_or_more),
}


def pairs(rows: pd.DataFrame, policy: str) -> pd.DataFrame:
    """Return a row a seed, with the columns (return, cost or cost_se; none or linear)."""
    chosen = rows[rows["policy"] == policy]
    return chosen.pivot(index="seed", columns="method", values=["return", "cost", "cost_se"]).dropna()


def verdict(rows: pd.DataFrame, rule: Rule) -> Iterator[str]:
    """Yield the two conditions of a rule, and whether it is met."""
    seeds = pairs(rows, "stochastic")
    if seeds.index.tolist() != rule.seeds:
        raise SystemExit(f"the planned seeds are {rule.seeds}, complete are {seeds.index.tolist()}")
    holds, said = rule.condition(seeds)
    cell = Cell.of("", AGENT, rows[(rows["policy"] == "stochastic") & (rows["method"] == "linear")])
    keeps = cell.cost <= LIMIT + cell.cost_error
    yield said
    yield f"mean cost under linear: {cell.costs}: {'keeps' if keeps else 'exceeds'} the limit of {LIMIT:g}"
    yield f"the rule is {'met' if keeps and holds else 'not met'}"


def intervals(seeds: pd.DataFrame) -> Iterator[str]:
    """Yield the differences of linear from none, paired and as two groups."""
    for column in ("return", "cost"):
        linear, none = seeds[column, "linear"].to_numpy(), seeds[column, "none"].to_numpy()
        paired, two = paired_difference(linear, none), group_difference(linear, none)
        both = f"paired {paired.low:.2f} to {paired.high:.2f}; Welch {two.low:.2f} to {two.high:.2f}"
        yield f"  {column}: {paired.estimate:.2f} ({both})"


def from_shorter(seeds: pd.DataFrame, shorter: pd.DataFrame) -> Iterator[str]:
    """Yield how policies after more steps differ from those after fewer steps, with other seeds.

    All four groups count as independent.
    """
    for column in ("return", "cost"):
        groups = [of[column, method].to_numpy() for method in reversed(METHODS) for of in (seeds, shorter)]
        for method, pair in zip(reversed(METHODS), (groups[:2], groups[2:]), strict=True):
            yield f"  {column} under {method}: {weighted_sum(pair, [1.0, -1.0])}"
        yield f"  {column}, linear minus none: {weighted_sum(groups, [1.0, -1.0, -1.0, 1.0])}"


def kept(seeds: pd.DataFrame) -> pd.DataFrame:
    """Return the pairs whose policy under none keeps the limit."""
    return seeds[seeds["cost", "none"] <= LIMIT + seeds["cost_se", "none"]]


def main() -> None:
    """Print the verdict and the intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("fresh", type=Path)
    parser.add_argument("--earlier", type=Path, nargs="+", default=[])
    parser.add_argument("--shorter", type=Path)
    given = parser.parse_args()
    fresh = pd.read_csv(given.fresh)
    if (rule := RULES.get(given.fresh.stem)) is None:
        parser.error(f"{given.fresh}: has no rule; those with one are {', '.join(RULES)}")
    everything = pd.concat([fresh, *map(pd.read_csv, given.earlier)], keys=range(1 + len(given.earlier)))
    of_question = everything[(everything["task"] == rule.task) & (everything["agent"] == AGENT)]
    of_question = of_question[of_question["method"].isin(METHODS)]
    print("\n".join(verdict(of_question.loc[[0]], rule)))
    for policy in ("stochastic", "deterministic"):
        for last in range(1 + len(given.earlier)):
            seeds = pairs(of_question.loc[:last], policy)
            print(f"{policy}, linear minus none, seeds {', '.join(map(str, seeds.index))}:")
            print("\n".join(intervals(seeds)))
            within = kept(seeds)
            if 1 < len(within) < len(seeds):
                print(f" of these, where none keeps the limit, seeds {', '.join(map(str, within.index))}:")
                print("\n".join(intervals(within)))
        if given.shorter:
            rows = pd.read_csv(given.shorter)
            shorter = pairs(rows[(rows["task"] == rule.task) & (rows["agent"] == AGENT)], policy)
            print(
                f"{policy}, these seeds minus seeds {', '.join(map(str, shorter.index))} after fewer steps:"
            )
            print("\n".join(from_shorter(pairs(of_question.loc[[0]], policy), shorter)))


if __name__ == "__main__":
    main()
