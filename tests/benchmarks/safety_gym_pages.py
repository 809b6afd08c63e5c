"""The tables of the pages on relaxed limits on Safety Gym, made of the rows in results/safety-gym.

    python -m tests.benchmarks.safety_gym_pages

writes them into the pages. ``safety_gym_table.py`` makes the rows from the trials, and then does the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tests.benchmarks.differences import paired_differences
from tests.benchmarks.page_tables import replace_table
from tests.benchmarks.velocity_table import Cell, number

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "safety-gym"
PAGES = ROOT / "docs" / "experiments"
ANSWERS = PAGES / "safety-gym-relaxed-limits.md"
DETAILS = PAGES / "safety-gym-relaxed-limits-details.md"

PILOT = ("curricula-today.csv", "cpo-curricula.csv")
FRESH = "table.csv"
FRESH_PHASE = "table-deployment-phase.csv"
MULTIPLIERS = "multipliers.csv"  # of ppo-lag, in the first and the last update of the deployment phase
CLAIMS = "table-claims.csv"
CONTROLS = ("controls", "early-landing", "short-training")  # with rows of the deployment phase, as the table
AGENTS = ("ppo-lag", "cpo")
TASKS = ("CarGoal2", "CarButton2", "CarPush2")
STEPS_UNDER_LIMIT = ("none", "none-short", "linear", "linear-early")  # differ in these on CarGoal2
NOISE = ("none", "dynamic", "dynamic-without-noise")
CURRICULA = (*STEPS_UNDER_LIMIT, "cosine", "exponential", *NOISE[1:], "step")
PERIODS = ("phase", "first", "last")
POLICIES = ("stochastic", "deterministic")


def rows_of(*names: str) -> pd.DataFrame:
    """Return rows of several files in the results, in the order of the pages."""
    rows = pd.concat([pd.read_csv(RESULTS / name, comment="#") for name in names], ignore_index=True)
    orders = {"agent": AGENTS, "task": TASKS, "method": CURRICULA}
    ranks = [rows[name].map(order.index) for name, order in orders.items()]
    return rows.loc[pd.concat(ranks, axis=1).sort_values(list(orders)).index]


def of_cell(rows: pd.DataFrame, task: str, method: str) -> pd.DataFrame:
    """Return the rows of ppo-lag on one task under one curriculum."""
    return rows[(rows["agent"] == "ppo-lag") & (rows["task"] == task) & (rows["method"] == method)]


def of_question(rows: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """Return the rows of ppo-lag on CarGoal2 under some curricula."""
    chosen = (rows["task"] == "CarGoal2") & (rows["agent"] == "ppo-lag")
    return rows[chosen & rows["method"].isin(methods)]


def groups(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the rows of each agent, task and curriculum, after the first cells of their line."""
    for (agent, task, method), group in rows.groupby(["agent", "task", "method"], sort=False):
        yield f"| `{agent}` | {task} | `{method}` |", group


def costs_of(cell: Cell) -> str:
    """Return the mean cost with its error, for a page."""
    return cell.costs.replace("+-", "±")


def mean_of(rows: pd.DataFrame) -> str:
    """Return the mean return / cost of policies of one task, agent and curriculum."""
    cell = Cell.of("", "", rows)
    return f"{number(cell.episode_return)} / {costs_of(cell)}"


def interval_of(rows: pd.DataFrame) -> str:
    """Return the mean return, with its interval, and the mean cost."""
    cell = Cell.of("", "", rows)
    return f"{cell.interval} / {costs_of(cell)}"


def of_policy(rows: pd.DataFrame, policy: str) -> pd.DataFrame:
    """Return the rows of one kind of policy."""
    return rows[rows["policy"] == policy]


def policies(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of final policies: stochastic ones a column a seed, then the means of either kind."""
    seeds = sorted(rows["seed"].unique())
    columns = [*(f"seed {it}" for it in seeds), "mean", "deterministic, mean"]
    yield f"| agent | task | curriculum | {' | '.join(columns)} |"
    yield "|---" * (3 + len(columns)) + "|"
    for begin, group in groups(rows):
        stochastic, deterministic = (of_policy(group, it) for it in POLICIES)
        of_seed = (
            stochastic.set_index("seed")[["return", "cost"]].map("{:.1f}".format).agg(" / ".join, axis=1)
        )
        each = [str(text) for text in of_seed.reindex(seeds, fill_value="")]
        yield f"{begin} {' | '.join([*each, interval_of(stochastic), interval_of(deterministic)])} |"


def shown(row: pd.Series[Any]) -> str:
    """Return a difference with its interval and its corrected p value."""
    mean, low, high = (number(row[name]) for name in ("return", "low", "high"))
    return f"{mean} ({low} to {high}), p = {row['p_holm']:.2g}"


def differences_of(rows: pd.DataFrame) -> dict[tuple[str, str, str], str]:
    """Return the differences in return from ``none`` of each agent, task and curriculum."""
    table = paired_differences(rows, "none", "return")
    return {(row["agent"], row["task"], row["method"]): shown(row) for _, row in table.iterrows()}


def answers(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of answers: stochastic policies, and differences from none."""
    yield "| agent | task | curriculum | seeds | return / cost | return above `none` |"
    yield "|---" * 6 + "|"
    stochastic = of_policy(rows, "stochastic")
    texts = differences_of(stochastic)
    for begin, group in groups(stochastic):
        key = group[["agent", "task", "method"]].iloc[0]
        yield f"{begin} {len(group)} | {mean_of(group)} | {texts.get(tuple(key), '')} |"


def other_differences(fresh: pd.DataFrame, seen: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the differences from ``none`` that the table of answers does not have."""
    names = "fresh seeds | deterministic, fresh seeds | deterministic, with the pilot"
    yield f"| agent | task | curriculum | {names} |"
    yield "|---" * 6 + "|"
    both = pd.concat([seen, fresh])
    columns = [
        differences_of(of_policy(fresh, "stochastic")),
        differences_of(of_policy(fresh, "deterministic")),
        differences_of(of_policy(both, "deterministic")),
    ]
    for begin, group in groups(fresh):
        key = tuple(group[["agent", "task", "method"]].iloc[0])
        if key in columns[0]:
            yield f"{begin} {' | '.join(column[key] for column in columns)} |"


def deployment_phase(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the deployment phase, means over the seeds."""
    yield "| agent | task | curriculum | whole phase | first 100,000 steps | last 100,000 steps |"
    yield "|---" * 6 + "|"
    for begin, group in groups(rows):
        means = group.groupby("policy")[["return", "cost"]].mean()
        cells = means.apply(lambda it: f"{it['return']:.1f} / {it['cost']:.1f}", axis=1)
        yield f"{begin} {' | '.join(cells[period] for period in PERIODS)} |"


def step_control(final: pd.DataFrame, phase: pd.DataFrame, multipliers: pd.DataFrame) -> Iterator[str]:
    """Yield the table of ``step`` and its controls: deployment phase, final policies, multipliers."""
    yield "| task | curriculum | deployment phase | final policies | multiplier |"
    yield "|---" * 5 + "|"
    tables = of_policy(final, "stochastic"), of_policy(phase, "phase"), multipliers
    for task in final.loc[final["method"] == "step", "task"].unique():
        for method in ("none", "linear", "step"):
            ended, learnt, ends = (of_cell(rows, task, method) for rows in tables)
            means = f"{learnt['return'].mean():.1f} / {learnt['cost'].mean():.1f}"
            moved = f"{ends['first'].mean():.2f}, {ends['last'].mean():.2f}"
            yield f"| {task} | `{method}` | {means} | {mean_of(ended)} | {moved} |"


def claims(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the paper's claims: in how many seeds each holds, on the three tasks in order."""
    yield f"| agent | claim | the paper's gain | final policies on {', '.join(TASKS)} | deployment phase |"
    yield "|---" * 5 + "|"
    parts = rows["claim"].str.extract(r"(?P<text>.*) on (?P<task>Car\w+)(?P<scope>.*)")
    for (text, scope, agent), of_claim in rows.join(parts).groupby(["text", "scope", "agent"], sort=False):
        by_task = of_claim.set_index("task").reindex(TASKS)
        counts = [
            ", ".join(f"{held:.0f} of {seeds:.0f}" for held, seeds in by_task[columns].to_numpy())
            for columns in (["held", "seeds"], ["deployment_held", "deployment_seeds"])
        ]
        in_phase = counts[1] if by_task["deployment_seeds"].any() else ""
        gain = by_task["paper"].fillna("").iloc[0]
        claim = f"{text}{scope}".removeprefix(f"{agent} ")
        yield f"| `{agent}` | {claim} | {gain} | {counts[0]} | {in_phase} |"


def tables() -> Iterator[tuple[Path, str, list[str]]]:
    """Yield the page, the name and the lines of each table."""
    controls = [f"{it}.csv" for it in CONTROLS]
    phases = [f"{it}-deployment-phase.csv" for it in CONTROLS]
    fresh, seen, both = rows_of(FRESH), rows_of(*PILOT), rows_of(*PILOT, FRESH)
    current, everything = rows_of(FRESH, *controls), rows_of(*PILOT, FRESH, *controls)
    phase = rows_of(FRESH_PHASE)
    drawn = (
        (ANSWERS, "answers", answers(both)),
        (ANSWERS, "step", step_control(current, rows_of(FRESH_PHASE, *phases), rows_of(MULTIPLIERS))),
        (DETAILS, "fresh seeds", policies(fresh)),
        (DETAILS, "other differences", other_differences(fresh, seen)),
        (DETAILS, "claims", claims(pd.read_csv(RESULTS / CLAIMS))),
        (DETAILS, "pilot", policies(seen)),
        (DETAILS, "deployment phase", deployment_phase(phase)),
        (DETAILS, "steps under the limit", policies(of_question(everything, STEPS_UNDER_LIMIT))),
        (DETAILS, "noise", policies(of_question(current, NOISE))),
    )
    for page, name, lines in drawn:
        yield page, name, list(lines)


def main() -> None:
    """Write the tables into the pages."""
    for page, name, lines in tables():
        replace_table(page, name, lines)


if __name__ == "__main__":
    main()
