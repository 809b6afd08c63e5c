"""Differences between curricula and between agents: by hand, by scipy, and in every order of rows."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.comparisons import comparisons, group_comparisons
from recrl.analysis.statistics.intervals import holm
from tests.analysis.rows import only


def test_comparisons_use_the_seeds_that_both_have(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    same = rows[(rows["method"] == "none") | (rows["seed"] == 1)]
    compared = comparisons(same, np.random.default_rng(0))
    row = only(compared, task="river-a", agent="cpo", method="linear", measure="stochastic")
    assert (row["pairs"], row["feasible_pairs"], row["improvement"]) == (1, 1, 1.0)
    apart = rows[(rows["method"] == "none") == (rows["seed"] == 0)]
    assert not len(comparisons(apart, np.random.default_rng(0)))


def test_comparisons_pair_equal_seeds(finished: Sweep) -> None:
    rows = comparisons(metrics.outcomes(finished), np.random.default_rng(0))
    assert "none" not in set(rows["method"])
    row = only(rows, task="river-a", agent="cpo", method="linear", measure="stochastic")
    # differences 0, 23, 23; a run of linear ties one run of none in three and beats the others
    assert row["pairs"] == 3
    assert row["return_difference"] == pytest.approx(46 / 3)
    assert row["improvement"] == pytest.approx((2 + 0.5) / 3)
    assert row["too_few_seeds"]


def test_equally_good_policies_tie_where_the_optimum_is_known(finished: Sweep) -> None:
    rows = metrics.outcomes(finished).assign(episode_return=9.5)
    rows.loc[rows["method"] == "linear", "episode_return"] += 1e-6
    known = comparisons(rows, np.random.default_rng(0))
    assert set(known["improvement"]) == {0.5}
    unknown = comparisons(rows.assign(optimal_return=math.nan), np.random.default_rng(0))
    assert set(unknown.loc[unknown["method"] == "linear", "improvement"]) == {1.0}


def test_without_a_baseline_there_is_nothing_to_compare(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    nothing = comparisons(rows[rows["method"] != "none"], np.random.default_rng(0))
    assert not len(nothing)
    assert list(nothing) == list(comparisons(rows, np.random.default_rng(0)))


def test_two_curricula_are_compared_with_each_other(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    key = {"task": "river-a", "agent": "cpo", "measure": "stochastic"}
    forth = only(comparisons(rows, np.random.default_rng(0)), method="linear", **key)
    back = only(comparisons(rows, np.random.default_rng(0), baseline="linear"), method="none", **key)
    for column in ("return_difference", "cost_0_difference"):
        assert back[column] == pytest.approx(-forth[column])
        assert back[f"{column}_low"] == pytest.approx(-forth[f"{column}_high"])
    with pytest.raises(
        ValueError, match=r"^baseline: no complete trial has the method 'linaer' \(found: none, "
    ):
        comparisons(rows, np.random.default_rng(0), baseline="linaer")


def test_agents_are_compared_as_independent_groups(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows["episode_return"] += np.random.default_rng(3).normal(size=len(rows))
    only_ours = (rows["agent"] == "ppo-lag") & (rows["seed"] == 0)  # the groups may have other seeds
    compared = group_comparisons(rows[~only_ours], np.random.default_rng(0), of="agent", baseline="cpo")
    assert set(compared["agent"]) == {"ppo-lag"}
    assert set(compared["method"]) == {"none", "linear", "dynamic"}
    chosen = {"task": "river-a", "method": "linear", "measure": "stochastic"}
    row = only(compared, agent="ppo-lag", **chosen)
    assert row[["seeds", "baseline_seeds"]].tolist() == [2, 3]
    ours, theirs = (
        rows[~only_ours & (rows[["agent", *chosen]] == [agent, *chosen.values()]).all(axis=1)]
        for agent in ("ppo-lag", "cpo")
    )
    assert row["baseline_feasible_seeds"] == theirs["feasible"].sum()
    for name, column in (("return", "episode_return"), ("cost_0", "cost_0")):
        assert row[f"{name}_difference"] == pytest.approx(ours[column].mean() - theirs[column].mean())
    test = stats.ttest_ind(ours["episode_return"], theirs["episode_return"], equal_var=False)
    assert row["return_difference_p"] == pytest.approx(test.pvalue)
    of_measure = compared[compared["measure"] == "stochastic"]
    expected = holm(of_measure["return_difference_p"].to_numpy())
    assert of_measure["return_difference_p_corrected"].to_numpy() == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"^baseline: no complete trial has the agent 'none' \(found: ppo-"):
        group_comparisons(rows, np.random.default_rng(0), of="agent", baseline="none")


def test_groups_of_curricula_differ_in_their_intervals_only(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    pairs = comparisons(rows, np.random.default_rng(0))
    groups = group_comparisons(rows, np.random.default_rng(0), of="method", baseline="none")
    assert groups["return_difference"].to_numpy() == pytest.approx(pairs["return_difference"].to_numpy())
    assert groups["improvement_low"].to_list() == pairs["improvement_low"].to_list()
    assert not groups["return_difference_low"].equals(pairs["return_difference_low"])


def test_p_values_are_corrected_for_the_rows_of_a_measure(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows["episode_return"] += np.random.default_rng(3).normal(size=len(rows))
    compared = comparisons(rows.assign(optimal_return=math.nan), np.random.default_rng(0))
    for measure, of_measure in compared.groupby("measure"):
        p_values = of_measure["return_difference_p"].to_numpy()
        assert len(p_values) > 2, measure
        assert of_measure["return_difference_p_corrected"].to_numpy() == pytest.approx(holm(p_values))
        costs = of_measure["cost_0_difference_p"].to_numpy()  # by themselves
        assert of_measure["cost_0_difference_p_corrected"].to_numpy() == pytest.approx(
            holm(costs), nan_ok=True
        )
    key = {"task": "river-a", "agent": "cpo", "method": "linear", "measure": "stochastic"}
    pairs = rows[(rows["task"] == "river-a") & (rows["agent"] == "cpo") & (rows["measure"] == "stochastic")]
    wide = pairs.pivot(index="seed", columns="method", values="episode_return")
    expected = stats.ttest_rel(wide["linear"], wide["none"]).pvalue
    assert only(compared, **key)["return_difference_p"] == pytest.approx(expected)


def test_infeasible_rows_count_in_the_correction_and_rows_of_one_seed_do_not(finished: Sweep) -> None:
    rows = metrics.outcomes(finished).assign(optimal_return=math.nan)
    rows = rows[(rows["measure"] == "stochastic") & (rows["task"] == "river-a") & (rows["agent"] == "cpo")]
    rows["episode_return"] += np.random.default_rng(3).normal(size=len(rows))
    both = comparisons(rows, np.random.default_rng(0))
    assert both["method"].tolist() == ["linear", "dynamic"]
    smaller, larger = sorted(both["return_difference_p"])
    assert sorted(both["return_difference_p_corrected"]) == pytest.approx(
        [min(2 * smaller, 1.0), max(min(2 * smaller, 1.0), larger)]
    )
    infeasible = rows.assign(feasible=rows["feasible"] & (rows["method"] != "linear"))
    same = comparisons(infeasible, np.random.default_rng(0))
    assert same["return_difference_p_corrected"].equals(both["return_difference_p_corrected"])
    one = rows[(rows["method"] != "dynamic") | (rows["seed"] == 0)]
    row = only(comparisons(one, np.random.default_rng(0)), method="linear")
    assert row["return_difference_p_corrected"] == row["return_difference_p"]


def test_pairs_do_not_depend_on_the_order_of_rows(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    ordered = comparisons(rows, np.random.default_rng(0))
    mixed = comparisons(rows.sample(frac=1.0, random_state=1), np.random.default_rng(0))
    key = ["task", "agent", "method", "measure"]
    columns = [name for name in map(str, ordered) if name.startswith(("pairs", "feasible", "return", "cost"))]
    pd.testing.assert_frame_equal(
        mixed.set_index(key)[columns].sort_index(), ordered.set_index(key)[columns].sort_index()
    )


def test_wrong_rows_are_not_compared(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    twice, numbers = pd.concat([rows, rows.iloc[:1]]), np.random.default_rng(0)
    said = r"^rows: a trial is there twice: river-a, ppo-lag, none, 0, deployment$"
    with pytest.raises(ValueError, match=said):
        comparisons(twice, numbers)
    with pytest.raises(ValueError, match=said):
        group_comparisons(twice, numbers, of="agent", baseline="cpo")
    with pytest.raises(ValueError, match=r"^of: must be 'method' or 'agent', got 'curriculum'$"):
        group_comparisons(rows, numbers, of="curriculum", baseline="none")  # type: ignore[arg-type]


def test_groups_of_one_seed_have_no_p_value_and_ties_are_of_all_runs(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    of_measure = rows[(rows["measure"] == "stochastic") & (rows["task"] == "river-a")]
    one = of_measure[(of_measure["agent"] == "ppo-lag") | (of_measure["seed"] == 0)]
    alone = group_comparisons(one, np.random.default_rng(0), of="agent", baseline="cpo")
    assert len(alone)
    assert alone[["return_difference_low", "return_difference_p"]].isna().all(axis=None)
    tied = of_measure.assign(episode_return=5.0 + 0.05 * of_measure["seed"])  # at most 0.1 apart
    groups = group_comparisons(tied, np.random.default_rng(0), of="agent", baseline="cpo")
    assert set(groups["return_difference_p"]) == {1.0}
    spread = of_measure.assign(episode_return=5.0 + 0.2 * of_measure["seed"])  # pairs tie, all runs do not
    pairs = comparisons(spread, np.random.default_rng(0))
    assert set(pairs["return_difference_p"]) == {1.0}
    moved = spread["episode_return"] + 0.1 * (spread["agent"] == "cpo")
    groups = group_comparisons(
        spread.assign(episode_return=moved), np.random.default_rng(0), of="agent", baseline="cpo"
    )
    assert (groups["return_difference_p"] < 1.0).all()


def test_one_seed_has_no_p_value_and_ties_have_one_of_1(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    one = comparisons(rows[rows["seed"] == 1], np.random.default_rng(0))
    assert one[["return_difference_p", "cost_0_difference_p_corrected"]].isna().all(axis=None)
    equal = rows.assign(episode_return=9.5)
    equal.loc[equal["method"] == "linear", "episode_return"] += 1e-6
    tied = comparisons(equal, np.random.default_rng(0))
    assert set(tied["return_difference_p"]) == {1.0}


def test_rows_of_another_library_are_compared() -> None:
    ours, theirs = [5.0, 7.0, 6.5], [4.0, 4.5, 6.0]
    rows = pd.DataFrame(
        {
            "agent": ["ours"] * 3 + ["theirs"] * 3,
            "seed": [0, 1, 2] * 2,
            "episode_return": [*ours, *theirs],
            "cost_0": [24.0, 26.0, 25.0, 31.0, 28.0, 30.0],
        }
    ).assign(task="CarGoal2", method="none", measure="stochastic", feasible=True, optimal_return=math.nan)
    line = group_comparisons(rows, np.random.default_rng(0), of="agent", baseline="theirs").iloc[0]
    welch = stats.ttest_ind(ours, theirs, equal_var=False)
    assert line["return_difference"] == pytest.approx((18.5 - 14.5) / 3)
    assert line["return_difference_p"] == pytest.approx(welch.pvalue)
    assert line["cost_0_difference"] == pytest.approx((75.0 - 89.0) / 3)
    said = r"^rows: no column feasible, optimal_return; where J\*\(d_d\) is unknown optimal_return is NaN$"
    with pytest.raises(ValueError, match=said):
        comparisons(rows.drop(columns=["feasible", "optimal_return"]), np.random.default_rng(0))
