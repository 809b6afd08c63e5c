"""Outcomes of trials, and learning curves over seeds."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from recrl.analysis.data import sweep_data
from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import table_formats
from recrl.analysis.statistics import metrics, verdicts
from recrl.analysis.statistics.intervals import holm
from recrl.orchestrator.files.sweep_store import SweepStore


def only(frame: pd.DataFrame, **values: object) -> pd.Series:
    """The one row that has these values."""
    chosen = frame.loc[np.logical_and.reduce([frame[name] == value for name, value in values.items()])]
    assert len(chosen) == 1
    return chosen.iloc[0]


def test_a_trial_has_three_outcomes_under_three_names(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    assert len(rows) == 3 * len(finished.trials)
    assert rows["measure"].tolist()[:3] == ["deployment", "stochastic", "deterministic"]


def test_exact_values_need_no_sampled_episodes(finished: Sweep) -> None:
    whole = metrics.outcomes(finished)
    sweep = dataclasses.replace(finished)
    sweep.__dict__["evaluations"] = finished.evaluations.iloc[:0]
    exact = finished.evaluations.groupby([*KEY, "policy"], observed=True)[["episode_return", "cost_0"]].mean()
    sweep.__dict__["exact"] = exact.reset_index().astype({name: str for name in KEY[:3]})
    rows = metrics.outcomes(sweep)
    assert rows[["task", "measure"]].equals(whole[["task", "measure"]])
    none_typed = finished.evaluations.iloc[:0].astype({"policy": np.float64})  # as of a sweep without any
    sweep.__dict__["evaluations"] = none_typed
    assert metrics.outcomes(sweep)[["episode_return", "cost_0"]].equals(rows[["episode_return", "cost_0"]])
    final = rows[rows["measure"] != "deployment"]
    assert final["exact"].all()
    assert set(final["episodes"]) == {0}
    assert set(final["episode_return_se"]) == {0.0}


def test_the_gap_is_the_optimum_minus_the_return(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    # J*(5) of two-state with horizon 10 is 9 + 5 = 14; the made-up evaluations return 8 or -15
    assert set(rows.loc[rows["measure"] == "stochastic", "gap"]) == {6.0, 29.0}


def test_feasible_allows_one_percent_or_one_standard_error() -> None:
    limit = {"deploy_limit_0": 5.0}
    rows = pd.DataFrame(
        [
            {"cost_0": 5.05, "cost_0_se": 0.0, **limit},
            {"cost_0": 5.06, "cost_0_se": 0.0, **limit},
            {"cost_0": 5.2, "cost_0_se": 0.2, **limit},
            {"cost_0": 5.21, "cost_0_se": 0.2, **limit},
            {"cost_0": 5.05, "cost_0_se": math.nan, **limit},
            {"cost_0": 0.01, "cost_0_se": 0.0, "deploy_limit_0": 0.0},
            {"cost_0": 0.02, "cost_0_se": 0.0, "deploy_limit_0": 0.0},
        ]
    )
    assert verdicts.within_limits(rows).tolist() == [True, False, True, False, True, True, False]


def test_a_missing_limit_is_kept_and_a_missing_cost_keeps_no_limit() -> None:
    rows = pd.DataFrame({"cost_0": [math.nan, 1.0], "deploy_limit_0": [5.0, math.nan]})
    assert verdicts.within_limits(rows).tolist() == [False, True]


def test_the_standard_error_of_the_deployment_phase_counts(finished: Sweep) -> None:
    phases = finished.phases.copy()
    deployed = phases["phase"] == "deployment"
    phases.loc[deployed, ["cost_0", "cost_0_std", "episodes"]] = [5.1, 2.0, 100.0]  # standard error 0.2
    rows = metrics.outcomes(dataclasses.replace(finished, phases=phases))
    assert rows.loc[rows["measure"] == "deployment", "feasible"].all()


def test_the_tolerance_of_a_sampled_final_policy_is_the_standard_error_of_its_mean(finished: Sweep) -> None:
    index = finished.evaluations["index"]
    for costs, feasible in ((index % 2 * 4.0 + 3.6, True), (index % 2 * 4.0 + 3.7, False)):
        # ten episodes, half of them 2 below the mean and half above: s = 2.108, standard error 0.667
        rows = metrics.outcomes(
            dataclasses.replace(finished, evaluations=finished.evaluations.assign(cost_0=costs))
        )
        rows = rows[rows["measure"] == "stochastic"]
        assert rows["cost_0_se"].tolist() == pytest.approx([2.0 / 3.0] * len(rows))
        assert (rows["feasible"] == feasible).all()


def test_solved_is_who_is_near_the_optimum_and_within_every_limit() -> None:
    near = {"gap": 0.2, "cost_0": 5.05, "deploy_limit_0": 5.0, "cost_1": 7.0, "deploy_limit_1": math.nan}
    others = [{"gap": 0.21}, {"gap": -0.4, "cost_0": 5.06}, {"deploy_limit_1": 6.9}, {"gap": math.nan}]
    rows = pd.DataFrame([near, *(near | other for other in others), near | {"gap": -math.inf}])
    assert verdicts.solved(rows).tolist() == [True, False, False, False, False, False]


def test_a_gap_of_a_fifth_is_near_whatever_rounding_does_to_it() -> None:
    gap = 9.5 - 9.299999999999994
    assert gap == 0.2000000000000064
    rows = pd.DataFrame([{"gap": gap, "cost_0": 5.0, "deploy_limit_0": 5.0}])
    assert verdicts.solved(rows).tolist() == [True]


def test_a_summary_counts_the_seeds_at_the_optimum(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows.loc[rows["measure"] == "stochastic", ["gap", "cost_0"]] = [0.1, 4.0]
    rows["optimal"], rows["feasible"] = verdicts.solved(rows), verdicts.within_limits(rows)
    found = metrics.summary(rows, finished.trials).set_index("measure").loc["stochastic"]
    assert (found["optimal_seeds"] == found["seeds"]).all()
    table = table_formats.outcome_table(metrics.summary(rows, finished.trials), metrics.Measure.STOCHASTIC)
    seeds = int(found["seeds"].iloc[0])
    assert (table["solved"] == f"{seeds} of {seeds}").all()  # three seeds: no interval


def test_every_cost_must_be_feasible(made_up_sweep: Callable[..., SweepStore]) -> None:
    sweep = sweep_data.load(made_up_sweep(seeds=1, num_costs=2, agents=["cpo"], methods=["linear"]))
    rows = metrics.outcomes(sweep)
    assert rows.loc[rows["measure"] == "stochastic", "feasible"].all()
    evaluations = sweep.evaluations.assign(cost_1=6.0)
    rows = metrics.outcomes(dataclasses.replace(sweep, evaluations=evaluations))
    assert not rows.loc[rows["measure"] == "stochastic", "feasible"].any()


def test_trials_that_are_not_complete_have_no_outcome(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=2,
        tasks=["river-a"],
        agents=["cpo"],
        methods=["none"],
        unfinished=["river-a cpo none seed 1"],
    )
    rows = metrics.outcomes(sweep_data.load(store))
    assert rows["seed"].unique().tolist() == [0]


def test_training_totals_by_hand(finished: Sweep, finished_sweep: SweepStore) -> None:
    totals = metrics.training_totals(finished)
    assert len(totals) == len(finished.trials)
    trial = finished_sweep.trials()[0]
    spec = trial.spec
    labels = {"task": spec.task.label, "agent": spec.agent.label, "method": spec.method.label}
    row = only(totals, **labels, seed=spec.seed)
    episodes = trial.episodes()
    costs = episodes.loc[episodes["phase"] == "training", "cost_0"]
    assert row["cost_0_total"] == pytest.approx(sum(costs))
    assert row["excess_0_total"] == pytest.approx(sum(max(0.0, cost - 5.0) for cost in costs))
    updates = trial.updates()
    trained = updates[updates["phase"] == "training"]
    assert row["updates_over_0"] == sum(trained["cost_0"] > trained["limit_0"])
    assert row["updates_with_cost_0"] == len(trained)


def test_updates_without_an_episode_are_not_counted_as_within_the_limit(finished: Sweep) -> None:
    known = finished.updates["update"] % 2 == 0
    updates = finished.updates.assign(cost_0=np.where(known, 100.5, np.nan))
    totals = metrics.training_totals(dataclasses.replace(finished, updates=updates))
    assert set(totals["updates_with_cost_0"]) == set(totals["updates_over_0"]) == {19}  # of 38


def test_summary_averages_over_seeds(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    row = only(summary, task="river-a", agent="cpo", method="none", measure="stochastic")
    # seed 0 returns 8, seeds 1 and 2 return -15: mean -22/3, standard error 23/3
    assert row["seeds"] == 3
    assert row["episode_return"] == pytest.approx(-22 / 3)
    assert row["episode_return_se"] == pytest.approx(23 / 3)
    assert row["feasible_seeds"] == 3
    assert row["feasible_low"] == pytest.approx(1.0 / (1.0 + 1.959964**2 / 3.0), abs=1e-6)


def test_failed_trials_are_in_the_fractions_and_in_no_mean(finished: Sweep) -> None:
    broken = (finished.trials["method"] == "linear") & (finished.trials["seed"] > 0)
    broken |= finished.trials["method"] == "dynamic"
    trials = finished.trials.assign(status=finished.trials["status"].mask(broken, "failed"))
    summary = metrics.summary(metrics.outcomes(dataclasses.replace(finished, trials=trials)), trials)
    row = only(summary, task="river-a", agent="cpo", method="linear", measure="stochastic")
    assert (row["seeds"], row["failed"], row["feasible_seeds"]) == (1, 2, 1)
    assert row["feasible_share"] == pytest.approx(1 / 3)
    assert row["episode_return"] == 8.0
    gone = only(summary, task="river-a", agent="cpo", method="dynamic", measure="stochastic")
    assert (gone["seeds"], gone["failed"], gone["feasible_share"]) == (0, 3, 0.0)
    table = table_formats.outcome_table(summary, metrics.Measure.STOCHASTIC)
    shown = table[(table["task"] == "river-a") & (table["agent"] == "cpo")].set_index("curriculum")
    assert shown["failed"].to_dict() == {"none": "0", "linear": "2", "dynamic": "3"}
    assert shown["feasible"].to_dict() == {"none": "3 of 3", "linear": "1 of 3", "dynamic": "0 of 3"}
    assert shown["return"]["dynamic"] == "–"


def test_comparisons_use_the_seeds_that_both_have(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    same = rows[(rows["method"] == "none") | (rows["seed"] == 1)]
    compared = metrics.comparisons(same, np.random.default_rng(0))
    row = only(compared, task="river-a", agent="cpo", method="linear", measure="stochastic")
    assert (row["pairs"], row["feasible_pairs"], row["improvement"]) == (1, 1, 1.0)
    apart = rows[(rows["method"] == "none") == (rows["seed"] == 0)]
    assert not len(metrics.comparisons(apart, np.random.default_rng(0)))


def test_comparisons_pair_equal_seeds(finished: Sweep) -> None:
    rows = metrics.comparisons(metrics.outcomes(finished), np.random.default_rng(0))
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
    known = metrics.comparisons(rows, np.random.default_rng(0))
    assert set(known["improvement"]) == {0.5}
    unknown = metrics.comparisons(rows.assign(optimal_return=math.nan), np.random.default_rng(0))
    assert set(unknown.loc[unknown["method"] == "linear", "improvement"]) == {1.0}


def test_without_a_baseline_there_is_nothing_to_compare(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    nothing = metrics.comparisons(rows[rows["method"] != "none"], np.random.default_rng(0))
    assert not len(nothing)
    assert list(nothing) == list(metrics.comparisons(rows, np.random.default_rng(0)))


def test_two_curricula_are_compared_with_each_other(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    key = {"task": "river-a", "agent": "cpo", "measure": "stochastic"}
    forth = only(metrics.comparisons(rows, np.random.default_rng(0)), method="linear", **key)
    back = only(metrics.comparisons(rows, np.random.default_rng(0), baseline="linear"), method="none", **key)
    for column in ("return_difference", "cost_0_difference"):
        assert back[column] == pytest.approx(-forth[column])
        assert back[f"{column}_low"] == pytest.approx(-forth[f"{column}_high"])
    with pytest.raises(
        ValueError, match=r"^baseline: no complete trial has the method 'linaer' \(found: none, "
    ):
        metrics.comparisons(rows, np.random.default_rng(0), baseline="linaer")


def test_agents_are_compared_as_independent_groups(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows["episode_return"] += np.random.default_rng(3).normal(size=len(rows))
    only_ours = (rows["agent"] == "ppo-lag") & (rows["seed"] == 0)  # the groups may have other seeds
    compared = metrics.group_comparisons(
        rows[~only_ours], np.random.default_rng(0), of="agent", baseline="cpo"
    )
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
        metrics.group_comparisons(rows, np.random.default_rng(0), of="agent", baseline="none")


def test_groups_of_curricula_differ_in_their_intervals_only(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    pairs = metrics.comparisons(rows, np.random.default_rng(0))
    groups = metrics.group_comparisons(rows, np.random.default_rng(0), of="method", baseline="none")
    assert groups["return_difference"].to_numpy() == pytest.approx(pairs["return_difference"].to_numpy())
    assert groups["improvement_low"].to_list() == pairs["improvement_low"].to_list()
    assert not groups["return_difference_low"].equals(pairs["return_difference_low"])


def test_p_values_are_corrected_for_the_rows_of_a_measure(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows["episode_return"] += np.random.default_rng(3).normal(size=len(rows))
    compared = metrics.comparisons(rows.assign(optimal_return=math.nan), np.random.default_rng(0))
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
    both = metrics.comparisons(rows, np.random.default_rng(0))
    assert both["method"].tolist() == ["linear", "dynamic"]
    smaller, larger = sorted(both["return_difference_p"])
    assert sorted(both["return_difference_p_corrected"]) == pytest.approx(
        [min(2 * smaller, 1.0), max(min(2 * smaller, 1.0), larger)]
    )
    infeasible = rows.assign(feasible=rows["feasible"] & (rows["method"] != "linear"))
    same = metrics.comparisons(infeasible, np.random.default_rng(0))
    assert same["return_difference_p_corrected"].equals(both["return_difference_p_corrected"])
    one = rows[(rows["method"] != "dynamic") | (rows["seed"] == 0)]
    row = only(metrics.comparisons(one, np.random.default_rng(0)), method="linear")
    assert row["return_difference_p_corrected"] == row["return_difference_p"]


def test_pairs_do_not_depend_on_the_order_of_rows(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    ordered = metrics.comparisons(rows, np.random.default_rng(0))
    mixed = metrics.comparisons(rows.sample(frac=1.0, random_state=1), np.random.default_rng(0))
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
        metrics.comparisons(twice, numbers)
    with pytest.raises(ValueError, match=said):
        metrics.group_comparisons(twice, numbers, of="agent", baseline="cpo")
    with pytest.raises(ValueError, match=r"^of: must be 'method' or 'agent', got 'curriculum'$"):
        metrics.group_comparisons(rows, numbers, of="curriculum", baseline="none")  # type: ignore[arg-type]


def test_groups_of_one_seed_have_no_p_value_and_ties_are_of_all_runs(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    of_measure = rows[(rows["measure"] == "stochastic") & (rows["task"] == "river-a")]
    one = of_measure[(of_measure["agent"] == "ppo-lag") | (of_measure["seed"] == 0)]
    alone = metrics.group_comparisons(one, np.random.default_rng(0), of="agent", baseline="cpo")
    assert len(alone)
    assert alone[["return_difference_low", "return_difference_p"]].isna().all(axis=None)
    tied = of_measure.assign(episode_return=5.0 + 0.05 * of_measure["seed"])  # at most 0.1 apart
    groups = metrics.group_comparisons(tied, np.random.default_rng(0), of="agent", baseline="cpo")
    assert set(groups["return_difference_p"]) == {1.0}
    spread = of_measure.assign(episode_return=5.0 + 0.2 * of_measure["seed"])  # pairs tie, all runs do not
    pairs = metrics.comparisons(spread, np.random.default_rng(0))
    assert set(pairs["return_difference_p"]) == {1.0}
    moved = spread["episode_return"] + 0.1 * (spread["agent"] == "cpo")
    groups = metrics.group_comparisons(
        spread.assign(episode_return=moved), np.random.default_rng(0), of="agent", baseline="cpo"
    )
    assert (groups["return_difference_p"] < 1.0).all()


def test_one_seed_has_no_p_value_and_ties_have_one_of_1(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    one = metrics.comparisons(rows[rows["seed"] == 1], np.random.default_rng(0))
    assert one[["return_difference_p", "cost_0_difference_p_corrected"]].isna().all(axis=None)
    equal = rows.assign(episode_return=9.5)
    equal.loc[equal["method"] == "linear", "episode_return"] += 1e-6
    tied = metrics.comparisons(equal, np.random.default_rng(0))
    assert set(tied["return_difference_p"]) == {1.0}


def test_interquartile_means_carry_their_warning(finished: Sweep) -> None:
    rows = metrics.robust_summary(metrics.outcomes(finished), np.random.default_rng(0))
    assert rows["too_few_seeds"].all()
    assert (rows["iqm_low"] <= rows["iqm"]).all()
