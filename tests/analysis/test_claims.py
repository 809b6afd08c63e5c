"""The paper's claims about RiverGrid and Safety Gym, counted on made-up outcomes."""

from typing import Any

import pandas as pd
import pytest

from recrl.analysis.statistics import claims
from recrl.analysis.statistics.claims import claims_table

NO_TRAINING = pd.DataFrame(columns=["task", "agent", "method", "seed", "episodes", "cost_0_total"])


def weigh(rows: pd.DataFrame, training: pd.DataFrame = NO_TRAINING) -> pd.DataFrame:
    return claims.weigh(rows, training)


def outcome(task: str, method: str, episode_return: float, cost: float) -> dict[str, object]:
    limit, optimum = {"rivergrid-1a": (5.0, 9.5), "rivergrid-1b": (1.0, 9.1)}.get(task, (5.0, 9.0))
    return {
        "task": task,
        "agent": "cpo",
        "method": method,
        "seed": 0,
        "measure": "stochastic",
        "episode_return": episode_return,
        "cost_0": cost,
        "deploy_limit_0": limit,
        "gap": optimum - episode_return,
    }


def held(*outcomes: dict[str, object]) -> dict[str, tuple[int, int]]:
    weighed = weigh(pd.DataFrame(outcomes))
    counts = zip(weighed["held"].astype(int), weighed["trials"].astype(int), strict=True)
    return dict(zip(weighed["claim"].astype(str), counts, strict=True))


def test_a_plain_agent_that_does_not_arrive_stays() -> None:
    found = held(
        outcome("rivergrid-1a", "none", -20.0, 0.0),
        outcome("rivergrid-1a", "none", 9.5, 5.0),
        outcome("rivergrid-1a", "dynamic", -20.0, 0.0),
    )
    assert found["the plain agent stays at the start on 1a"] == (1, 2)
    assert found["the dynamic curriculum finds the crossing on 1a"] == (0, 1)


def test_crossing_on_1b_violates_and_is_not_the_optimum_though_its_return_is_higher() -> None:
    found = held(
        outcome("rivergrid-1b", "linear", 9.5, 5.0),
        outcome("rivergrid-1b", "cosine", 9.1, 1.009),
        outcome("rivergrid-1b", "dynamic", 9.5, 5.0),
        outcome("rivergrid-1b", "dynamic", 8.91, 0.1),
        outcome("rivergrid-1b", "dynamic", 8.89, 0.1),
        outcome("rivergrid-1b", "none", 9.1, 1.06),
    )
    assert found == {
        "every static curriculum violates d_d on 1b": (1, 2),
        "the dynamic curriculum finds the optimum on 1b": (1, 3),
        "the plain agent finds the optimum on 1b": (0, 1),
    }


def test_the_share_has_wilsons_interval() -> None:
    weighed = weigh(pd.DataFrame([outcome("rivergrid-1a", "linear", 9.5, 5.0)] * 5))
    assert weighed["share_low"].item() == pytest.approx(0.5655, abs=1e-4)  # 1 / (1 + 1.96^2 / 5)
    assert claims_table(weighed)["holds in"].item() == "5 of 5 (57–100%)"
    table = claims_table(pd.concat([weighed, weighed.assign(held=3), weighed.assign(held=0)]))
    assert table["holds here"].tolist() == ["yes", "mixed", "no"]


def test_the_deployment_phase_is_counted_beside_and_apart() -> None:
    final = outcome("rivergrid-1a", "linear", -20.0, 0.0)
    deployed = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deployment"}
    weighed = weigh(pd.DataFrame([final, deployed]))
    assert (weighed["held"].item(), weighed["deployment_held"].item()) == (0, 1)
    assert claims_table(weighed)["deployment phase (learning goes on)"].item() == "1 of 1"


def test_other_tasks_and_other_measures_are_not_counted() -> None:
    other = outcome("PointGoal2", "linear", 9.5, 5.0)
    greedy = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deterministic"}
    assert weigh(pd.DataFrame([other, greedy])).empty


def trial(method: str, seed: int, episode_return: float, cost: float = 20.0, **others: Any) -> dict[str, Any]:
    made = {"task": "CarGoal2", "agent": "ppo-lag", "method": method, "seed": seed, "measure": "stochastic"}
    return {**made, "episode_return": episode_return, "cost_0": cost, "deploy_limit_0": 25.0, **others}


def test_a_comparison_counts_seeds_with_their_paired_difference_and_the_papers_range() -> None:
    rows = [
        *(trial("none", seed, value) for seed, value in enumerate((4.0, 2.0, 3.0))),
        *(trial("linear", seed, value) for seed, value in enumerate((5.0, 4.0, 3.0))),
        trial("linear", 9, 100.0),  # no seed of `none`
        *(trial("linear", seed, 0.0, measure="deployment") for seed in range(3)),
        *(trial("none", seed, 1.0 - seed, measure="deployment") for seed in range(3)),
    ]
    weighed = weigh(pd.DataFrame(rows))
    line = weighed[weighed["claim"] == "linear returns more than none on CarGoal2"].iloc[0]
    assert (line["held"], line["trials"], line["deployment_held"]) == (2, 3, 1)
    assert line["difference"] == pytest.approx(1.0)
    assert line["difference_high"] == pytest.approx(
        1.0 + 4.302653 / 3**0.5, abs=1e-5
    )  # t_2 s / sqrt(3), s = 1
    assert line["relative_difference"] == pytest.approx(1.0 / 3.0)
    assert line["paper"] == "20% to 600%"
    shown = claims_table(weighed).set_index("claim").loc[line["claim"]]
    assert shown["difference"] == "+1.00 (-1.48 to +3.48)"
    assert (shown["relative"], shown["in the paper"]) == ("+33%", "20% to 600%")


def test_dynamic_must_beat_the_best_static_curriculum_of_its_seed() -> None:
    rows = [trial("dynamic", 0, 5.0), trial("dynamic", 1, 5.0)]
    rows += [trial(method, 0, 4.0) for method in claims.STATIC]
    rows += [trial(method, 1, 4.0) for method in claims.STATIC[:2]]  # one is missing
    line = (
        weigh(pd.DataFrame(rows))
        .set_index("claim")
        .loc["dynamic returns more than every static curriculum on CarGoal2"]
    )
    assert (line["held"], line["trials"]) == (1, 1)
    rows.append(trial("exponential", 1, 6.0))
    line = (
        weigh(pd.DataFrame(rows))
        .set_index("claim")
        .loc["dynamic returns more than every static curriculum on CarGoal2"]
    )
    assert (line["held"], line["trials"]) == (1, 2)
    assert line["difference"] == pytest.approx((1.0 - 1.0) / 2)


def test_the_limit_is_a_claim_of_each_agent() -> None:
    rows = [trial("none", 0, 1.0, cost) for cost in (20.0, 30.0)]
    rows += [trial("dynamic", 0, 1.0, 60.0, agent="cpo"), trial("dynamic", 0, 1.0, 60.0, agent="min-std")]
    weighed = weigh(pd.DataFrame(rows)).set_index("claim")
    assert tuple(weighed.loc["ppo-lag keeps d_d on CarGoal2", ["held", "trials"]]) == (1, 2)
    assert tuple(weighed.loc["cpo violates d_d on CarGoal2", ["held", "trials"]]) == (1, 1)
    assert len(weighed) == 2  # no claim is about another label


def test_costs_of_training_are_compared_per_episode() -> None:
    costs = {"linear": 300.0, "cosine": 400.0, "exponential": 200.0}
    training = pd.DataFrame(
        {**trial(method, 0, 0.0), "episodes": 10, "cost_0_total": total} for method, total in costs.items()
    )
    weighed = weigh(pd.DataFrame([trial("linear", 0, 1.0)]), training).set_index("claim")
    least = weighed.loc["exponential has the lowest cost of training of the static curricula on CarGoal2"]
    most = weighed.loc["cosine has the highest cost of training of the static curricula on CarGoal2"]
    assert (least["held"], most["held"]) == (1, 1)
    assert (least["difference"], most["difference"]) == pytest.approx((10.0, 10.0))
    assert (least["deployment_held"], most["relative_difference"]) == (-1, pytest.approx(1.0 / 3.0))
    table = claims_table(weighed.reset_index())
    assert table["difference"].tolist()[-2:] == ["+10.00", "+10.00"]
    assert table["deployment phase (learning goes on)"].tolist()[-2:] == ["", ""]
