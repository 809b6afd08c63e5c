"""Tables say what the frames hold, in digits that people read."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import table_files, table_formats
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.comparisons import comparisons
from recrl.analysis.statistics.cumulative_cost import cumulative_costs
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.number_texts import number, with_error
from tests.analysis.rows import ONE_COST


def test_a_row_a_group_with_absolute_numbers(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    table = table_formats.outcome_table(summary, Measure.STOCHASTIC, ONE_COST)
    assert len(table) == 2 * 2 * 3
    assert table.iloc[0].to_dict() == {
        "task": "river-a",
        "agent": "ppo-lag",
        "curriculum": "none",
        "n": "3",
        "cost": "1.93 ± 1.43",
        "limit": "5.00",
        "return": "-7.33 ± 7.67",
        "optimum": "14.00",
        "regret": "21.33 ± 7.67",
        "feasible": "3 of 3",
        "solved": "0 of 3",
    }


def test_where_no_optimum_is_known_there_is_no_regret_and_nothing_solved(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    known = list(table_formats.outcome_table(summary, Measure.STOCHASTIC, ONE_COST))
    unknown = list(
        table_formats.outcome_table(summary.assign(optimal_return=math.nan), Measure.STOCHASTIC, ONE_COST)
    )
    assert [name for name in known if name not in unknown] == ["optimum", "regret", "solved"]


def test_shares_have_an_interval_from_five_seeds_on_and_violators_no_regret(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    summary = summary.assign(seeds=5, feasible_seeds=4, optimal_seeds=5)
    row = table_formats.outcome_table(summary, Measure.STOCHASTIC, ONE_COST).iloc[0]
    assert row["regret"] == "–"
    assert row["solved"].startswith("5 of 5 (")


def test_intervals_from_too_few_seeds_are_marked(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    compared = comparisons(rows, np.random.default_rng(0))
    chosen = table_formats.compared_rows(compared, metrics.summary(rows, finished.trials), Measure.STOCHASTIC)
    table = table_formats.comparison_table(chosen, ONE_COST)
    assert table["P(higher return)"].str.endswith("†").all()
    assert table["return gained"].iloc[0].startswith("15.33 [-17.65, 48.32]")


def test_p_values_of_gains_are_shown_where_there_are_two_seeds(finished: Sweep, tmp_path: Path) -> None:
    rows = metrics.outcomes(finished)
    compared = comparisons(rows, np.random.default_rng(0))
    chosen = table_formats.compared_rows(compared, metrics.summary(rows, finished.trials), Measure.STOCHASTIC)
    chosen.loc[0, "return_difference_p_corrected"] = 0.0123
    chosen.loc[1, ["return_difference_p", "return_difference_p_corrected"]] = math.nan  # of one seed
    chosen.loc[2, "feasible_pairs"] = 0
    assert table_formats.comparison_table(chosen, ONE_COST)["p of return, corrected"].tolist()[:3] == [
        "0.012",
        "",
        "–",
    ]
    _, tables = table_files.write_tables(finished, tmp_path)
    beside_none = [it for it in tables.shown if "minus none" in it.heading]
    assert len(beside_none) == 2
    text = (tmp_path / "outcomes.tex").read_text(encoding="utf-8")
    assert "% Final policy, stochastic, minus none. n: seeds; +-: one standard error over seeds" in text
    assert "return gained & p of return, corrected & cost added" in text
    assert all("p of return, corrected: of a paired t test" in it.note for it in beside_none)


def test_more_return_of_an_infeasible_policy_is_no_gain_and_one_seed_has_no_mark(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows = rows[rows["seed"] == 0]
    compared = comparisons(rows, np.random.default_rng(0))
    chosen = table_formats.compared_rows(compared, metrics.summary(rows, finished.trials), Measure.STOCHASTIC)
    assert table_formats.row_kinds(chosen) == [""] * len(chosen)
    chosen.loc[0, ["feasible_seeds", "feasible_pairs"]] = 0
    table = table_formats.comparison_table(chosen, ONE_COST)
    assert table_formats.row_kinds(chosen)[:2] == ["infeasible", ""]
    assert list(table[["return gained", "P(higher return)"]].iloc[0]) == ["–", "–"]
    assert table["feasible pairs"].tolist()[:2] == ["0 of 1", "1 of 1"]
    assert "–" not in list(table.iloc[1])
    assert not table["P(higher return)"].str.contains("†").any()
    assert "p of return, corrected" not in table


def with_failures(sweep: Sweep) -> Sweep:
    """All trials of ``dynamic``, and all but one of ``none``, failed."""
    trials = sweep.trials
    failed = (trials["method"] == "dynamic") | ((trials["method"] == "none") & (trials["seed"] > 0))
    return replace(sweep, trials=trials.assign(status=trials["status"].mask(failed, "failed")))


def test_failed_trials_are_in_every_table(finished: Sweep, tmp_path: Path) -> None:
    written, tables = table_files.write_tables(with_failures(finished), tmp_path)
    by_name = {path.name: pd.read_csv(path) for path in written if path.suffix == ".csv"}
    summary = by_name["summary.csv"].query("task == 'river-a' and agent == 'cpo' and measure == 'stochastic'")
    lost, found = (summary[summary["method"] == method].iloc[0] for method in ("dynamic", "linear"))
    assert list(lost[["seeds", "failed", "feasible_share", "too_few_seeds"]]) == [0, 3, 0.0, True]
    assert list(found[["seeds", "failed", "too_few_seeds"]]) == [3, 0, True]
    assert math.isnan(lost["iqm"]) and math.isfinite(found["iqm"])
    verdicts = tables.verdicts.query("task == 'river-a' and agent == 'cpo' and method == 'dynamic'")
    assert verdicts[["failed", "no_curriculum", "hard_landing"]].to_numpy().tolist() == [[3, 0, 0]]
    assert tables.verdicts[["no_curriculum", "hard_landing"]].dtypes.tolist() == [np.dtype(int)] * 2
    notes = [it.note for it in tables.shown]
    assert any(table_files.FAILED_NOTE in note for note in notes)
    _, whole = table_files.write_tables(finished, tmp_path)
    assert not any(table_files.FAILED_NOTE in it.note for it in whole.shown)


def test_a_dash_in_place_of_a_gain_is_explained_where_there_is_one(finished: Sweep, tmp_path: Path) -> None:
    def explained(cost: float) -> list[str]:
        sweep = replace(finished, evaluations=finished.evaluations.assign(cost_0=cost))
        shown = table_files.write_tables(sweep, tmp_path)[1].shown
        return [it.heading for it in shown if table_files.NO_GAIN in it.note]

    assert not all("deployment" in heading for heading in explained(100.0))
    assert all("deployment" in heading for heading in explained(0.0))


def test_tables_with_several_intervals_say_that_they_are_not_corrected(
    finished: Sweep, tmp_path: Path
) -> None:
    notes = {it.heading: it.note for it in table_files.write_tables(finished, tmp_path)[1].shown}
    # eight pairs of cells, each with intervals of return, cost and probability
    sentence = "Intervals in this table: 24, of 95% each, not corrected for their number."
    assert sentence in notes["Final policy, stochastic, minus none"]
    weighed = pd.DataFrame(
        {"section": "6", "claim": ["one", "another"], "agent": "cpo", "held": 5, "seeds": 5}
    )
    weighed = weighed.assign(share_low=0.57, share_high=1.0, deployment_held=0, deployment_seeds=0, failed=0)
    weighed = weighed.assign(difference=math.nan, feasible_pairs=None, deployment_feasible_pairs=None)
    note = table_files._claims(weighed).note
    assert note.startswith("Counted are seeds")
    assert note.endswith("Intervals in this table: 2, of 95% each, not corrected for their number.")


def test_a_table_of_costs_without_a_bound_does_not_announce_one(finished: Sweep) -> None:
    costs = cumulative_costs(finished)
    bounded = table_files._bounds(costs, "")
    assert bounded.heading == "Cost of training, one episode of each policy, against its bounds"
    assert "and of the measured cost where the limit was infinite" in bounded.note
    assert "Trivial bound: " in bounded.note and "trivial bound" in bounded.table
    unknown = costs.assign(bound=math.nan, discounted_bound=math.nan, ceiling_sum=math.nan)
    shown = table_files._bounds(unknown, " fuel")
    assert (
        shown.heading
        == "Cost of training, one episode of each policy, against the limits in force (cost fuel)"
    )
    assert "ound" not in shown.note and not any("bound" in str(name) for name in shown.table)


def test_a_task_has_rows_of_its_own_measures_only(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows = rows[(rows["task"] != "river-b") | (rows["measure"] == "stochastic")]
    summary = metrics.summary(rows, with_failures(finished).trials)
    assert set(summary[summary["task"] == "river-b"]["measure"]) == {"stochastic"}
    assert {"stochastic", "deterministic"} <= set(summary[summary["task"] == "river-a"]["measure"])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-0.0, "0.00"),
        (-1e-13, "0.00"),  # rounding
        (0.0004, "0.0004"),
        (-0.00456, "-0.0046"),
        (0.0099, "0.0099"),
        (0.00999, "0.01"),
        (0.01, "0.010"),
        (0.0996, "0.100"),
        (-0.5, "-0.50"),
        (-128.44, "-128.4"),
        (math.inf, "inf"),
        (math.nan, "–"),
    ],
)
def test_a_small_number_has_two_digits_and_none_is_a_minus_zero(value: float, text: str) -> None:
    assert number(value) == text


def test_means_and_intervals_have_no_minus_zero() -> None:
    assert with_error(-0.004, 0.012) == "0.00 ± 0.01"
    row = pd.Series({"gain": -0.001, "gain_low": -0.004, "gain_high": 0.002})
    assert table_formats.with_interval(row, "gain") == "0.00 [0.00, 0.00]"


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (0.004, 0.6, "0.30 [0.004, 0.60]"),
        (-0.004, 0.6, "0.30 [0.00, 0.60]"),
        (0.1, 0.6, "0.30 [0.10, 0.60]"),
        (math.nan, math.nan, "0.30"),
    ],
)
def test_an_interval_shows_whether_it_excludes_0(low: float, high: float, text: str) -> None:
    row = pd.Series({"gain": 0.3, "gain_low": low, "gain_high": high})
    assert table_formats.with_interval(row, "gain") == text


def test_markdown_and_latex_by_hand() -> None:
    table = pd.DataFrame({"task": ["a_1", "b"], "share": ["1 of 2 (9–91%)", "±"]})
    assert table_formats.markdown(table).splitlines()[2] == "| a_1 | 1 of 2 (9–91%) |"
    assert table_formats.latex(table).splitlines() == [
        r"\begin{tabular}{ll}",
        r"\toprule",
        r"task & share \\",
        r"\midrule",
        r"a\_1 & 1 of 2 (9--91\%) \\",
        r"\midrule",
        r"b & $\pm$ \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_labels_that_mean_something_in_latex() -> None:
    r"""After \\ a bracket would be its length, and an asterisk its variant."""
    table = pd.DataFrame({"task": ["[b] x", "*a"], "method": ["a|b <c>", "[d]"]})
    lines = table_formats.latex(table).splitlines()
    assert r"{}[b] x & a\textbar{}b \textless{}c\textgreater{} \\" in lines
    assert r"{}*a & [d] \\" in lines


def test_csv_keeps_every_digit(tmp_path: Path) -> None:
    frame = pd.DataFrame({"value": [0.1 + 0.2, 1e-17, 9.5]})
    path = table_formats.write_csv(frame, tmp_path / "deep" / "frame.csv")
    assert pd.read_csv(path)["value"].tolist() == frame["value"].tolist()
