"""What training cost beside what theory allows: sums by hand, and a trial that the bound holds for."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures.cumulative_cost import cumulative_bounds
from recrl.analysis.report.figure_list import drawings
from recrl.analysis.report.text_tables import admissible_table, bound_table
from recrl.analysis.statistics import cumulative_cost
from recrl.analysis.statistics.metrics import training_totals
from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.teachers.bounds import undiscounted_excess

RIVER = TrialSpec(
    task=Choice("rivergrid-1a", {"horizon": 20}),
    agent=Choice("cpo", {"hidden_sizes": [8], "target_kl": 1e-7, "discount": 0.9}),
    method=Choice("linear"),
    train_limits=CostLimits((18.0,)),
    deploy_limits=CostLimits((15.0,)),
    train_steps=800,
    deploy_steps=80,
    num_envs=4,
    rollout_steps=20,
    evaluation_episodes=0,
    seed=0,
)


@pytest.fixture(scope="module")
def river_grid(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    store = SweepStore(tmp_path_factory.mktemp("runs"), "river")
    trial = store.trial(RIVER)
    assert run_recorded(RIVER, trial, should_stop=lambda: False) is TrialStatus.COMPLETE
    store.write_info({"name": store.name})
    store.write_specs([RIVER])
    return store


def test_measured_cost_lies_under_the_bound_on_river_grid(river_grid: SweepStore) -> None:
    (row,) = cumulative_cost.cumulative_costs(sweep_data.load(river_grid)).to_dict("records")
    assert row["policies"] == 10
    assert 10 < row["cost_sum"] < row["bound"] < row["ceiling_sum"] == 10 * 20
    updates = river_grid.trials()[0].updates().iloc[:10]
    excesses = [undiscounted_excess(kl, 20.0, horizon=20) for kl in updates["kl"][:9]]
    assert row["bound"] == pytest.approx(
        20.0 + sum(min(20.0, d + excess) for d, excess in zip(updates["limit_0"][:9], excesses, strict=True))
    )
    assert row["discounted_excess_sum"] == pytest.approx(
        sum(
            math.sqrt(2 * kl) * 0.9 * min(eps, 10.0) / 0.1**2
            for kl, eps in zip(updates["kl"][:9], updates["cost_advantage_max_0"][:9], strict=True)
        )
    )


def three_policies(finished: Sweep) -> Sweep:
    """One linear trial whose three policies cost 30, 6 and 2 under 20, 10 and infinity; d_d is 5."""
    trials = finished.trials.query(
        "task == 'river-a' and agent == 'cpo' and method == 'linear' and seed == 0"
    )
    updates = finished.updates.merge(trials[["task", "agent", "method", "seed"]]).iloc[:3]
    for name in ("task", "agent", "method"):
        updates[name] = updates[name].astype(finished.updates[name].dtype)
    updates = updates.assign(
        cost_0=[30.0, 6.0, 2.0], limit_0=[20.0, 10.0, math.inf], kl=[0.0, 0.02, 0.0], episodes=[4, 4, 4]
    )
    trials = trials.assign(boundary_step=updates["end_step"].iloc[-1])
    return dataclasses.replace(finished, trials=trials, updates=updates)


def test_a_trial_whose_saved_updates_end_before_the_boundary_is_left_out(finished: Sweep) -> None:
    sweep = three_policies(finished)
    updates = sweep.updates.iloc[:2]  # its progress, env_steps, is beyond: it died before it saved more
    shorter = dataclasses.replace(sweep, updates=updates)
    assert shorter.trials["env_steps"].item() > updates["end_step"].max()
    assert not len(cumulative_cost.cumulative_costs(shorter))
    assert not len(training_totals(shorter))
    assert cumulative_bounds(shorter, "cpo") is None
    none = dataclasses.replace(sweep, updates=sweep.updates.iloc[:0])
    assert not len(cumulative_cost.cumulative_costs(none))
    assert not len(training_totals(none))


def test_without_finished_episodes_no_limit_is_estimated(finished: Sweep) -> None:
    sweep = three_policies(finished)
    sweep = dataclasses.replace(sweep, updates=sweep.updates.assign(episodes=0))
    rows = cumulative_cost.cumulative_costs(sweep)
    assert not len(cumulative_cost.admissible_limits(rows, sweep, budget=80.0))


def test_sums_are_those_counted_by_hand(finished: Sweep) -> None:
    (row,) = cumulative_cost.cumulative_costs(three_policies(finished)).to_dict("records")
    assert (row["cost_sum"], row["limit_sum"]) == (38.0, 32.0)
    assert (row["over_limits_sum"], row["over_deploy_sum"], row["overshoot_sum"]) == (6.0, 23.0, 10.0)
    assert row["episodes_per_policy"] == 4.0
    # two-state costs at most 1 a step for 10 steps: the first policy 10, then min(20, 10), min(10, 10)
    assert (row["bound"], row["ceiling_sum"]) == (30.0, 30.0)


def test_a_budget_is_spent_by_the_limit_it_allows(finished: Sweep) -> None:
    sweep = three_policies(finished)
    rows = cumulative_cost.cumulative_costs(sweep)
    # 4 episodes a policy: 80 are 20 a policy's episode. Overshoot is 10 in all; what is left, 10, is
    # (1 + 2/3 + 1/3) (d_t - 5)
    (row,) = cumulative_cost.admissible_limits(rows, sweep, budget=80.0).to_dict("records")
    assert row["largest_train_limit"] == pytest.approx(10.0)
    assert row["measured_over_deploy"] == 92.0
    (row,) = cumulative_cost.admissible_limits(rows, sweep, budget=39.0).to_dict("records")
    assert math.isnan(row["largest_train_limit"])
    table = admissible_table(pd.DataFrame([row]))
    assert table["largest d_t"].tolist() == ["none"]


def test_the_measured_cost_is_that_of_all_episodes_also_if_policies_have_unequal_numbers(
    finished: Sweep,
) -> None:
    sweep = three_policies(finished)
    updates = sweep.updates.assign(cost_0=[30.0, 6.0, math.nan], episodes=[1, 9, 0])
    rows = cumulative_cost.cumulative_costs(dataclasses.replace(sweep, updates=updates))
    assert rows["measured_over_deploy"].tolist() == [1 * 25.0 + 9 * 1.0]
    assert rows["over_deploy_sum"].tolist() == [25.0 + 1.0 + 1.0]


def test_the_measured_cost_is_that_of_the_recorded_episodes(finished: Sweep) -> None:
    rows = cumulative_cost.cumulative_costs(finished)
    totals = rows.merge(training_totals(finished), on=list(KEY))
    assert len(totals) == len(rows) > 0
    expected = totals["cost_0_total"] - totals["episodes"] * totals["deploy_limit"]
    # mean costs of updates have six digits
    assert totals["measured_over_deploy"].to_numpy() == pytest.approx(expected.to_numpy(), rel=1e-4, abs=0.1)


def test_a_label_may_be_another_curriculum_on_another_task(finished: Sweep) -> None:
    """As in merged files; ``unconstrained`` has no bound, and is left out."""
    sweep = three_policies(finished)
    rows = cumulative_cost.cumulative_costs(sweep)
    other = sweep.trials.assign(task="other", method_name="unconstrained")
    for trials in ([sweep.trials, other], [other, sweep.trials]):
        both = dataclasses.replace(sweep, trials=pd.concat(trials, ignore_index=True))
        found = cumulative_cost.admissible_limits(
            pd.concat([rows, rows.assign(task="other")]), both, budget=80.0
        )
        assert found["task"].tolist() == rows["task"].tolist()


def test_a_budget_takes_the_worst_of_several_runs(finished: Sweep) -> None:
    sweep = three_policies(finished)
    row = cumulative_cost.cumulative_costs(sweep)
    rows = pd.concat([row, row.assign(overshoot_sum=6.0, measured_over_deploy=-9.0)], ignore_index=True)
    for order in (rows, rows.iloc[::-1]):
        (found,) = cumulative_cost.admissible_limits(order, sweep, budget=80.0).to_dict("records")
        assert found["overshoot"] == pytest.approx(10.0 / 3.0)
        assert found["measured_over_deploy"] == 92.0
        table = admissible_table(pd.DataFrame([found]))
        assert table["episodes per policy"].tolist() == ["4.00"]  # few: the overshoot is biased


def test_noise_of_few_episodes_is_no_cost_above_the_limits(finished: Sweep) -> None:
    sweep = three_policies(finished)
    noisy = sweep.updates.assign(cost_0=[15.0, 5.0, 10.0], limit_0=10.0)
    (row,) = cumulative_cost.cumulative_costs(dataclasses.replace(sweep, updates=noisy)).to_dict("records")
    assert (row["over_limits_sum"], row["over_deploy_sum"]) == (0.0, 15.0)
    assert row["overshoot_sum"] == 5.0


def test_a_policy_without_an_episode_costs_what_its_neighbour_does(finished: Sweep) -> None:
    updates = three_policies(finished).updates.assign(cost_0=[math.nan, 6.0, math.nan])
    policies = cumulative_cost.policy_costs(updates, cost=0, sizes=None, discount=None)
    assert policies["cost"].tolist() == [6.0, 6.0, 6.0]


def test_a_negative_budget_is_refused(finished: Sweep) -> None:
    with pytest.raises(ValueError, match=r"^budget: must be at least 0, got -1$"):
        cumulative_cost.admissible_limits(pd.DataFrame(), finished, budget=-1.0)


def test_lemma_1_is_not_said_of_other_agents(finished: Sweep) -> None:
    rows = cumulative_cost.cumulative_costs(finished)
    assert rows.loc[rows["agent"] == "ppo-lag", ["bound", "discounted_excess_sum"]].isna().all(axis=None)
    assert rows["ceiling_sum"].notna().all()


def test_the_command_says_it(river_grid: SweepStore, capsys: pytest.CaptureFixture[str]) -> None:
    root = str(river_grid.folder.parent)
    assert main(["bound", "--root", root, "--budget", "1000"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert "rivergrid-1a" in out
    assert "\nThe largest training limit d_t within 1000 of net cost above the deployment limit d_d " in out


def test_the_command_counts_costs_from_0(river_grid: SweepStore, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bound", "--root", str(river_grid.folder.parent), "--cost"]
    assert main([*command, "0"]) == ExitCode.OK
    assert main([*command, "1"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == "recrl-sweep: --cost: river has only the cost 0, got '1'\n"


def with_discount(sweep: Sweep, discount: float) -> Sweep:
    """The sweep of agents with this discount."""
    cpo = Choice("cpo", {"discount": discount})
    facts = [dataclasses.replace(it, spec=dataclasses.replace(it.spec, agent=cpo)) for it in sweep.facts]
    return dataclasses.replace(sweep, facts=tuple(facts))


def test_measured_advantages_make_the_discounted_bound_tighter(finished: Sweep) -> None:
    sweep = with_discount(three_policies(finished), 0.9)
    updates = sweep.updates.assign(kl=[1e-8, 1e-8, 0.0], limit_0=[6.0, 5.0, 5.0])
    (crude,) = cumulative_cost.cumulative_costs(dataclasses.replace(sweep, updates=updates)).to_dict(
        "records"
    )
    seen = updates.assign(cost_advantage_max_0=[0.5, 0.25, 0.0])
    (own,) = cumulative_cost.cumulative_costs(dataclasses.replace(sweep, updates=seen)).to_dict("records")
    assert own["discounted_bound"] < crude["discounted_bound"] <= crude["ceiling_sum"]
    assert own["bound"] == crude["bound"]
    # the first policy 10, then 6 and 5 and what Lemma 1 adds
    excess = math.sqrt(2e-8) * 0.9 * (0.5 + 0.25) / 0.1**2
    assert own["discounted_excess_sum"] == pytest.approx(excess)
    assert own["discounted_bound"] == pytest.approx(21.0 + excess)


def test_a_discount_of_1_leaves_only_the_trivial_bound(finished: Sweep) -> None:
    sweep = with_discount(three_policies(finished), 1.0)
    updates = sweep.updates.assign(kl=[1e-8, 1e-8, 0.0], limit_0=[6.0, 5.0, 5.0])
    (row,) = cumulative_cost.cumulative_costs(dataclasses.replace(sweep, updates=updates)).to_dict("records")
    assert row["discounted_bound"] == row["ceiling_sum"]
    assert math.isnan(row["discounted_excess_sum"])


def test_without_horizon_the_first_policy_counts_with_its_cost(finished: Sweep) -> None:
    updates = three_policies(finished).updates.assign(
        cost_advantage_max_0=1.0, limit_0=[20.0, 10.0, 5.0], kl=0.0
    )
    policies = cumulative_cost.policy_costs(updates, cost=0, sizes=None, discount=0.99)
    assert policies["discounted_bound"].tolist() == [30.0, 20.0, 10.0]
    assert policies[["bound", "ceiling"]].isna().all(axis=None)


def test_the_figure_adds_up_what_the_table_sums(finished: Sweep) -> None:
    rows = cumulative_cost.cumulative_costs(finished)
    figure = cumulative_bounds(finished, "cpo")
    assert figure is not None
    axes = figure.axes[1]  # linear on river-a
    chosen = rows.query("task == 'river-a' and agent == 'cpo' and method == 'linear'")
    ends = [np.asarray(line.get_ydata(), dtype=float)[-1] for line in axes.get_lines()]
    assert ends[:3] == pytest.approx(chosen["cost_sum"].tolist())
    assert ends[3] == pytest.approx(chosen["cost_sum"].mean())
    assert ends[4] == pytest.approx(chosen["limit_sum"].mean())
    assert ends[-1] == pytest.approx(chosen["ceiling_sum"].mean())


def test_every_line_of_the_figure_is_the_sum_that_its_label_names(river_grid: SweepStore) -> None:
    sweep = sweep_data.load(river_grid)
    (row,) = cumulative_cost.cumulative_costs(sweep).to_dict("records")
    figure = cumulative_bounds(sweep, "cpo")
    assert figure is not None
    (axes,) = figure.axes
    ends = {
        str(line.get_label()): float(np.asarray(line.get_ydata(), dtype=float)[-1])
        for line in axes.get_lines()
        if not str(line.get_label()).startswith("_")
    }
    assert ends == {
        "limits in force, the cost where infinite": pytest.approx(row["limit_sum"]),
        "Proposition 1, discounted cost": pytest.approx(row["discounted_bound"]),
        "bound, undiscounted cost": pytest.approx(row["bound"]),
        "trivial bound: every step at the largest cost": pytest.approx(row["ceiling_sum"]),
    }
    assert len(set(ends.values())) == 4
    ratio = row["bound"] / row["cost_sum"]
    assert [text.get_text() for text in axes.texts] == [f"bound: {ratio:.3g} times\nthe measured cost"]
    dashes = [line.get_linestyle() for line in axes.get_lines() if str(line.get_label()) in ends]
    assert [it == "-" for it in dashes] == [True, False, False, False]


def test_without_a_bound_none_is_announced(finished: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {text for text in captions(finished, "bounds")} == {
        "ppo-lag: Cost of training, one episode of each policy, against its bounds",
        "cpo: Cost of training, one episode of each policy, against its bounds",
    }
    monkeypatch.setattr(cumulative_cost, "finite_model", lambda name, options: None)
    assert captions(finished, "bounds")[0] == (
        "ppo-lag: Cost of training, one episode of each policy, against the limits in force"
    )
    rows = cumulative_cost.cumulative_costs(finished)
    table = bound_table(rows[rows["agent"] == "ppo-lag"])
    assert list(table)[5:] == [
        "episodes per policy",
        "cost",
        "limits in force",
        "net above limits in force",
        "positive parts",
        "net above the limit",
    ]


def captions(sweep: Sweep, kind: str) -> list[str]:
    return [it.caption for it in drawings(sweep).values() if it.kind == kind]
