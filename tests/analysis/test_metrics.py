"""Outcomes of trials, and learning curves over seeds."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import table_formats
from recrl.analysis.statistics import metrics, verdicts
from recrl.analysis.statistics.comparisons import comparisons
from recrl.orchestrator.files.sweep_store import SweepStore
from tests.analysis.rows import ONE_COST, only


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


def test_a_sweep_without_trials_has_no_outcomes(tmp_path: Path) -> None:
    rows = metrics.outcomes(sweep_data.load(SweepStore(tmp_path, "empty")))
    assert len(rows) == 0
    assert {"feasible", "optimal"} <= set(rows)


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
    table = table_formats.outcome_table(
        metrics.summary(rows, finished.trials), metrics.Measure.STOCHASTIC, ONE_COST
    )
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
    table = table_formats.outcome_table(summary, metrics.Measure.STOCHASTIC, ONE_COST)
    shown = table[(table["task"] == "river-a") & (table["agent"] == "cpo")].set_index("curriculum")
    assert shown["failed"].to_dict() == {"none": "0", "linear": "2", "dynamic": "3"}
    assert shown["feasible"].to_dict() == {"none": "3 of 3", "linear": "1 of 3", "dynamic": "0 of 3"}
    assert shown["return"]["dynamic"] == "–"
    rows = metrics.outcomes(dataclasses.replace(finished, trials=trials))
    compared = comparisons(rows, np.random.default_rng(0))
    pairs = table_formats.compared_rows(compared, summary, metrics.Measure.STOCHASTIC)
    row = only(pairs, task="river-a", agent="cpo", method="linear")
    assert (row["pairs"], row["failed"]) == (1, 2)
    assert "failed" in table_formats.comparison_table(pairs, ONE_COST)
    assert "failed" not in table_formats.comparison_table(pairs.assign(failed=0), ONE_COST)


def test_interquartile_means_carry_their_warning(finished: Sweep) -> None:
    rows = metrics.robust_summary(metrics.outcomes(finished), np.random.default_rng(0))
    assert rows["too_few_seeds"].all()
    assert (rows["iqm_low"] <= rows["iqm"]).all()
    row = only(rows, task="river-a", agent="cpo", method="none", measure="stochastic")
    assert row["seeds"] == 3
    assert row["iqm"] == pytest.approx(-22.0 / 3.0)  # of 8, -15 and -15: a quarter of three is none
