"""The paper's claims about RiverGrid, counted on made-up outcomes."""

import pandas as pd
import pytest

from recrl.analysis.statistics.claims import claims_table, weigh


def outcome(task: str, method: str, episode_return: float, cost: float) -> dict[str, object]:
    limit, optimum = {"rivergrid-1a": (5.0, 9.5), "rivergrid-1b": (1.0, 9.1)}.get(task, (5.0, 9.0))
    return {
        "task": task,
        "agent": "cpo",
        "method": method,
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
    assert claims_table(weighed)["final policy"].item() == "5 of 5 (57–100%)"
    table = claims_table(pd.concat([weighed, weighed.assign(held=3), weighed.assign(held=0)]))
    assert table["holds here"].tolist() == ["yes", "mixed", "no"]


def test_the_deployment_phase_is_counted_beside_and_apart() -> None:
    final = outcome("rivergrid-1a", "linear", -20.0, 0.0)
    deployed = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deployment"}
    weighed = weigh(pd.DataFrame([final, deployed]))
    assert (weighed["held"].item(), weighed["deployment_held"].item()) == (0, 1)
    assert claims_table(weighed)["deployment phase (learning goes on)"].item() == "1 of 1"


def test_other_tasks_and_other_measures_are_not_counted() -> None:
    other = outcome("CarGoal2", "linear", 9.5, 5.0)
    greedy = {**outcome("rivergrid-1a", "linear", 9.5, 5.0), "measure": "deterministic"}
    assert weigh(pd.DataFrame([other, greedy])).empty
