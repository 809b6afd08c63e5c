"""A report's first lines: verdicts, counted and in words."""

import dataclasses
import math
from html import unescape

import pandas as pd
import pytest

from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import html_page, verdict_texts
from recrl.analysis.statistics.verdict_counts import count_verdicts

NONE_COMPARED = pd.DataFrame()


def outcome(method: str, seed: int, value: float, cost: float, **others: object) -> dict[str, object]:
    """A final policy on a task with limit 5 and optimum 9.5."""
    feasible = cost <= 5.05
    return {
        "task": "river",
        "agent": "cpo",
        "method": method,
        "seed": seed,
        "measure": "stochastic",
        "episodes": 100,
        "exact": True,
        "episode_return": value,
        "cost_0": cost,
        "deploy_limit_0": 5.0,
        "optimal_return": 9.5,
        "feasible": feasible,
        "optimal": feasible and value >= 9.3,
        **others,
    }


ROWS = [
    outcome("none", 0, -20.0, 0.0),
    outcome("none", 1, 9.5, 5.0),
    outcome("linear", 0, 9.6, 6.0),
    outcome("linear", 1, 9.6, 7.0),
    outcome("dynamic", 0, 9.5, 5.0),
    outcome("dynamic", 1, 9.4, 5.0),
    outcome("none", 0, 1.0, 50.0, measure="deployment"),
    outcome("none", 1, 3.0, 50.0, measure="deployment"),
]


def judged(rows: list[dict[str, object]]) -> pd.DataFrame:
    flags = pd.DataFrame(rows)[[*KEY, "measure"]].query("measure == 'stochastic'")[list(KEY)]
    return count_verdicts(
        pd.DataFrame(rows), NONE_COMPARED, flags.assign(no_curriculum=False, hard_landing=False)
    )


def test_seeds_are_counted_by_the_final_policy_only() -> None:
    table = judged(ROWS).set_index("method")
    counts = table[["seeds", "solved", "feasible", "infeasible"]]
    assert list(counts.loc["none"]) == [2, 1, 2, 0]
    assert list(counts.loc["linear"]) == [2, 0, 0, 2]
    assert list(counts.loc["dynamic"]) == [2, 2, 2, 0]
    assert list(table.loc["linear", ["worst_excess", "worst_share"]]) == [2.0, 0.4]
    assert list(table.loc["none", ["deployment_return", "deployment_cost_0"]]) == [2.0, 50.0]


def test_the_worst_cost_is_the_one_that_is_furthest_over_its_limit() -> None:
    others = {"cost_1": 3.0, "deploy_limit_1": 1.0, "feasible": False}
    row = judged([outcome("none", 0, 9.5, 5.5, **others)]).iloc[0]
    assert (row["worst_excess"], row["worst_share"]) == (2.0, 2.0)
    assert (row["worst_cost"], row["cost_name_0"], row["cost_name_1"]) == ("1", "0", "1")
    table = verdict_texts.verdict_table(
        judged([outcome("none", 0, 9.5, 5.5, **others)]).assign(cost_1_se=0.0)
    )
    assert {"cost 0", "limit 1"} <= set(table)


def test_the_table_says_the_verdict_in_words() -> None:
    table = verdict_texts.verdict_table(judged(ROWS))
    assert table["verdict"].tolist() == [
        "solved 1 of 2; feasible, not solved 1 of 2",
        "infeasible by up to 2.00 (40%)",
        "solved",
    ]
    assert verdict_texts.verdict_kinds(judged(ROWS)) == ["feasible", "infeasible", "solved"]
    assert table["n"].tolist() == ["2", "2", "2"]
    assert table[verdict_texts.DEPLOYMENT].iloc[0] == "return 2.00 ± 1.00, cost 50.000 ± 0.000"
    assert table["cost"].tolist() == ["2.500 ± 2.500", "6.500 ± 0.500", "5.000 ± 0.000"]


def test_warnings_stand_beside_the_verdict_they_concern() -> None:
    table = judged(ROWS)
    assert "warning" not in verdict_texts.verdict_table(table)
    table.loc[table["method"] == "dynamic", ["no_curriculum", "hard_landing"]] = [1, 2]
    shown = verdict_texts.verdict_table(table)
    assert shown["warning"].tolist() == ["", "", "curriculum without effect 1 of 2; hard landing"]
    assert list(shown).index("warning") == list(shown).index("verdict") + 1
    assert "Hard landing: more than 10% of the way" in verdict_texts.explanation(table)[-1]


def test_one_seed_has_no_interval() -> None:
    table = verdict_texts.verdict_table(judged(ROWS[:1]))
    assert table["return"].tolist() == ["-20.00"]
    assert table["cost"].tolist() == ["0.000"]
    deployed = verdict_texts.verdict_table(judged([ROWS[0], ROWS[6]]))[verdict_texts.DEPLOYMENT]
    assert deployed.tolist() == ["return 1.00, cost 50.000"]
    assert table["verdict"].tolist() == ["feasible"]


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (
            ROWS,
            "river: 3 of 6 final policies (1 agent x 3 curricula x 2 seeds) solve it, most often with "
            "dynamic (2 of 2), against 1 of 2 with none; linear exceeds the limit of 5 by up to 2.00 (2 of 2 "
            "policies).",
        ),
        (ROWS[4:6], "river: all 2 final policies (1 agent x 1 curriculum x 2 seeds) solve it."),
        (
            ROWS[2:4],
            "river: none of 2 final policies (1 agent x 1 curriculum x 2 seeds) solves it; linear exceeds "
            "the limit of 5 by up to 2.00 (2 of 2 policies).",
        ),
        (
            [row | {"optimal_return": math.nan, "optimal": False} for row in ROWS[:4]],
            "river: 2 of 4 final policies (1 agent x 2 curricula x 2 seeds) are feasible, most often with "
            "none (2 of 2); linear exceeds the limit of 5 by up to 2.00 (2 of 2 policies).",
        ),
        ([row | {"optimal_return": -math.inf} for row in ROWS], "river: no policy keeps the limits."),
    ],
)
def test_a_sentence_a_task(rows: list[dict[str, object]], sentence: str) -> None:
    assert verdict_texts.answers(judged(rows)) == [sentence]


def test_each_curriculum_that_violates_is_named_with_its_excess() -> None:
    """One seed, two agents: linear and cosine always violate, dynamic with one agent of two."""
    rows = [
        outcome("none", 0, 9.5, 5.0),
        outcome("none", 0, 9.5, 5.0, agent="ppo"),
        outcome("linear", 0, 9.5, 9.0),
        outcome("linear", 0, 9.5, 9.06, agent="ppo"),
        outcome("cosine", 0, 9.5, 9.0),
        outcome("cosine", 0, 9.5, 9.0, agent="ppo"),
        outcome("dynamic", 0, 9.5, 5.084),
        outcome("dynamic", 0, 9.5, 5.0, agent="ppo"),
    ]
    assert verdict_texts.answers(judged(rows)) == [
        "One seed (n = 1): no intervals, and another seed may give another verdict.",
        "river: 3 of 8 final policies (2 agents x 4 curricula x 1 seed) solve it, most often with none (2 of "
        "2); linear and cosine exceed the limit of 5 by 4.00 to 4.06 (4 of 4 policies); dynamic solves 1 of "
        "2, the other exceeds it by 0.084.",
    ]


def test_each_task_says_what_its_limits_mean(finished: Sweep) -> None:
    table = judged([outcome("none", 0, 9.5, 5.0, task="river-a")])
    (sentence,) = verdict_texts.task_sentences(finished, table)
    assert sentence == (
        "river-a: A camp and a mine, one cost, closed-form optimum: for testing learners. Limit: 5 per "
        "episode, allowed 5.05 (1%, exact). Training limit d_t: 100.0, from the grid."
    )


@pytest.mark.parametrize(
    ("train_limits", "start_limits", "said"),
    [
        ([60.0, 60.0], [60.0, 60.0], " Training limit d_t: 60.00, from the grid."),
        (
            [math.inf, math.inf],
            [61.52, math.inf],
            " Training limit d_t: 61.52, measured at the start of training.",
        ),
        (
            [math.inf, 60.0],
            [61.52, 60.0],
            " Training limit d_t: 61.52, measured at the start of training, and 60.00, from the grid.",
        ),
        ([math.inf, math.inf], [math.inf, math.nan], ""),
    ],
)
def test_only_a_measured_training_limit_is_said_to_be_measured(
    finished: Sweep, train_limits: list[float], start_limits: list[float], said: str
) -> None:
    chosen = (finished.trials["task"] == "river-a") & (finished.trials["method"] == "linear")
    trials = finished.trials[chosen].head(2).assign(train_limit_0=train_limits, start_limit_0=start_limits)
    table = judged([outcome("linear", 0, 9.5, 5.0, task="river-a")])
    (sentence,) = verdict_texts.task_sentences(dataclasses.replace(finished, trials=trials), table)
    assert sentence.endswith(f"allowed 5.05 (1%, exact).{said}")


def test_violators_are_marked_by_text_and_colour() -> None:
    table = judged(ROWS)
    html = html_page.verdict_table(verdict_texts.verdict_table(table), verdict_texts.verdict_kinds(table))
    assert '<tr class="infeasible"><td class="name">river</td><td class="name">cpo</td>' in html
    assert '<td class="name"><small>river cpo</small>linear</td>' in html
    assert '<td class="verdict">infeasible by up to 2.00 (40%)</td>' in unescape(html)
    assert "tr.infeasible" in html_page.STYLE


def test_sampled_policies_are_said_to_be_sampled() -> None:
    sampled = judged([outcome("none", 0, 9.5, 5.0, exact=False, episodes=30)])
    assert "means over 30 episodes" in verdict_texts.explanation(sampled)[0]
    assert "computed exactly" in verdict_texts.explanation(judged(ROWS))[0]
