"""Gymnasium's interface of vector environments: resets by a mask, and which rows have a last observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from recrl.environments.registry import make_vector
from recrl.environments.vector import CMDPVectorEnv

MUJOCO = ["CarGoal2", "SafetyAntVelocity"]
TASKS = [*MUJOCO, "continuous-bandit"]
MASK = np.array([False, True, True, False])


def stepped(name: str) -> CMDPVectorEnv:
    """Return four environments after three steps."""
    environments = make_vector(name, 4, options={"horizon": 8})
    environments.reset(seed=0)
    for action in actions(environments, 3):
        environments.step(action)
    return environments


def actions(environments: CMDPVectorEnv, steps: int) -> list[Any]:
    environments.action_space.seed(0)
    return [environments.action_space.sample() for _ in range(steps)]


@pytest.mark.parametrize("name", TASKS)
def test_a_reset_by_a_mask_restarts_these_environments_alone(name: str) -> None:
    masked, restarted, untouched = stepped(name), stepped(name), stepped(name)
    seen, info = masked.reset(options={"reset_mask": MASK})
    assert info == {}
    assert np.array_equal(seen, restarted.restart(np.flatnonzero(MASK)))
    ended = []
    for action in actions(masked, 5):
        one, other, third = (each.step(action) for each in (masked, restarted, untouched))
        for mine, expected in zip(one[:4], other[:4], strict=True):
            assert np.array_equal(mine, expected)
        ended.append(one[3])
        assert np.array_equal(one[1][~MASK], third[1][~MASK])
        assert np.array_equal(one[0][~MASK], third[0][~MASK])
    assert np.array_equal(ended[-1], ~MASK), "the others went on"


@pytest.mark.parametrize("name", MUJOCO)
def test_a_seed_with_a_mask_is_for_these_environments_alone(name: str) -> None:
    masked, untouched = stepped(name), stepped(name)
    seen, _ = masked.reset(seed=7, options={"reset_mask": MASK})
    expected, _ = stepped(name).reset(seed=7)
    assert np.array_equal(seen[MASK], expected[MASK])
    assert not np.array_equal(seen[~MASK], expected[~MASK])
    everyone = np.arange(4)
    assert np.array_equal(masked.restart(everyone)[~MASK], untouched.restart(everyone)[~MASK])


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize(
    ("options", "kind", "problem"),
    [
        ({"map": 1, "x": 2}, ValueError, "the only option of reset is 'reset_mask', got map, x"),
        ({"reset_mask": MASK, "x": 2}, ValueError, "the only option of reset is 'reset_mask', got x"),
        ({"reset_mask": [True] * 4}, TypeError, "reset_mask must be an array of booleans, got list"),
        ({"reset_mask": np.ones(4)}, TypeError, "reset_mask must be an array of booleans, got float64"),
        (
            {"reset_mask": np.array([True])},
            ValueError,
            "reset_mask must have shape (4,) and at least one True, got [True]",
        ),
        (
            {"reset_mask": np.zeros(4, np.bool_)},
            ValueError,
            "reset_mask must have shape (4,) and at least one True, got [False, False, False, False]",
        ),
    ],
)
def test_other_options_and_bad_masks_are_refused(
    name: str, options: dict[str, Any], kind: type[Exception], problem: str
) -> None:
    environments = stepped(name)
    before = environments.state_dict()
    with pytest.raises(kind) as error:
        environments.reset(seed=3, options=options)
    assert str(error.value) == f"{name}: {problem}"
    np.testing.assert_equal(environments.state_dict(), before)


@pytest.mark.parametrize("name", TASKS)
def test_the_first_reset_has_no_mask(name: str) -> None:
    environments = make_vector(name, 4)
    with pytest.raises(ValueError, match=f"^{name}: call reset without a reset_mask first$"):
        environments.reset(seed=0, options={"reset_mask": MASK})
    first, _ = environments.reset(seed=0, options={})
    assert np.array_equal(first, make_vector(name, 4).reset(seed=0)[0])


def test_gymnasiums_statistics_understand_masks_and_ends() -> None:
    environments = RecordEpisodeStatistics(make_vector("CarGoal2", 4, options={"horizon": 8}))
    environments.reset(seed=0)
    for action in actions(environments.unwrapped, 3):  # type: ignore[arg-type]
        environments.step(action)
    environments.reset(options={"reset_mask": MASK})
    for action in actions(environments.unwrapped, 5):  # type: ignore[arg-type]
        *_, info = environments.step(action)
    assert info["episode"]["l"].tolist() == [8, 0, 0, 8]


@pytest.mark.parametrize("name", TASKS)
def test_a_mask_says_which_rows_have_a_last_observation(name: str) -> None:
    environments = stepped(name)
    environments.reset(options={"reset_mask": MASK})
    for action in actions(environments, 4):
        *_, info = environments.step(action)
        assert not {"final_obs", "_final_obs"} & info.keys()
    _, _, terminated, truncated, info = environments.step(action)
    assert info["_final_obs"].tolist() == (terminated | truncated).tolist() == [True, False, False, True]
    assert info["_final_obs"] is not truncated


def test_gymnasiums_lists_have_a_last_observation_where_an_episode_ended() -> None:
    environments = DictInfoToList(stepped("CarGoal2"))
    environments.unwrapped.reset(options={"reset_mask": MASK})
    for action in actions(environments.unwrapped, 5):  # type: ignore[arg-type]
        infos: Any = environments.step(action)[4]
    assert ["final_obs" in info for info in infos] == [True, False, False, True]
    assert all("cost" in info for info in infos)
