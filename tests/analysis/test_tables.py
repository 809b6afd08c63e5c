"""Tables say what the frames hold, in digits that people read."""

from pathlib import Path

import numpy as np
import pandas as pd

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import table_formats
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.metrics import Measure


def test_a_row_a_group_with_absolute_numbers(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    table = table_formats.outcome_table(summary, Measure.STOCHASTIC)
    assert len(table) == 2 * 2 * 3
    assert table.iloc[0].to_dict() == {
        "task": "river-a",
        "agent": "ppo-lag",
        "curriculum": "none",
        "n": "3",
        "cost": "1.933 ± 1.433",
        "limit": "5.00",
        "return": "-7.33 ± 7.67",
        "optimum": "14.00",
        "regret": "21.33 ± 7.67",
        "feasible": "3 of 3",
        "solved": "0 of 3",
    }


def test_shares_have_an_interval_from_five_seeds_on_and_violators_no_regret(finished: Sweep) -> None:
    summary = metrics.summary(metrics.outcomes(finished), finished.trials)
    summary = summary.assign(seeds=5, feasible_seeds=4, optimal_seeds=5)
    row = table_formats.outcome_table(summary, Measure.STOCHASTIC).iloc[0]
    assert row["regret"] == "–"
    assert row["solved"].startswith("5 of 5 (")


def test_intervals_from_too_few_seeds_are_marked(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    compared = metrics.comparisons(rows, np.random.default_rng(0))
    chosen = table_formats.compared_rows(compared, metrics.summary(rows, finished.trials), Measure.STOCHASTIC)
    table = table_formats.comparison_table(chosen)
    assert table["P(higher return)"].str.endswith("†").all()
    assert table["return gained"].iloc[0].startswith("15.33 [-17.65, 48.32]")


def test_more_return_of_an_infeasible_policy_is_no_gain_and_one_seed_has_no_mark(finished: Sweep) -> None:
    rows = metrics.outcomes(finished)
    rows = rows[rows["seed"] == 0]
    compared = metrics.comparisons(rows, np.random.default_rng(0))
    chosen = table_formats.compared_rows(compared, metrics.summary(rows, finished.trials), Measure.STOCHASTIC)
    assert table_formats.row_kinds(chosen) == [""] * len(chosen)
    chosen.loc[0, ["feasible_seeds", "feasible_pairs"]] = 0
    table = table_formats.comparison_table(chosen)
    assert table_formats.row_kinds(chosen)[:2] == ["infeasible", ""]
    assert list(table[["return gained", "P(higher return)"]].iloc[0]) == ["–", "–"]
    assert table["feasible pairs"].tolist()[:2] == ["0 of 1", "1 of 1"]
    assert "–" not in list(table.iloc[1])
    assert not table["P(higher return)"].str.contains("†").any()


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


def test_csv_keeps_every_digit(tmp_path: Path) -> None:
    frame = pd.DataFrame({"value": [0.1 + 0.2, 1e-17, 9.5]})
    path = table_formats.write_csv(frame, tmp_path / "deep" / "frame.csv")
    assert pd.read_csv(path)["value"].tolist() == frame["value"].tolist()
