"""Judge experiments on Safety Gym by the rules that their grids set before they ran.

    python -m tests.benchmarks.confirmations results/safety-gym/button-confirm.csv \
        --earlier results/safety-gym/curricula-today.csv results/safety-gym/table.csv

    python -m tests.benchmarks.confirmations results/safety-gym/long-early.csv \
        --controls results/safety-gym/long-curricula.csv

The tables are those of ``final_policies.py``; the first one's name says which rule it has. Printed are the
conditions of the rule, for ppo-lag's final stochastic policies. Then come the differences of a curriculum
from each control in return and cost, with 95% intervals, paired (Student) and as two groups (Welch): of
these seeds, of these with the first earlier table if there is one, and of all. A table whose seeds suggested
the question comes last. With ``--controls``, the trials of the controls are in another table. With
``--shorter``, a table of trials with fewer steps and other seeds, the curriculum and its control are each
compared with themselves after fewer steps. That was not planned. A rule is judged when all planned seeds
have run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from recrl.analysis.statistics.intervals import Difference, group_difference, paired_difference
from recrl.environments.cmdp import Floats
from tests.benchmarks.differences import weighted_sum
from tests.benchmarks.velocity_table import Cell

AGENT, LIMIT = "ppo-lag", 25.0


@dataclass(frozen=True)
class Pairs:
    """The final policies of a curriculum and of its control, with the same seeds.

    Attributes:
        curriculum: its name.
        control: name of the other curriculum.
        seeds: a row a seed, with the columns (return, cost or cost_se; name of a curriculum).
    """

    curriculum: str
    control: str
    seeds: pd.DataFrame

    @classmethod
    def of(cls, rows: pd.DataFrame, policy: str, curriculum: str, control: str) -> Pairs:
        """Choose the pairs of one kind of policy from rows of final policies."""
        chosen = rows[(rows["policy"] == policy) & rows["method"].isin([curriculum, control])]
        if missing := sorted({curriculum, control} - set(chosen["method"])):
            raise SystemExit(
                f"no table has policies under {missing[0]}; --controls names a table of controls"
            )
        columns = ["return", "cost", "cost_se"]
        return cls(curriculum, control, chosen.pivot(index="seed", columns="method", values=columns).dropna())

    def groups(self, column: str) -> tuple[Floats, Floats]:
        """Return a column of the curriculum and of the control, each of shape (seeds,)."""
        table = self.seeds[column]
        return table[self.curriculum].to_numpy(np.float64), table[self.control].to_numpy(np.float64)

    def kept(self) -> Pairs:
        """Return the pairs whose control keeps the limit."""
        cost, error = (self.seeds[column, self.control] for column in ("cost", "cost_se"))
        return Pairs(self.curriculum, self.control, self.seeds[cost <= LIMIT + error])

    @property
    def named_seeds(self) -> str:
        """Name the seeds."""
        return f"seeds {', '.join(map(str, self.seeds.index))}"


def every_pair_earns_more(pairs: Pairs) -> tuple[bool, str]:
    """Whether the curriculum earns more than its control with each seed."""
    curriculum, control = pairs.groups("return")
    earned = curriculum - control
    each = [f"{value:.2f} (seed {seed})" for seed, value in zip(pairs.seeds.index, earned, strict=True)]
    count = f"{(earned > 0).sum()} of {len(earned)} pairs earn more"
    said = f"return under {pairs.curriculum} above {pairs.control}: {', '.join(each)}: {count}"
    return bool((earned > 0).all()), said


def groups_earn_less(pairs: Pairs) -> tuple[bool, str]:
    """Whether the curriculum earns less, by the 95% interval for two independent groups."""
    it, said = _difference_of_groups(pairs)
    return it.high < 0.0, said


def groups_earn_more(pairs: Pairs) -> tuple[bool, str]:
    """Whether the curriculum earns more, by the same interval."""
    it, said = _difference_of_groups(pairs)
    return it.low > 0.0, said


def groups_earn_less_or_more(pairs: Pairs) -> tuple[bool, str]:
    """Whether the curriculum earns less or more, by the same interval."""
    it, said = _difference_of_groups(pairs)
    return it.high < 0.0 or it.low > 0.0, said


def _difference_of_groups(pairs: Pairs) -> tuple[Difference, str]:
    it = group_difference(*pairs.groups("return"))
    what = f"return under {pairs.curriculum} above {pairs.control}, two groups"
    return it, f"{what}: {it.estimate:.2f} ({it.low:.2f} to {it.high:.2f}), p = {it.p_value:.2g}"


@dataclass(frozen=True)
class Rule:
    """What was planned.

    Attributes:
        task: on which ppo-lag is judged.
        seeds: of the curriculum and of its controls.
        condition: on the returns of the curriculum and of its first control, and a sentence about it. The
            other condition is on the curriculum's mean cost.
        curriculum: that is judged.
        controls: curricula that it is compared with; it is judged against the first.
    """

    task: str
    seeds: list[int]
    condition: Callable[[Pairs], tuple[bool, str]]
    curriculum: str = "linear"
    controls: tuple[str, ...] = ("none",)


LONG_SEEDS = [126, 127, 128, 129, 130, 131]
RULES = {
    "button-confirm": Rule("CarButton2", [120, 121, 122], every_pair_earns_more),
    "goal-confirm": Rule("CarGoal2", [120, 121, 122, 123, 124, 125], groups_earn_less),
    "level1": Rule("CarGoal1", [117, 118, 119], groups_earn_less),
    "long-curricula": Rule("CarGoal2", LONG_SEEDS, groups_earn_less_or_more),
    "long-early": Rule("CarGoal2", LONG_SEEDS, groups_earn_more, "linear-early", ("linear", "none")),
}


def verdict(rows: pd.DataFrame, rule: Rule) -> Iterator[str]:
    """Yield the two conditions of a rule, and whether it is met."""
    pairs = Pairs.of(rows, "stochastic", rule.curriculum, rule.controls[0])
    if (complete := pairs.seeds.index.tolist()) != rule.seeds:
        raise SystemExit(f"the planned seeds are {rule.seeds}, complete are {complete}")
    holds, said = rule.condition(pairs)
    policies = rows[(rows["policy"] == "stochastic") & (rows["method"] == rule.curriculum)]
    policies = policies[policies["seed"].isin(rule.seeds)]
    cell = Cell.of("", AGENT, policies)
    keeps = cell.cost <= LIMIT + cell.cost_error
    ends = f"{'keeps' if keeps else 'exceeds'} the limit of {LIMIT:g}"
    yield said
    yield f"mean cost under {rule.curriculum}: {cell.costs}: {ends}"
    yield f"the rule is {'met' if keeps and holds else 'not met'}"


def exceeding(rows: pd.DataFrame, policy: str) -> Iterator[str]:
    """Yield how many policies of each curriculum exceed the limit by more than one standard error."""
    chosen = rows[rows["policy"] == policy]
    for method, costs in chosen.groupby("method", sort=False):
        seeds = costs.loc[costs["cost"] > LIMIT + costs["cost_se"], "seed"]
        which = f": seeds {', '.join(map(str, seeds))}" if len(seeds) else ""
        yield f"{policy}, {method}: {len(seeds)} of {len(costs)} exceed the limit{which}"


def intervals(pairs: Pairs) -> Iterator[str]:
    """Yield the differences of the curriculum from its control, paired and as two groups."""
    for column in ("return", "cost"):
        groups = pairs.groups(column)
        paired, two = paired_difference(*groups), group_difference(*groups)
        both = f"paired {paired.low:.2f} to {paired.high:.2f}; Welch {two.low:.2f} to {two.high:.2f}"
        yield f"  {column}: {paired.estimate:.2f} ({both})"


def from_shorter(pairs: Pairs, shorter: Pairs) -> Iterator[str]:
    """Yield how policies after more steps differ from those after fewer steps, with other seeds.

    All four groups count as independent.
    """
    for column in ("return", "cost"):
        (curriculum, control), (curriculum_before, control_before) = (
            it.groups(column) for it in (pairs, shorter)
        )
        of_curriculum, of_control = [curriculum, curriculum_before], [control, control_before]
        yield f"  {column} under {pairs.curriculum}: {weighted_sum(of_curriculum, [1.0, -1.0])}"
        yield f"  {column} under {pairs.control}: {weighted_sum(of_control, [1.0, -1.0])}"
        change = weighted_sum([*of_curriculum, *of_control], [1.0, -1.0, -1.0, 1.0])
        yield f"  {column}, {pairs.curriculum} minus {pairs.control}: {change}"


def of_task(table: Path, task: str) -> pd.DataFrame:
    """Read the rows of AGENT on one task."""
    rows = pd.read_csv(table)
    return rows[(rows["task"] == task) & (rows["agent"] == AGENT)]


def main() -> None:
    """Print the verdict and the intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("fresh", type=Path)
    parser.add_argument("--controls", type=Path)
    parser.add_argument("--earlier", type=Path, nargs="+", default=[])
    parser.add_argument("--shorter", type=Path)
    given = parser.parse_args()
    if (rule := RULES.get(given.fresh.stem)) is None:
        parser.error(f"{given.fresh}: has no rule; those with one are {', '.join(RULES)}")
    of_rule = [given.fresh, given.controls] if given.controls else [given.fresh]
    fresh = pd.concat(of_task(it, rule.task) for it in of_rule)
    tables = [fresh, *(of_task(it, rule.task) for it in given.earlier)]
    print("\n".join(verdict(fresh, rule)))
    for policy in ("stochastic", "deterministic"):
        print("\n".join(exceeding(fresh[fresh["method"].isin([rule.curriculum, *rule.controls])], policy)))
        for control in rule.controls:
            for count in range(1, 1 + len(tables)):
                pairs = Pairs.of(pd.concat(tables[:count]), policy, rule.curriculum, control)
                print(f"{policy}, {rule.curriculum} minus {control}, {pairs.named_seeds}:")
                print("\n".join(intervals(pairs)))
                within = pairs.kept()
                if 1 < len(within.seeds) < len(pairs.seeds):
                    print(f" of these, where {control} keeps the limit, {within.named_seeds}:")
                    print("\n".join(intervals(within)))
            if given.shorter:
                pairs, shorter = (
                    Pairs.of(rows, policy, rule.curriculum, control)
                    for rows in (fresh, of_task(given.shorter, rule.task))
                )
                print(f"{policy}, these seeds minus {shorter.named_seeds} after fewer steps:")
                print("\n".join(from_shorter(pairs, shorter)))


if __name__ == "__main__":
    main()
