"""The paper's claims about RiverGrid and Safety Gym, counted on made-up outcomes."""

import math
from typing import Any

import pandas as pd
import pytest

from recrl.analysis.report.text_tables import claims_table
from recrl.analysis.statistics import claims

NO_TRAINING = pd.DataFrame(columns=["task", "agent", "method", "seed", "episodes", "cost_0_total"])


def counted(
    rows: pd.DataFrame, training: pd.DataFrame = NO_TRAINING, failed: pd.DataFrame | None = None
) -> pd.DataFrame:
    rows = rows.assign(feasible=rows["cost_0"] <= 1.01 * rows["deploy_limit_0"])
    trials = pd.concat([rows.assign(status="complete"), training.assign(status="complete")])
    if failed is not None:
        trials = pd.concat([trials, failed.assign(status="failed")])
    trials["deploy_limit_0"] = trials["deploy_limit_0"].fillna(trials["task"].map(claims.PAPER_LIMITS))
    return claims.count_claims(rows, training, named(trials))


def named(trials: pd.DataFrame) -> pd.DataFrame:
    """The trials with their tasks, agents and curricula under their own names, unless a row has another."""
    named_trials = trials.copy()
    for part in ("task", "agent", "method"):
        other = trials.get(f"{part}_name", pd.Series(index=trials.index, dtype=object))
        named_trials[f"{part}_name"] = other.fillna(trials[part])
    return named_trials


def outcome(task: str, method: str, episode_return: float, cost: float, seed: int = 0) -> dict[str, object]:
    limit, optimum = {"rivergrid-1a": (5.0, 9.5), "rivergrid-1b": (1.0, 9.1)}.get(task, (5.0, 9.0))
    return {
        "task": task,
        "agent": "cpo",
        "method": method,
        "seed": seed,
        "measure": "stochastic",
        "episode_return": episode_return,
        "cost_0": cost,
        "deploy_limit_0": limit,
        "gap": optimum - episode_return,
    }


def held(*outcomes: dict[str, object]) -> dict[str, tuple[int, int]]:
    weighed = counted(pd.DataFrame(outcomes))
    counts = zip(weighed["held"].astype(int), weighed["seeds"].astype(int), strict=True)
    return dict(zip(weighed["claim"].astype(str), counts, strict=True))


def test_a_plain_agent_that_does_not_arrive_stays() -> None:
    found = held(
        outcome("rivergrid-1a", "none", -20.0, 0.0),
        outcome("rivergrid-1a", "none", 9.5, 5.0, seed=1),
        outcome("rivergrid-1a", "dynamic", -20.0, 0.0),
    )
    assert found["the plain agent stays at the start on 1a"] == (1, 2)


def test_crossing_on_1b_violates_and_is_not_the_optimum_though_its_return_is_higher() -> None:
    found = held(
        outcome("rivergrid-1b", "linear", 9.5, 5.0),
        outcome("rivergrid-1b", "cosine", 9.1, 1.009),
        outcome("rivergrid-1b", "linear", 9.5, 5.0, seed=1),
        outcome("rivergrid-1b", "cosine", 9.5, 5.0, seed=1),
        outcome("rivergrid-1b", "dynamic", 9.5, 5.0),
        outcome("rivergrid-1b", "dynamic", 8.91, 0.1, seed=1),
        outcome("rivergrid-1b", "dynamic", 8.89, 0.1, seed=2),
        outcome("rivergrid-1b", "none", 9.1, 1.06),
    )
    assert found == {
        "every static curriculum violates d_d on 1b (here: linear, cosine)": (1, 2),
        "the dynamic curriculum finds the optimum on 1b": (1, 3),
        "the plain agent finds the optimum on 1b": (0, 1),
    }


def test_the_share_has_wilsons_interval() -> None:
    rows = pd.DataFrame([outcome("rivergrid-1a", "linear", 9.5, 5.0, seed) for seed in range(5)])
    weighed = counted(rows)
    assert weighed["share_low"].item() == pytest.approx(0.5655, abs=1e-4)  # 1 / (1 + 1.96^2 / 5)
    assert claims_table(weighed)["holds in"].item() == "5 of 5 (57–100%)"
    table = claims_table(pd.concat([weighed, weighed.assign(held=3), weighed.assign(held=0)]))
    assert table["holds here"].tolist() == ["yes", "mixed", "no"]


def test_a_seed_without_one_of_the_curricula_is_not_counted() -> None:
    rows = [outcome("rivergrid-1b", "linear", 9.5, 5.0, seed) for seed in range(5)]
    rows.append(outcome("rivergrid-1b", "cosine", 9.5, 5.0, 0))
    assert held(*rows) == {"every static curriculum violates d_d on 1b (here: linear, cosine)": (1, 1)}
    failed = pd.DataFrame([outcome("rivergrid-1b", "linear", 9.5, 5.0, 7)])
    assert counted(pd.DataFrame(rows), failed=failed)["seeds"].tolist() == [1]


def test_three_curricula_of_a_seed_are_one_seed() -> None:
    static = ("linear", "cosine", "exponential")
    rows = [outcome("rivergrid-1b", method, 9.5, 5.0, seed) for method in static for seed in range(3)]
    weighed = counted(pd.DataFrame(rows))
    assert list(weighed[["held", "seeds"]].iloc[0]) == [3, 3]
    assert claims_table(weighed)["holds in"].item() == "3 of 3"  # too few for an interval
    pending = pd.DataFrame([outcome("rivergrid-1b", "cosine", 0.0, 0.0, 3)]).assign(status="running")
    more = [outcome("rivergrid-1b", method, 9.5, 5.0, 3) for method in ("linear", "exponential")]
    outcomes = pd.DataFrame([*rows, *more])
    trials = pd.concat([outcomes.assign(status="complete"), pending])
    weighed = claims.count_claims(outcomes.assign(feasible=False), NO_TRAINING, named(trials))
    assert list(weighed[["held", "seeds", "failed"]].iloc[0]) == [3, 3, 0]  # seed 3 may still be either
    lost = pending.drop(columns="status")
    weighed = counted(outcomes, failed=lost)
    assert list(weighed[["held", "seeds", "failed"]].iloc[0]) == [3, 4, 1]


def test_the_deployment_phase_is_counted_beside_and_apart() -> None:
    final = outcome("rivergrid-1a", "linear", -20.0, 0.0)
    deployed = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deployment"}
    weighed = counted(pd.DataFrame([final, deployed]))
    assert (weighed["held"].item(), weighed["deployment_held"].item()) == (0, 1)
    assert claims_table(weighed)["deployment phase (learning goes on)"].item() == "1 of 1"


def test_other_tasks_and_other_measures_are_not_counted() -> None:
    other = outcome("PointGoal2", "linear", 9.5, 5.0)
    greedy = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deterministic"}
    assert counted(pd.DataFrame([other, greedy])).empty


def trial(method: str, seed: int, episode_return: float, cost: float = 20.0, **others: Any) -> dict[str, Any]:
    made = {"task": "CarGoal2", "agent": "ppo-lag", "method": method, "seed": seed, "measure": "stochastic"}
    return {**made, "episode_return": episode_return, "cost_0": cost, "deploy_limit_0": 25.0, **others}


def test_a_comparison_counts_seeds_with_their_paired_difference_and_the_papers_range() -> None:
    rows = [
        *(trial("none", seed, value) for seed, value in enumerate((3.2, 2.8, 3.0))),
        *(trial("linear", seed, value) for seed, value in enumerate((4.2, 4.8, 3.0))),
        trial("linear", 9, 100.0),  # no seed of `none`
        *(trial("linear", seed, 0.0, measure="deployment") for seed in range(3)),
        *(trial("none", seed, 1.0 - seed, measure="deployment") for seed in range(3)),
    ]
    weighed = counted(pd.DataFrame(rows))
    line = weighed[weighed["claim"] == "linear returns more than none on CarGoal2"].iloc[0]
    assert (line["held"], line["seeds"], line["deployment_held"]) == (2, 3, 1)
    assert line["difference"] == pytest.approx(1.0)
    assert line["difference_high"] == pytest.approx(
        1.0 + 4.302653 / 3**0.5, abs=1e-5
    )  # t_2 s / sqrt(3), s = 1
    assert line["relative_difference"] == pytest.approx(1.0 / 3.0)
    assert line["paper"] == "20% to 600%"
    shown = claims_table(weighed).set_index("claim").loc[line["claim"]]
    assert (shown["holds here"], shown["holds in"]) == ("", "2 of 3")  # no verdict on a difference
    assert shown["difference"] == "+1.00 (-1.48 to +3.48)"
    assert shown["deployment phase (learning goes on)"] == "1 of 3"
    assert (shown["relative"], shown["paper, over its three tasks"]) == ("+33%", "20% to 600%")


def test_a_claim_does_not_hold_in_a_failed_trial() -> None:
    rows = pd.DataFrame([outcome("rivergrid-1b", "dynamic", 9.1, 1.0)])
    lost = [outcome("rivergrid-1b", "dynamic", 0.0, 0.0), outcome("rivergrid-1b", "none", 0.0, 0.0)]
    weighed = counted(rows, failed=pd.DataFrame(lost)).set_index("claim")
    columns = ["held", "seeds", "failed"]
    assert list(weighed.loc["the dynamic curriculum finds the optimum on 1b", columns]) == [1, 2, 1]
    assert list(weighed.loc["the plain agent finds the optimum on 1b", columns]) == [0, 1, 1]
    assert claims_table(weighed.reset_index())["failed"].tolist() == ["1", "1"]


def test_a_seed_with_a_failed_trial_is_no_gain_and_infeasible_pairs_are_counted_beside() -> None:
    rows = [trial("none", seed, 3.0, 30.0 if seed == 1 else 20.0) for seed in range(3)]
    rows += [trial("linear", seed, 4.0) for seed in range(2)]
    weighed = counted(pd.DataFrame(rows), failed=pd.DataFrame([trial("linear", 2, 0.0)]))
    line = weighed.set_index("claim").loc["linear returns more than none on CarGoal2"]
    assert list(line[["held", "seeds", "failed", "feasible_pairs"]]) == [2, 3, 1, 1]
    assert line["difference"] == 1.0
    shown = claims_table(weighed).set_index("claim").loc["linear returns more than none on CarGoal2"]
    assert (shown["failed"], shown["feasible pairs"]) == ("1", "1 of 2")
    assert list(shown[["holds here", "holds in", "difference", "relative"]]) == ["", "–", "–", ""]


def test_a_gain_in_the_deployment_phase_needs_feasible_pairs_of_its_own() -> None:
    final = [trial(method, 0, 3.0) for method in ("none", "linear")]
    deployed = [trial("none", 0, 3.0, measure="deployment")]
    for cost, shown in ((20.0, "1 of 1"), (30.0, "–")):
        rows = [*final, *deployed, trial("linear", 0, 4.0, cost, measure="deployment")]
        weighed = counted(pd.DataFrame(rows)).set_index("claim", drop=False)
        line = weighed.loc[["linear returns more than none on CarGoal2"]]
        assert claims_table(line)["deployment phase (learning goes on)"].item() == shown
        assert claims_table(line)["holds in"].item() == "0 of 1"


def test_a_failed_trial_makes_no_comparison_that_the_sweep_does_not_have() -> None:
    weighed = counted(pd.DataFrame([trial("none", 0, 3.0)]), failed=pd.DataFrame([trial("linear", 0, 0.0)]))
    compared = weighed[weighed["paper"] != ""]["claim"].tolist()
    assert compared == ["linear returns more than none on CarGoal2"]
    alone = counted(pd.DataFrame([trial("linear", 0, 3.0)]), failed=pd.DataFrame([trial("linear", 1, 0.0)]))
    assert alone["claim"].tolist() == ["ppo-lag keeps d_d on CarGoal2 (here: linear)"]


def test_the_papers_claims_are_about_its_own_tasks_limits_and_single_cost() -> None:
    rows = [trial(method, 0, 3.0) for method in ("none", "linear")]
    assert len(counted(pd.DataFrame(rows))) == 2
    for other in (
        {"deploy_limit_0": 50.0},
        {"deploy_limit_1": 9.0},
        {"task_name": "mine:CarGoal2"},
        {"agent_name": "cpo"},
        {"method_name": "cosine"},
    ):
        assert counted(pd.DataFrame([{**row, **other} for row in rows])).empty


def test_a_task_with_two_costs_hides_no_training_cost_of_the_others() -> None:
    methods = ("linear", "cosine", "exponential")
    single = [trial(method, 0, 1.0, cost_1=math.nan) for method in methods]
    other = [{**row, "task": "two-state-2", "cost_1": 1.0, "deploy_limit_1": 9.0} for row in single]
    training = totals().assign(cost_1_total=math.nan)
    weighed = counted(pd.DataFrame([*single, *other]), training)
    assert weighed["claim"].str.contains("costs more in training").sum() == 3


def test_dynamic_is_compared_with_each_static_curriculum_of_its_agent() -> None:
    rows = [trial("dynamic", seed, 5.0) for seed in range(2)]
    rows += [trial("linear", 0, 4.0), trial("linear", 1, 6.0), trial("cosine", 0, 4.0)]
    rows += [trial("dynamic", 0, 1.0, agent="cpo"), trial("linear", 0, 2.0, agent="cpo")]
    rows += [trial("dynamic", 0, 1.0, agent="min-std"), trial("linear", 0, 2.0, agent="min-std")]
    weighed = counted(pd.DataFrame(rows)).set_index(["claim", "agent"])
    linear = weighed.loc["dynamic returns more than linear on CarGoal2"]
    assert linear["held"].to_dict() == {"ppo-lag": 1, "cpo": 0}  # no claim is about another label
    assert linear["seeds"].to_dict() == {"ppo-lag": 2, "cpo": 1}
    assert linear["difference"].to_dict() == {"ppo-lag": 0.0, "cpo": -1.0}
    cosine = weighed.loc["dynamic returns more than cosine on CarGoal2"]
    assert cosine["held"].to_dict() == cosine["seeds"].to_dict() == {"ppo-lag": 1}
    assert "dynamic returns more than exponential on CarGoal2" not in weighed.index.get_level_values(0)


def test_each_agent_and_curriculum_has_the_papers_own_range() -> None:
    agents = ("ppo-lag", "cpo")
    rows = [trial(method, 0, 1.0, agent=agent) for agent in agents for method in ("none", *claims.CURRICULA)]
    weighed = counted(pd.DataFrame(rows)).set_index(["agent", "claim"])["paper"]
    own = {
        agent: [weighed[agent, f"{method} returns more than none on CarGoal2"] for method in claims.CURRICULA]
        for agent in agents
    }
    assert own == {  # section 6 of the paper
        "ppo-lag": ["20% to 600%", "20% to 400%", "10% to 300%", "40% to 900%"],
        "cpo": ["5% to 60%", "10% to 40%", "3% to 30%", "15% to 80%"],
    }


@pytest.mark.parametrize("base", [(-1.0, -2.0, -3.0), (-2.0, 0.0, 2.1), (1.0, 2.0, 2.7), (3.0,)])
def test_a_relative_gain_needs_a_base_above_zero_beyond_its_interval(base: tuple[float, ...]) -> None:
    rows = [trial("none", seed, value) for seed, value in enumerate(base)]
    rows += [trial("linear", seed, 5.0) for seed in range(len(base))]
    weighed = counted(pd.DataFrame(rows)).set_index("claim")["relative_difference"]
    assert math.isnan(float(weighed["linear returns more than none on CarGoal2"]))


def test_the_limit_is_a_claim_of_each_agent() -> None:
    rows = [trial("none", seed, 1.0, cost) for seed, cost in enumerate((20.0, 30.0))]
    rows += [trial("dynamic", 0, 1.0, 60.0, agent="cpo"), trial("dynamic", 0, 1.0, 60.0, agent="min-std")]
    weighed = counted(pd.DataFrame(rows)).set_index("claim")
    assert tuple(weighed.loc["ppo-lag keeps d_d on CarGoal2 (here: none)", ["held", "seeds"]]) == (1, 2)
    assert tuple(weighed.loc["cpo violates d_d on CarGoal2 (here: dynamic)", ["held", "seeds"]]) == (1, 1)
    assert len(weighed) == 2
    table = claims_table(weighed.reset_index())
    assert table["deployment phase (learning goes on)"].tolist() == ["", ""]  # not measured here
    assert "difference" not in table


def totals(**others: float) -> pd.DataFrame:
    costs = {"linear": 300.0, "cosine": 400.0, "exponential": 200.0}
    return pd.DataFrame(
        {**trial(method, 0, 0.0), "episodes": 10, "cost_0_total": total, **others}
        for method, total in costs.items()
    )


def test_costs_of_training_are_compared_per_episode() -> None:
    rows = [trial(method, 0, 1.0) for method in ("linear", "cosine", "exponential")]
    weighed = counted(pd.DataFrame(rows), totals()).set_index("claim")
    found = weighed["difference"].dropna().to_dict()
    assert found == {
        "linear costs more in training than exponential on CarGoal2": pytest.approx(10.0),
        "cosine costs more in training than exponential on CarGoal2": pytest.approx(20.0),
        "cosine costs more in training than linear on CarGoal2": pytest.approx(10.0),
    }
    table = claims_table(weighed.reset_index())
    assert table["difference"].tolist() == ["", "+10.00", "+20.00", "+10.00"]
    assert table["deployment phase (learning goes on)"].tolist()[1:] == ["", "", ""]


def test_costs_of_a_training_that_failed_or_goes_on_are_not_compared() -> None:
    training = pd.concat([totals(), totals().assign(seed=1, cost_0_total=900.0)], ignore_index=True)
    claim = "linear costs more in training than exponential on CarGoal2"
    for status, expected in (("failed", [1, 2, 1]), ("running", [1, 1, 0])):
        rows = pd.DataFrame([trial("linear", 0, 1.0)]).assign(feasible=True)
        ended = (training["method"] != "linear") | (training["seed"] != 1)
        trials = training.assign(status=ended.map({True: "complete", False: status}))
        line = claims.count_claims(rows, training, named(trials)).set_index("claim").loc[claim]
        assert list(line[["held", "seeds", "failed"]]) == expected
        assert line["difference"] == 10.0


def test_a_comparison_all_of_whose_seeds_failed_holds_nowhere_and_has_no_verdict() -> None:
    claim = "linear costs more in training than exponential on CarGoal2"
    rows = pd.DataFrame([trial("linear", 0, 1.0)]).assign(feasible=True)
    trials = totals().assign(status="failed")
    weighed = claims.count_claims(rows, totals(), named(trials))
    shown = claims_table(weighed).set_index("claim").loc[claim]
    assert list(shown[["holds here", "holds in", "difference"]]) == ["", "0 of 1", ""]
