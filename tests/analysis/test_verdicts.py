"""A report's first lines: verdicts, counted and in words."""

import dataclasses
import math
from html import unescape

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import html_page
from recrl.analysis.report.verdict_answers import ONE_RESULT, answers
from recrl.analysis.report.verdict_table import DEPLOYMENT, verdict_kinds, verdict_table, verdict_text
from recrl.analysis.report.verdict_terms import all_exact, explanation, task_sentences, tolerance_sentence
from recrl.analysis.statistics.comparisons import comparisons
from recrl.analysis.statistics.verdict_counts import count_verdicts
from recrl.analysis.statistics.verdicts import exceeded_costs, within_limits

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


def test_under_a_limit_of_0_no_standard_error_is_allowed() -> None:
    """If one of n episodes has a cost, the mean is one standard error, however large the cost is."""
    costs = np.zeros(100)
    costs[3] = 1_000.0
    error = costs.std(ddof=1) / np.sqrt(len(costs))
    assert costs.mean() == pytest.approx(error)
    rows = pd.DataFrame(
        {
            "cost_0": [10.0, 0.01, 0.02, 10.0],
            "cost_0_se": [error, 0.01, 0.014, error],  # of costs of 1000, 1 and twice 1 in 100 episodes
            "deploy_limit_0": [0.0, 0.0, 0.0, 5.0],
        }
    )
    assert within_limits(rows).tolist() == [False, True, False, True]


def test_the_tolerance_of_a_limit_of_0_is_said_where_there_is_one() -> None:
    rows = pd.DataFrame({"deploy_limit_0": [5.0], "deploy_limit_1": [math.nan]})
    assert tolerance_sentence(rows, exact=True) == (
        "Feasible: no mean cost exceeds its limit by more than 1%."
    )
    assert tolerance_sentence(rows.assign(deploy_limit_1=0.0), exact=True) == (
        "Feasible: no mean cost exceeds its limit by more than 1%, and a limit of 0 by more than 0.01."
    )


def trials_of(rows: list[dict[str, object]], **states: list[dict[str, object]]) -> pd.DataFrame:
    """The trials of these outcomes, and others that have none, by their status."""
    columns = [*KEY, "deploy_limit_0", "optimal_return"]
    columns += ["deploy_limit_1"] * ("deploy_limit_1" in rows[0])
    found = pd.DataFrame(rows).drop_duplicates(list(KEY))[columns].assign(status="complete")
    others = [pd.DataFrame(made)[columns].assign(status=status) for status, made in states.items()]
    return pd.concat([found, *others], ignore_index=True)


def judged(rows: list[dict[str, object]], **states: list[dict[str, object]]) -> pd.DataFrame:
    trials = trials_of(rows, **states)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    return count_verdicts(pd.DataFrame(rows), NONE_COMPARED, flags, trials)


def test_seeds_are_counted_by_the_final_policy_only() -> None:
    table = judged(ROWS).set_index("method")
    counts = table[["seeds", "solved", "feasible", "infeasible"]]
    assert list(counts.loc["none"]) == [2, 1, 2, 0]
    assert list(counts.loc["linear"]) == [2, 0, 0, 2]
    assert list(counts.loc["dynamic"]) == [2, 2, 2, 0]
    assert list(table.loc["linear", ["exceeded_0", "excess_0_low", "excess_0_high"]]) == [2, 1.0, 2.0]
    assert "cost_name_0" not in table
    assert list(table.loc["none", ["deployment_return", "deployment_cost_0"]]) == [2.0, 50.0]


def test_costs_without_a_name_have_their_numbers() -> None:
    others = {"cost_1": 3.0, "deploy_limit_1": 1.0, "feasible": False}
    counted = judged([outcome("none", 0, 9.5, 5.5, **others)])
    assert list(counted.loc[0, ["cost_name_0", "cost_name_1"]]) == ["0", "1"]
    table = verdict_table(counted.assign(cost_1_se=0.0))
    assert table["verdict"].tolist() == ["infeasible: cost 0 by 0.50 (10%), cost 1 by 2.00 (200%)"]
    assert {"cost 0", "limit 1"} <= set(table)


def test_a_cost_within_its_tolerance_is_not_exceeded_and_a_limit_of_0_has_no_share() -> None:
    limits = {"deploy_limit_0": 5.0, "deploy_limit_1": 1000.0, "feasible": False}
    sampled = {"cost_0_se": 0.0, "cost_1_se": 200.0}
    tolerated = judged([outcome("none", 0, 9.5, 5.5, cost_1=1150.0, **limits, **sampled)]).iloc[0]
    assert list(tolerated[["exceeded_0", "excess_0_low", "excess_0_high", "exceeded_1"]]) == [1, 0.5, 0.5, 0]
    assert tolerated[["excess_1_low", "excess_1_high"]].isna().all()
    assert verdict_text(tolerated) == "infeasible: cost 0 by 0.50 (10%)"
    both = judged([outcome("none", 0, 9.5, 5.5, cost_1=1050.0, cost_1_se=1.0, **limits)]).iloc[0]
    assert verdict_text(both) == "infeasible: cost 0 by 0.50 (10%), cost 1 by 50.00 (5%)"
    zero = judged([outcome("none", 0, 9.5, 50.0, cost_1=0.1, **{**limits, "deploy_limit_1": 0.0})]).iloc[0]
    assert verdict_text(zero) == "infeasible: cost 0 by 45.00 (900%), cost 1 by 0.10"


def test_a_missing_cost_is_infeasible_by_an_unknown_amount() -> None:
    (sentence,) = answers(judged([outcome("none", seed, 9.5, math.nan) for seed in range(2)]))
    assert sentence.endswith("'none' exceeds the limit of 5 by an unknown amount (2 of 2 policies).")
    others = {"cost_1": math.nan, "deploy_limit_1": 1.0, "feasible": False, "optimal": False}
    table = judged([outcome("none", seed, 9.5, 5.0, **others) for seed in range(2)])
    assert verdict_text(table.iloc[0]) == "infeasible: by an unknown amount"
    assert answers(table)[0].endswith("'none' exceeds a limit (2 of 2 policies): –.")


def test_a_sweep_without_trials_exceeds_no_limit() -> None:
    none = pd.DataFrame(columns=list(KEY))
    assert exceeded_costs(none).shape == (0, 0)
    no_rows = pd.DataFrame(ROWS).iloc[:0]
    assert exceeded_costs(no_rows).columns.tolist() == ["excess_0"]


def test_warnings_of_a_curriculum_are_summed_over_its_seeds() -> None:
    trials = trials_of(ROWS)
    linear = trials["method"] == "linear"
    flags = trials[list(KEY)].assign(no_curriculum=linear, hard_landing=linear & (trials["seed"] == 0))
    table = count_verdicts(pd.DataFrame(ROWS), NONE_COMPARED, flags, trials).set_index("method")
    assert table["no_curriculum"].to_dict() == {"none": 0, "linear": 2, "dynamic": 0}
    assert table["hard_landing"].to_dict() == {"none": 0, "linear": 1, "dynamic": 0}


def test_several_intervals_are_said_to_be_uncorrected() -> None:
    rows = [
        outcome(method, seed, 9.0 + value * (seed + 1), 5.0)
        for method, value in (("none", 0.0), ("linear", 0.1), ("dynamic", 0.2))
        for seed in range(2)
    ]
    trials = trials_of(rows)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    compared = comparisons(pd.DataFrame(rows), np.random.default_rng(0))
    table = count_verdicts(pd.DataFrame(rows), compared, flags, trials)
    sentence = "Intervals in this table: 2, of 95% each, not corrected for their number."
    assert sentence in explanation(table)
    one = table[table["method"] != "linear"]
    assert not any("not corrected" in sentence for sentence in explanation(one))


def test_the_table_says_the_verdict_in_words() -> None:
    table = verdict_table(judged(ROWS))
    assert table["verdict"].tolist() == [
        "solved 1 of 2; feasible, not solved 1 of 2",
        "infeasible by up to 2.00 (40%)",
        "solved",
    ]
    assert verdict_kinds(judged(ROWS)) == ["feasible", "infeasible", "solved"]
    assert table["n"].tolist() == ["2", "2", "2"]
    assert table[DEPLOYMENT].iloc[0] == "return 2.00 ± 1.00, cost 50.00 ± 0.00"
    assert table["cost"].tolist() == ["2.500 ± 2.500", "6.500 ± 0.500", "5.000 ± 0.000"]


def test_warnings_stand_beside_the_verdict_they_concern() -> None:
    table = judged(ROWS)
    assert "warning" not in verdict_table(table)
    table.loc[table["method"] == "dynamic", ["no_curriculum", "hard_landing"]] = [1, 2]
    shown = verdict_table(table)
    assert shown["warning"].tolist() == ["", "", "curriculum without effect 1 of 2; hard landing"]
    assert list(shown).index("warning") == list(shown).index("verdict") + 1
    assert "Hard landing: more than 10% of the way" in explanation(table)[-1]


def test_one_seed_has_no_interval() -> None:
    table = verdict_table(judged(ROWS[:1]))
    assert table["return"].tolist() == ["-20.00"]
    assert table["cost"].tolist() == ["0.000"]
    deployed = verdict_table(judged([ROWS[0], ROWS[6]]))[DEPLOYMENT]
    assert deployed.tolist() == ["return 1.00, cost 50.00"]
    assert table["verdict"].tolist() == ["feasible"]


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (
            ROWS,
            "river: 3 of 6 final policies (1 agent x 3 curricula x 2 seeds) solve it, most often with "
            "'dynamic' (2 of 2), against 1 of 2 with 'none'; 'linear' exceeds the limit of 5 by 1.00 to "
            "2.00 (2 of 2 policies).",
        ),
        (ROWS[4:6], "river: all 2 final policies (1 agent x 1 curriculum x 2 seeds) solve it."),
        (
            ROWS[2:4],
            "river: none of 2 final policies (1 agent x 1 curriculum x 2 seeds) solves it; 'linear' exceeds "
            "the limit of 5 by 1.00 to 2.00 (2 of 2 policies).",
        ),
        (
            [row | {"optimal_return": math.nan, "optimal": False} for row in ROWS[:4]],
            "river: 2 of 4 final policies (1 agent x 2 curricula x 2 seeds) are feasible, most often with "
            "'none' (2 of 2); 'linear' exceeds the limit of 5 by 1.00 to 2.00 (2 of 2 policies).",
        ),
        ([row | {"optimal_return": -math.inf} for row in ROWS], "river: no policy keeps the limits."),
    ],
)
def test_a_sentence_a_task(rows: list[dict[str, object]], sentence: str) -> None:
    assert answers(judged(rows)) == [sentence]


FAILED = [outcome("none", seed, 0.0, 0.0) for seed in (2, 3, 4)]
FAILED += [outcome("dynamic", seed, 0.0, 0.0) for seed in (2, 3, 4)]


def test_failed_trials_are_neither_solved_nor_left_out() -> None:
    table = judged([*ROWS[4:6], *(row | {"method": "none"} for row in ROWS[4:6])], failed=FAILED)
    assert verdict_table(table)["verdict"].tolist() == ["solved 2 of 5; failed 3 of 5"] * 2
    assert verdict_table(table)["n"].tolist() == ["2", "2"]
    assert verdict_kinds(table) == ["failed", "failed"]
    assert answers(table) == ["river: 4 of 10 trials (1 agent x 2 curricula x 5 seeds) solve it; 6 failed."]
    assert any(sentence.startswith("Failed: ") for sentence in explanation(table))


def test_the_best_curriculum_is_that_with_the_most_successes_of_all_its_trials() -> None:
    rows = [*(outcome("none", seed, 9.5, 5.0) for seed in range(3)), outcome("none", 3, 9.6, 6.0)]
    rows.append(outcome("dynamic", 0, 9.5, 5.0))
    failed = [outcome("dynamic", seed, 0.0, 0.0) for seed in (1, 2, 3)]
    assert answers(judged(rows, failed=failed)) == [
        "river: 4 of 8 trials (1 agent x 2 curricula x 4 seeds) solve it, most often with 'none' (3 of 4); 3 "
        "failed; 'none' solves 3 of 4, 1 exceeds the limit of 5 by 1.00."
    ]


def test_no_curriculum_is_best_where_agents_have_unequal_numbers_of_trials() -> None:
    """Under none ppo solves more; cpo, which solves less, has run under none only."""
    rows = [outcome("none", seed, 9.5, 5.0, agent="ppo") for seed in range(5)]
    rows += [outcome("linear", seed, 9.5, 5.0, agent="ppo") for seed in range(4)]
    rows += [outcome("linear", 4, 9.6, 6.0, agent="ppo")]
    rows += [outcome("none", seed, 9.6, 6.0) for seed in range(5)]
    waiting = [outcome("linear", seed, 0.0, 0.0) for seed in range(5)]
    assert "most often" not in " ".join(answers(judged(rows, waiting=waiting)))
    assert "most often" in " ".join(answers(judged(rows[:10])))
    even = [
        outcome(it, seed, 9.5, 5.0, agent=agent)
        for it in ("none", "linear")
        for seed in (0, 1)
        for agent in "ab"
    ]
    even[-1] = outcome("linear", 1, 9.6, 6.0, agent="b")
    waiting = [outcome("dynamic", seed, 0.0, 0.0, agent=agent) for seed in (0, 1) for agent in "ab"]
    assert "most often with 'none' (4 of 4)" in " ".join(answers(judged(even, waiting=waiting)))


def test_policies_that_only_their_standard_error_makes_feasible_are_counted() -> None:
    costs = ((5.0, 0.3), (5.2, 0.3), (5.04, 0.3), (5.6, 0.3))  # allowed without the error: 5.05
    rows = [
        outcome("none", seed, 9.0, cost, cost_0_se=error, feasible=cost <= 5.0 + error, exact=False)
        for seed, (cost, error) in enumerate(costs)
    ]
    table = judged(rows)
    assert table[["feasible", "feasible_by_error"]].to_numpy().tolist() == [[3, 1]]
    said = " ".join(explanation(table))
    assert "Feasible only because of a standard error: 1 of 3. Their mean cost is more than 1% above" in said
    assert "standard error: " not in " ".join(explanation(judged(ROWS)))


def test_a_curriculum_of_which_every_trial_failed_has_a_row() -> None:
    table = judged(ROWS[4:6], failed=FAILED[:3])
    assert table["method"].tolist() == ["dynamic", "none"]
    assert verdict_table(table)["verdict"].tolist() == ["solved", "failed"]
    assert verdict_table(table)["return"].tolist() == ["9.45 ± 0.05", "–"]
    assert "computed exactly" in explanation(table)[0]


def test_one_final_policy_beside_failed_trials_is_not_called_one_seed() -> None:
    assert answers(judged(ROWS[4:5]))[0].startswith("One seed (n = 1)")
    assert answers(judged(ROWS[4:5], failed=FAILED[3:]))[0] == ONE_RESULT


def test_numbers_that_do_not_exist_are_not_exact() -> None:
    lost = [outcome("none", 0, 0.0, 0.0, task="other")]
    table = judged(ROWS[4:6], failed=lost)
    assert all_exact(table)
    assert not all_exact(table[table["task"] == "other"])


def test_an_incomplete_sweep_says_so_and_counts_what_waits_neither_way() -> None:
    waiting = [outcome("dynamic", seed, 0.0, 0.0) for seed in (2, 3)]
    table = judged(ROWS[4:6], waiting=waiting[:1], running=waiting[1:])
    assert answers(table) == [
        "river: 2 of 4 trials (1 agent x 1 curriculum x 4 seeds) solve it so far; the sweep is incomplete: 2 "
        "trials have no result yet."
    ]
    assert verdict_table(table)["verdict"].tolist() == ["solved 2 of 4; no result yet 2 of 4"]
    assert verdict_kinds(table) == ["feasible"]
    pending = [outcome("linear", seed, 0.0, 0.0) for seed in range(2)]
    table = judged(ROWS[4:6], waiting=pending)
    assert verdict_table(table)["verdict"].tolist() == ["solved", "no result yet"]
    assert verdict_kinds(table) == ["solved", "no result yet"]
    html = html_page.verdict_table(verdict_table(table), verdict_kinds(table))
    assert '<tr class="no-result-yet">' in html
    table = judged(ROWS[4:6], waiting=pending[:1], failed=pending[1:])
    assert verdict_kinds(table) == ["solved", "failed"]
    table = judged(ROWS[4:6], complete=pending)  # without evaluation episodes
    assert verdict_kinds(table) == ["solved", "not evaluated"]


@pytest.mark.parametrize(
    ("states", "sentence"),
    [
        ({"failed": [1, 2]}, "other: no verdict; all 2 trials failed."),
        (
            {"failed": [1], "damaged": [2]},
            "other: no verdict; 1 failed; the sweep is incomplete: 1 trial has no result yet.",
        ),
        (
            {"complete": [1, 2]},
            "other: no verdict; 2 final policies were not evaluated: set run.evaluation_episodes.",
        ),
    ],
)
def test_a_task_without_a_final_policy_says_why(states: dict[str, list[int]], sentence: str) -> None:
    other = {
        status: [outcome("none", seed, 0.0, 0.0, task="other") for seed in seeds]
        for status, seeds in states.items()
    }
    assert answers(judged(ROWS[4:6], **other))[1] == sentence


def test_a_difference_to_none_needs_feasible_policies_on_both_sides() -> None:
    rows = [
        *(outcome("none", seed, 9.0, 6.0 if seed == 1 else 5.0) for seed in range(3)),
        *(outcome("linear", seed, 9.4 + 0.1 * seed, 5.0) for seed in range(3)),
    ]
    trials = trials_of(rows)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    for none, shown in (
        (rows[:3], "–"),
        ([row | {"feasible": True} for row in rows[:3]], "0.50 [0.25, 0.75]"),
    ):
        made = pd.DataFrame([*none, *rows[3:]])
        compared = comparisons(made, np.random.default_rng(0))
        table = verdict_table(count_verdicts(made, compared, flags, trials))
        assert table["difference to none"].tolist() == ["–", shown]
        assert compared["feasible_pairs"].tolist() == [2 if shown == "–" else 3]
        assert compared["return_difference"].tolist() == pytest.approx([0.5])


def test_a_difference_over_fewer_seeds_has_its_own_number() -> None:
    rows = [outcome("none", 0, 9.0, 5.0), *(outcome("linear", seed, 9.5, 5.0) for seed in range(3))]
    trials = trials_of(rows)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    compared = comparisons(pd.DataFrame(rows), np.random.default_rng(0))
    table = verdict_table(count_verdicts(pd.DataFrame(rows), compared, flags, trials))
    assert table["difference to none"].tolist() == ["–", "0.50 (n = 1)"]
    assert table["n"].tolist() == ["1", "3"]


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
    assert answers(judged(rows)) == [
        "One seed (n = 1): no intervals, and another seed may give another verdict.",
        "river: 3 of 8 final policies (2 agents x 4 curricula x 1 seed) solve it, most often with 'none' (2 "
        "of 2); 'linear' and 'cosine' exceed the limit of 5 by 4.00 to 4.06 (4 of 4 policies); 'dynamic' "
        "solves 1 of 2, the other exceeds it by 0.084.",
    ]


def test_each_task_says_what_its_limits_mean(finished: Sweep) -> None:
    table = judged([outcome("none", 0, 9.5, 5.0, task="river-a")])
    (sentence,) = task_sentences(finished, table)
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
    (sentence,) = task_sentences(dataclasses.replace(finished, trials=trials), table)
    assert sentence.endswith(f"allowed 5.05 (1%, exact).{said}")
    cooled = trials.assign(method_name="cooling", train_limit_0=math.inf, start_limit_0=2.5)
    (sentence,) = task_sentences(dataclasses.replace(finished, trials=cooled), table)
    assert "measured" not in sentence


def test_violators_are_marked_by_text_and_colour() -> None:
    table = judged(ROWS)
    html = html_page.verdict_table(verdict_table(table), verdict_kinds(table))
    assert '<tr class="infeasible"><td class="name">river</td><td class="name">cpo</td>' in html
    assert '<td class="name"><small>river cpo</small>linear</td>' in html
    assert '<td class="verdict">infeasible by up to 2.00 (40%)</td>' in unescape(html)
    assert "tr.infeasible" in html_page.STYLE


def test_sampled_policies_are_said_to_be_sampled() -> None:
    sampled = judged([outcome("none", 0, 9.5, 5.0, exact=False, episodes=30)])
    assert "means over 30 episodes" in explanation(sampled)[0]
    assert "computed exactly" in explanation(judged(ROWS))[0]


def test_a_task_without_a_cost_does_not_take_the_name_of_it_from_the_others() -> None:
    two = {"task": "two", "cost_1": 1.0, "deploy_limit_1": 2.0}
    one = {"task": "one", "cost_1": math.nan, "deploy_limit_1": math.nan}
    rows = [outcome("none", 0, 9.5, 6.0, **two), outcome("none", 0, 9.5, 6.0, **one)]
    trials = trials_of(rows)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    table = count_verdicts(pd.DataFrame(rows), NONE_COMPARED, flags, trials, {"two": ("fuel", "time")})
    assert table.set_index("task")[["cost_name_0", "cost_name_1"]].T.to_dict("list") == {
        "two": ["fuel", "time"],
        "one": ["", ""],
    }
    shown = verdict_table(table.assign(cost_1_se=0.0))
    assert {"cost 0", "cost time"} <= set(shown)
    assert shown["verdict"].tolist() == ["infeasible: fuel by 1.00 (20%)", "infeasible by 1.00 (20%)"]
    assert [sentence.split("; ")[1] for sentence in answers(table)[1:]] == [
        "'none' exceeds a limit (1 of 1 policy): fuel by 1.00.",
        "'none' exceeds the limit of 5 by 1.00 (1 of 1 policy).",
    ]


def test_the_first_sentences_name_each_cost_that_exceeds_its_limit() -> None:
    """Costs may have different units, although their limits are equal."""
    limits = {"deploy_limit_0": 25.0, "deploy_limit_1": 25.0, "optimal_return": math.nan, "feasible": False}
    rows = [
        outcome("none", 0, 9.5, 325.0, cost_1=25.0, **limits),
        outcome("linear", 0, 9.5, 25.0, cost_1=27.5, **limits),
    ]
    trials = trials_of(rows)
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    table = count_verdicts(pd.DataFrame(rows), NONE_COMPARED, flags, trials, {"river": ("fuel", "wear")})
    sentence = answers(table)[-1]
    assert sentence.endswith(
        "every curriculum exceeds a limit (2 of 2 policies): fuel by 300.0 in 1 policy and wear by 2.50 in 1 "
        "policy."
    )


def test_every_cost_above_its_limit_is_named_with_its_policies() -> None:
    """Six policies of two curricula exceed the energy, five of them the hazard, too."""
    limits = {"deploy_limit_0": 6.0, "deploy_limit_1": 1.0, "optimal_return": math.nan, "feasible": False}
    costs = {
        "none": [(7.90, 2.20), (9.54, 1.45), (13.89, 1.00)],
        "linear": [(8.50, 1.25), (9.00, 1.80), (9.16, 1.30)],
    }
    rows = [
        outcome(method, seed, 9.5, energy, cost_1=hazard, **limits)
        for method, each in costs.items()
        for seed, (energy, hazard) in enumerate(each)
    ]
    trials = trials_of(rows, waiting=[outcome("linear", 3, 0.0, 0.0, cost_1=0.0, **limits)])
    flags = trials[list(KEY)].assign(no_curriculum=False, hard_landing=False)
    names = {"river": ("energy", "hazard")}
    table = count_verdicts(pd.DataFrame(rows), NONE_COMPARED, flags, trials, names)
    assert table[["exceeded_0", "exceeded_1"]].to_numpy().tolist() == [[3, 2], [3, 3]]
    assert answers(table) == [
        "river: none of 7 trials is feasible so far; the sweep is incomplete: 1 trial has no result yet; "
        "every curriculum exceeds a limit (6 of 6 policies): energy by 1.90 to 7.89 in 6 policies and hazard "
        "by 0.25 to 1.20 in 5 policies."
    ]
    assert [verdict_text(row) for _, row in table.iterrows()] == [
        "infeasible: energy by up to 7.89 (132%), hazard by up to 1.20 (120%)",
        "infeasible 3 of 4: energy by up to 3.16 (53%), hazard by up to 0.80 (80%); no result yet 1 of 4",
    ]


def test_a_curriculum_that_violates_in_part_names_every_cost() -> None:
    limits = {"deploy_limit_1": 1.0, "optimal_return": math.nan}
    rows = [outcome("none", seed, 9.5, 5.0, cost_1=0.5, **limits) for seed in range(3)]
    rows += [outcome("none", 3, 9.5, 6.0, cost_1=1.5, **limits)]
    rows += [outcome("linear", seed, 9.5, 5.0, cost_1=0.5, **limits) for seed in range(2)]
    rows += [outcome("linear", 2, 9.5, 6.5, cost_1=0.5, **limits)]
    rows += [outcome("linear", 3, 9.5, 5.0, cost_1=2.5, **limits, **{"feasible": False})]
    (sentence,) = answers(judged(rows))
    assert sentence.split("; ")[1:] == [
        "'none' is feasible in 3 of 4, 1 exceeds a limit: cost 0 by 1.00 and cost 1 by 0.50",
        "'linear' is feasible in 2 of 4, 2 exceed a limit: cost 0 by 1.50 in 1 policy and cost 1 by 1.50 in "
        "1 policy.",
    ]
