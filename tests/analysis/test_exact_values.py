"""Final policies of finite tasks are worth what theory and their own episodes say."""

from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data import export
from recrl.analysis.data.exact_values import exact_values, finite_model
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics import metrics
from recrl.environments import plugins

RIVERGRID = Path(__file__).parents[2] / "results" / "rivergrid" / "rivergrid.zip"
KEYS = ["task", "agent", "method", "seed"]


@pytest.fixture(scope="module")
def rivergrid() -> Sweep:
    return export.load(RIVERGRID)


def two_state(camp: tuple[float, float], mine: tuple[float, float]) -> pd.DataFrame:
    table = pd.DataFrame([camp, mine], columns=["action_0", "action_1"]).rename_axis("state").reset_index()
    return table.assign(task="mine", agent="cpo", method="none", seed=0)


def test_two_state_by_hand() -> None:
    models = {"mine": finite_model("two-state", {"horizon": 10})}
    # the camp is left at once, then 9 careful steps earn 1 each, and a hasty one 2 at a cost of 1
    values = exact_values(two_state((0.0, 1.0), (0.6, 0.4)), models).set_index("policy")
    assert list(values.loc["stochastic", ["episode_return", "cost_0"]]) == pytest.approx([12.6, 3.6])
    assert list(values.loc["deterministic", ["episode_return", "cost_0"]]) == [9.0, 0.0]


def test_rounded_tables_sum_to_one_again() -> None:
    models = {"mine": finite_model("two-state", {"horizon": 10})}
    values = exact_values(two_state((0.0, 1.0), (0.300001, 0.2)), models).set_index("policy")
    assert values.empty  # this is no rounding
    values = exact_values(two_state((0.0, 1.0), (0.6000003, 0.4000002)), models).set_index("policy")
    assert values.loc["stochastic", "cost_0"] == pytest.approx(9 * 0.4000002 / 1.0000005, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "options"),
    [("nobody:provides", {}), ("CarGoal2", {}), ("two-state", {"hats": 3}), ("broken", {})],
)
def test_tasks_that_are_not_finite_or_not_here_have_no_model(
    name: str, options: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = EntryPoint("broken", "no_such_module:TASK", "recrl.tasks")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [broken] if group == broken.group else [])
    assert finite_model(name, options) is None
    assert exact_values(two_state((0.0, 1.0), (1.0, 0.0)), {"mine": finite_model(name, options)}).empty


def test_exact_values_agree_with_the_recorded_episodes(rivergrid: Sweep) -> None:
    sampled = rivergrid.evaluations.groupby([*KEYS, "policy"], observed=True)
    names = ["episode_return", "cost_0"]
    means, errors = sampled[names].mean(), sampled[names].sem()
    exact = rivergrid.exact.set_index([*KEYS, "policy"]).loc[means.index, names]
    assert len(exact) == 200
    greedy = means.index.get_level_values("policy") == "deterministic"
    # RiverGrid and this policy are deterministic: every episode is the same
    assert np.allclose(means[greedy], exact[greedy], atol=1e-9)
    # 100 episodes each: within 6 standard errors, and rare events that no episode saw
    assert ((means - exact).abs() <= 6.0 * errors + 0.1)[~greedy].to_numpy().mean() > 0.99


def test_outcomes_take_the_exact_values_of_the_final_policy_only(rivergrid: Sweep) -> None:
    rows = metrics.outcomes(rivergrid)
    assert (rows["exact"] == (rows["measure"] != "deployment")).all()
    assert (rows.loc[rows["exact"], "cost_0_se"] == 0.0).all()
    final = rows[rows["measure"] == "stochastic"].set_index(KEYS)["cost_0"].to_numpy()
    exact = rivergrid.exact[rivergrid.exact["policy"] == "stochastic"]["cost_0"].to_numpy()
    assert final.tolist() == exact.tolist()
