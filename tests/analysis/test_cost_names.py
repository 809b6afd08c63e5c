"""Costs have their task's names in titles and verdicts, and without names the numbers of the CSV files."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.cost_names import cost_names, cost_suffix, indices_of_cost
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report import drawing, table_formats
from recrl.analysis.report.verdict_table import verdict_text
from recrl.analysis.statistics import cumulative_cost, metrics
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.cli.result_table import result_table
from recrl.orchestrator.files.sweep_store import SweepStore


def named(sweep: Sweep, names: object) -> Sweep:
    """The sweep, had its trials recorded these names."""
    text = json.dumps({"attempts": [{"attempt": 1, "code": {}, "cost_names": names}]})
    return dataclasses.replace(
        sweep, facts=tuple(dataclasses.replace(it, provenance=text) for it in sweep.facts)
    )


@pytest.fixture
def two(made_up_sweep: Callable[..., SweepStore]) -> Sweep:
    """A sweep with two costs whose names are not known."""
    return sweep_data.load(made_up_sweep(seeds=1, num_costs=2, tasks=["a"], agents=["cpo"], methods=["none"]))


def test_names_are_those_that_the_trials_recorded(two: Sweep) -> None:
    assert cost_names(named(two, ["fuel", "noise"])) == {"a": ("fuel", "noise")}
    assert [cost_suffix(named(two, ["fuel", "noise"]), i) for i in range(2)] == [" fuel", " noise"]


@pytest.mark.parametrize("names", [None, ["fuel"], ["fuel", 3], ["fuel", ""], ["fuel", "\x1b[2J"], "ab"])
def test_names_of_the_wrong_form_are_numbers(two: Sweep, names: object) -> None:
    assert cost_names(named(two, names)) == {"a": ("0", "1")}
    assert [cost_suffix(two, i) for i in range(2)] == [" 0", " 1"]


def test_one_cost_needs_no_name(finished: Sweep) -> None:
    assert cost_names(finished) == {}
    assert cost_suffix(finished, 0) == ""


def test_titles_of_tables_have_the_names(two: Sweep) -> None:
    sweep = named(two, ["fuel", "noise"])
    assert {"cost fuel", "limit fuel", "cost noise", "limit noise"} <= set(result_table(sweep)[0])
    summary = metrics.summary(metrics.outcomes(sweep), sweep.trials)
    table = table_formats.outcome_table(summary, Measure.STOCHASTIC, (" fuel", " noise"))
    assert {"cost fuel", "limit noise"} <= set(table)


@pytest.mark.parametrize(
    ("cost", "seeds", "infeasible", "text"),
    [
        ("noise", 1, 1, "infeasible: noise by 0.22 (11%)"),
        ("1", 2, 2, "infeasible: cost 1 by up to 0.22 (11%)"),
        ("noise", 5, 1, "feasible 4 of 5; infeasible 1 of 5: noise by up to 0.22 (11%)"),
    ],
)
def test_a_verdict_names_the_cost_that_is_over_its_limit(
    cost: str, seeds: int, infeasible: int, text: str
) -> None:
    row: dict[str, object] = {"seeds": seeds, "planned": seeds, "failed": 0, "pending": 0}
    row |= {"solved": 0, "feasible": seeds - infeasible, "infeasible": infeasible}
    row |= {"exceeded_0": 0, "excess_0_high": math.nan, "deploy_limit_0": 5.0, "cost_name_0": "fuel"}
    row |= {"exceeded_1": infeasible, "excess_1_high": 0.22, "deploy_limit_1": 2.0, "cost_name_1": cost}
    assert verdict_text(pd.Series(row)) == text


def test_a_cost_is_found_by_its_index_from_0_or_by_its_name(two: Sweep) -> None:
    sweep = named(two, ["fuel", "noise"])
    assert indices_of_cost(sweep, "0") == indices_of_cost(sweep, "fuel") == {"a": 0}
    assert indices_of_cost(sweep, "1") == indices_of_cost(sweep, "noise") == {"a": 1}
    assert indices_of_cost(two, "1") == {"a": 1}


def test_two_tasks_may_have_a_cost_at_different_indices(made_up_sweep: Callable[..., SweepStore]) -> None:
    sweep = sweep_data.load(
        made_up_sweep(seeds=1, num_costs=2, tasks=["a", "b"], agents=["cpo"], methods=["none"])
    )
    first, second = (named(sweep, names) for names in (["fuel", "noise"], ["noise", "heat"]))
    mixed = dataclasses.replace(
        sweep,
        facts=tuple(
            one if one.spec.task.label == "a" else other
            for one, other in zip(first.facts, second.facts, strict=True)
        ),
    )
    assert indices_of_cost(mixed, "noise") == {"a": 1, "b": 0}
    assert indices_of_cost(mixed, "heat") == {"b": 1}
    assert indices_of_cost(mixed, "1") == {"a": 1, "b": 1}
    both = cumulative_cost.cumulative_costs(mixed, cost={"a": 1, "b": 0})
    assert set(cumulative_cost.cumulative_costs(mixed, cost={"b": 1})["task"]) == {"b"}
    assert set(both["task"]) == {"a", "b"}
    with pytest.raises(ValueError, match=r"has the costs 0 \(fuel or noise\), 1 \(noise or heat\), got '2'$"):
        indices_of_cost(mixed, "2")


@pytest.mark.parametrize(
    ("names", "wanted", "problem"),
    [
        (["fuel", "noise"], "2", "made-up has the costs 0 (fuel), 1 (noise), got '2'"),
        (["fuel", "noise"], "-1", "made-up has the costs 0 (fuel), 1 (noise), got '-1'"),
        (
            ["fuel", "noise"],
            "nois",
            "made-up has the costs 0 (fuel), 1 (noise), got 'nois'; did you mean 'noise'?",
        ),
        (None, "fuel", "made-up has the costs 0, 1, got 'fuel'"),
    ],
)
def test_a_cost_that_no_task_has_is_refused(two: Sweep, names: object, wanted: str, problem: str) -> None:
    with pytest.raises(ValueError) as caught:
        indices_of_cost(named(two, names), wanted)
    assert str(caught.value) == problem.replace("made-up", two.name)


def test_the_only_cost_has_the_index_0(finished: Sweep) -> None:
    assert set(indices_of_cost(finished, "0").values()) == {0}
    with pytest.raises(ValueError, match=r" has only the cost 0, got '1'$"):
        indices_of_cost(finished, "1")


@pytest.mark.usefixtures("unrendered")
def test_a_name_from_an_export_is_no_markup_in_the_report(two: Sweep, tmp_path: Path) -> None:
    drawing.sketch(named(two, ["<img src=x>", "[a](b)"]), tmp_path)
    headings = [line for line in (tmp_path / "report.md").read_text().splitlines() if line[:1] == "#"]
    assert any("img src=x" in line for line in headings)
    assert not any("<img" in line or "[a](b)" in line for line in headings)
