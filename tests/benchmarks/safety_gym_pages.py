"""The tables of the pages on relaxed limits on Safety Gym, made of the rows in results/safety-gym.

    python -m tests.benchmarks.safety_gym_pages

writes them into the pages. ``safety_gym_table.py`` makes the rows from the trials, and then does the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tests.benchmarks.differences import differences_from
from tests.benchmarks.page_tables import replace_table
from tests.benchmarks.velocity_table import Cell, number

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "safety-gym"
PAGES = ROOT / "docs" / "experiments"
ANSWERS = PAGES / "safety-gym-relaxed-limits.md"
DETAILS = PAGES / "safety-gym-relaxed-limits-details.md"
STEPS = PAGES / "safety-gym-seeds-and-steps.md"

PILOT = ("curricula-today.csv", "cpo-curricula.csv")
FRESH = "table.csv"
FRESH_PHASE = "table-deployment-phase.csv"
MULTIPLIERS = "multipliers.csv"  # of ppo-lag, in the first and the last update of the deployment phase
CLAIMS = "table-claims.csv"
CONFIRMATIONS = {  # with earlier rows; the last ones suggested the question
    "button-confirm": (PILOT[0], FRESH),
    "goal-confirm": (FRESH, PILOT[0]),
}
CONTROLS = ("controls", "early-landing", "short-training")  # with rows of the deployment phase, as the table
AGENTS = ("ppo-lag", "cpo")
TASKS = ("CarGoal2", "CarButton2", "CarPush2")
LEVEL_1 = "level1"
PAPER_PRESET = "paper-preset"
LONG, LONG_EARLY = "long-curricula", "long-early"  # the paper's number of steps
LEVEL_1_TASKS = ("CarGoal1", "CarButton1", "CarPush1")
STEPS_UNDER_LIMIT = ("none", "none-short", "linear", "linear-early")  # differ in these on CarGoal2
NOISE = ("none", "dynamic", "dynamic-without-noise")
CURRICULA = (*STEPS_UNDER_LIMIT, "cosine", "exponential", *NOISE[1:], "step")
PERIODS = ("phase", "first", "last")
POLICIES = ("stochastic", "deterministic")
FIRST_COLUMNS = ("agent", "task", "curriculum")

Key = tuple[str, str, str]  # agent, task, curriculum


def rows_of(*names: str) -> pd.DataFrame:
    """Return rows of several files in the results, in the order of the pages."""
    rows = pd.concat([pd.read_csv(RESULTS / name, comment="#") for name in names], ignore_index=True)
    orders = {"agent": AGENTS, "task": (*TASKS, *LEVEL_1_TASKS), "method": CURRICULA}
    ranks = [rows[name].map(order.index) for name, order in orders.items()]
    return rows.loc[pd.concat(ranks, axis=1).sort_values(list(orders)).index]


def of_cell(rows: pd.DataFrame, task: str, method: str) -> pd.DataFrame:
    """Return the rows of ppo-lag on one task under one curriculum."""
    return rows[(rows["agent"] == "ppo-lag") & (rows["task"] == task) & (rows["method"] == method)]


def of_question(rows: pd.DataFrame, methods: Sequence[str], tasks: Sequence[str] = TASKS[:1]) -> pd.DataFrame:
    """Return the rows of ppo-lag on some tasks, by default CarGoal2, under some curricula."""
    chosen = rows["task"].isin(tasks) & (rows["agent"] == "ppo-lag")
    return rows[chosen & rows["method"].isin(methods)]


def groups(rows: pd.DataFrame) -> Iterator[tuple[Key, pd.DataFrame]]:
    """Yield the rows of each agent, task and curriculum."""
    for (agent, task, method), group in rows.groupby(["agent", "task", "method"], sort=False):
        yield (str(agent), str(task), str(method)), group


def line(*cells: str) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(cells)} |"


def header(*columns: str) -> tuple[str, str]:
    """Return the first two lines of a table."""
    return line(*columns), "|---" * len(columns) + "|"


def first_cells(key: Key) -> tuple[str, str, str]:
    """Return the cells of an agent, a task and a curriculum."""
    agent, task, method = key
    return f"`{agent}`", task, f"`{method}`"


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
    """Yield a table of final policies: stochastic ones with each seed, then the means of either kind.

    A row is an agent, a task and a curriculum. If there is one agent and one task only, these are columns.
    """
    seeds = sorted(rows["seed"].unique())
    ends = ["mean", "deterministic, mean"]
    table = {key: [*of_seeds(group, seeds), *means_of(group)] for key, group in groups(rows)}
    if len(rows[["agent", "task"]].drop_duplicates()) == 1:
        yield from header("seed", *(f"`{method}`" for _, _, method in table))
        for row in zip([*map(str, seeds), *ends], *table.values(), strict=True):
            yield line(*row)
        return
    yield from header(*FIRST_COLUMNS, *(f"seed {it}" for it in seeds), *ends)
    for key, cells in table.items():
        yield line(*first_cells(key), *cells)


def of_seeds(rows: pd.DataFrame, seeds: list[int]) -> list[str]:
    """Return the return / cost of the stochastic policy of each seed; empty where there is none."""
    measured = of_policy(rows, "stochastic").set_index("seed")[["return", "cost"]]
    texts = measured.map("{:.1f}".format).agg(" / ".join, axis=1)
    return [str(text) for text in texts.reindex(seeds, fill_value="")]


def means_of(rows: pd.DataFrame) -> list[str]:
    """Return the mean return, with its interval, and the mean cost of either kind of policy."""
    return [interval_of(of_policy(rows, it)) for it in POLICIES]


def shown(row: pd.Series[Any]) -> str:
    """Return a difference with its interval and its corrected p value."""
    mean, low, high = (number(row[name]) for name in ("return", "low", "high"))
    return f"{mean} ({low} to {high}), p = {row['p_holm']:.2g}"


def differences_of(rows: pd.DataFrame) -> dict[Key, str]:
    """Return the differences in return from ``none`` of each agent, task and curriculum.

    They are those of two groups, because equal seeds of different machines are no pairs.
    """
    table = differences_from(rows, "none", "return", as_groups=True)
    return {(row["agent"], row["task"], row["method"]): shown(row) for _, row in table.iterrows()}


def answers(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of answers: stochastic policies, and differences from none."""
    yield from header(*FIRST_COLUMNS, "seeds", "return / cost", "return above `none`")
    stochastic = of_policy(rows, "stochastic")
    texts = differences_of(stochastic)
    for key, group in groups(stochastic):
        yield line(*first_cells(key), str(len(group)), mean_of(group), texts.get(key, ""))


def other_differences(fresh: pd.DataFrame, seen: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the differences from ``none`` that the table of answers does not have."""
    names = ("fresh seeds", "deterministic, fresh seeds", "deterministic, with the pilot")
    yield from header(*FIRST_COLUMNS, *names)
    both = pd.concat([seen, fresh])
    columns = [
        differences_of(of_policy(fresh, "stochastic")),
        differences_of(of_policy(fresh, "deterministic")),
        differences_of(of_policy(both, "deterministic")),
    ]
    for key, _ in groups(fresh):
        if key in columns[0]:
            yield line(*first_cells(key), *(column[key] for column in columns))


def deployment_phase(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the deployment phase, means over the seeds."""
    yield from header(*FIRST_COLUMNS, "whole phase", "first 100,000 steps", "last 100,000 steps")
    for key, group in groups(rows):
        means = group.groupby("policy")[["return", "cost"]].mean()
        cells = means.apply(lambda it: f"{it['return']:.1f} / {it['cost']:.1f}", axis=1)
        yield line(*first_cells(key), *(str(cells[period]) for period in PERIODS))


def step_control(final: pd.DataFrame, phase: pd.DataFrame, multipliers: pd.DataFrame) -> Iterator[str]:
    """Yield the table of ``step`` and its controls: deployment phase, final policies, multipliers."""
    yield from header("task", "curriculum", "deployment phase", "final policies", "multiplier")
    tables = of_policy(final, "stochastic"), of_policy(phase, "phase"), multipliers
    for task in final.loc[final["method"] == "step", "task"].unique():
        for method in ("none", "linear", "step"):
            ended, learnt, ends = (of_cell(rows, task, method) for rows in tables)
            means = f"{learnt['return'].mean():.1f} / {learnt['cost'].mean():.1f}"
            moved = f"{ends['first'].mean():.2f}, {ends['last'].mean():.2f}"
            yield line(task, f"`{method}`", means, mean_of(ended), moved)


def claims(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the table of the paper's claims: in how many seeds each holds, on the three tasks in order."""
    final = f"final policies on {', '.join(TASKS)}"
    yield from header("agent", "claim", "the paper's gain", final, "deployment phase")
    parts = rows["claim"].str.extract(r"(?P<text>.*) on (?P<task>Car\w+)")
    for (text, agent), of_claim in rows.join(parts).groupby(["text", "agent"], sort=False):
        by_task = of_claim.set_index("task").loc[list(TASKS)]
        gain = by_task["paper"].fillna("").iloc[0]
        in_phase = seeds_in_which(by_task, "deployment_") if by_task["deployment_seeds"].any() else ""
        claim = str(text).removeprefix(f"{agent} ")
        yield line(f"`{agent}`", claim, gain, seeds_in_which(by_task, ""), in_phase)


def seeds_in_which(claim: pd.DataFrame, measure: str) -> str:
    """Return in how many seeds a claim holds, for each row, by the final policies or ``deployment_``.

    If it compares returns, the number of pairs whose two policies keep the limit follows where it is not all.
    """
    texts = []
    for _, row in claim.iterrows():
        held, seeds, feasible = (row[f"{measure}{name}"] for name in ("held", "seeds", "feasible_pairs"))
        few = "" if pd.isna(feasible) or feasible == seeds else f" ({feasible:.0f})"
        texts.append(f"{held} of {seeds}{few}")
    return ", ".join(texts)


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
        *(
            (DETAILS, name, policies(rows_of(f"{name}.csv")))
            for name in (*CONFIRMATIONS, LEVEL_1, PAPER_PRESET)
        ),
        (STEPS, LONG, policies(rows_of(f"{LONG}.csv", f"{LONG_EARLY}.csv"))),
        (DETAILS, "steps under the limit", policies(of_question(everything, STEPS_UNDER_LIMIT))),
        (DETAILS, "noise", policies(of_question(current, NOISE, TASKS))),
    )
    for page, name, lines in drawn:
        yield page, name, list(lines)


def main() -> None:
    """Write the tables into the pages."""
    for page, name, lines in tables():
        replace_table(page, name, lines)


if __name__ == "__main__":
    main()
