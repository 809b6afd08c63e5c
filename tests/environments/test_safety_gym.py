"""Safety Gym's tasks as environments: registered, seeded, picklable, resumable, strict about actions."""

from __future__ import annotations

import copy
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env

from recrl.environments.safety_gym.layout import keepouts
from recrl.environments.safety_gym.safety_gym_environments import (
    SafetyGymEnv,
    SafetyGymOptions,
    SafetyGymVectorEnv,
)
from recrl.environments.safety_gym.scene import rotation_matrices
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS

SIZES = {"Goal": (40, 72, 72), "Button": (56, 88, 88), "Push": (56, 88, 88)}
LEVEL_2 = [name for name in SAFETY_TASKS if name.startswith("Car") and name.endswith("2")]


def held_actions(steps: int, num_envs: int, seed: int = 0) -> npt.NDArray[np.float64]:
    """Random, held for 20 steps."""
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps // 20 + 1, num_envs, 2))
    held: npt.NDArray[np.float64] = np.repeat(drawn, 20, axis=0)[:steps]
    return held


def drive(environment: SafetyGymEnv) -> npt.NDArray[np.float64]:
    """Turn the Car towards the goal's place in its own frame, and drive; its front is -y."""
    batch = environment.batch
    offset = batch.points[0, batch.group["goal"].start] - batch.qpos[0, :2]
    x, y = offset @ rotation_matrices(batch.qpos[0, 3:7])[:2, :2]
    angle = np.arctan2(x, -y)
    forwards, turn = max(np.cos(angle), 0.0), np.clip(angle, -1.0, 1.0)
    wheels: npt.NDArray[np.float64] = np.clip(np.array([forwards + turn, forwards - turn]), -1.0, 1.0)
    return wheels


def heading(environment: SafetyGymEnv) -> npt.NDArray[np.float64]:
    """Direction in which the robot drives, [2]: the Car's front is -y, the Point's x."""
    qpos = environment.batch.qpos[0]
    if environment.batch.task.robot == "Point":
        return np.array([np.cos(qpos[2]), np.sin(qpos[2])])
    return np.asarray(-rotation_matrices(qpos[3:7])[:2, 1])


def as_bytes(transition: tuple[Any, ...]) -> bytes:
    *arrays, info = transition
    named = [info[name] for name in sorted(info)]
    return b"".join(np.ascontiguousarray(array).tobytes() for array in (*arrays, *named))


@pytest.mark.parametrize("name", SAFETY_TASKS)
def test_every_task_is_registered_with_gymnasium(name: str) -> None:
    task = SAFETY_TASKS[name]
    single = gymnasium.make(f"recrl.environments.registration:recrl/{name}-v0")
    expected = SIZES[task.goal][task.level] - (12 if task.robot == "Point" else 0)
    assert single.observation_space.shape == (expected,)
    assert single.action_space.shape == (2,)
    batch = gymnasium.make_vec(f"recrl.environments.registration:recrl/{name}-v0", num_envs=2)
    assert isinstance(batch.unwrapped, SafetyGymVectorEnv)
    assert batch.reset(seed=1)[0].shape == (2, expected)


@pytest.mark.parametrize("name", ["CarGoal2", "CarButton2", "PointPush2"])
def test_gymnasium_finds_nothing_wrong(name: str) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinity.*")  # sensors have no bounds, as in Safety Gym
        check_env(SafetyGymEnv(name), skip_render_check=True)


def test_components_are_sorted_by_name_as_safety_gym_does() -> None:
    goal, button, push = (SAFETY_TASKS[name] for name in ("CarGoal2", "CarButton2", "CarPush2"))
    assert [goal.where(part).start for part in ("goal_lidar", "hazards_lidar", "vases_lidar")] == [15, 34, 53]
    assert [button.where(f"{part}_lidar").start for part in ("buttons", "gremlins", "hazards")] == [
        15,
        47,
        66,
    ]
    assert [push.where(f"{part}_lidar").start for part in ("box", "goal", "pillars")] == [15, 31, 69]
    assert push.where("velocimeter") == slice(85, 88)


def test_a_single_environment_is_the_first_of_a_batch_with_its_seed() -> None:
    single, batch = SafetyGymEnv("CarButton2"), SafetyGymVectorEnv("CarButton2", 3)
    assert np.array_equal(single.reset(seed=4)[0], batch.reset(seed=4)[0][0])
    for action in held_actions(40, 3):
        observation, reward, *_ = single.step(action[0])
        observations, rewards, *_ = batch.step(action)
        assert np.array_equal(observation, observations[0])
        assert reward == rewards[0]


@pytest.mark.parametrize("name", LEVEL_2)
def test_results_do_not_depend_on_threads(name: str) -> None:
    streams = []
    for num_threads in (1, 2, 3, 8):
        environment = SafetyGymVectorEnv(name, 6, num_threads=num_threads)
        environment.reset(seed=0)
        steps = [as_bytes(environment.step(action)) for action in held_actions(60, 6)]
        streams.append([*steps, environment.batch.simulations.rows.tobytes()])
    assert streams[1:] == streams[:1] * 3


@pytest.mark.parametrize("name", LEVEL_2)
def test_a_resumed_run_is_the_uninterrupted_one_after_thousands_of_steps(name: str) -> None:
    environment, actions = SafetyGymVectorEnv(name, 1), held_actions(2200, 1)
    environment.reset(seed=1)
    for action in actions[:1700]:
        environment.step(action)
    state = environment.state_dict()
    if name == "CarGoal2":
        assert (state["physics"]["asleep"] >= 0).any()
    resumed = SafetyGymVectorEnv(name, 1)
    resumed.load_state_dict(state)
    for action in actions[1700:]:  # over the end of an episode, too
        assert as_bytes(environment.step(action)) == as_bytes(resumed.step(action))


@pytest.mark.parametrize("name", ["CarGoal2", "PointButton1"])
def test_pickled_environments_continue_alike(name: str) -> None:
    environment = SafetyGymVectorEnv(name, 2)
    unused = pickle.loads(pickle.dumps(environment))  # noqa: S301
    environment.reset(seed=1)
    unused.reset(seed=1)
    for action in held_actions(50, 2):
        environment.step(action)
        unused.step(action)
    copied = pickle.loads(pickle.dumps(environment))  # noqa: S301
    for action in held_actions(50, 2, seed=1):
        expected = as_bytes(environment.step(action))
        assert as_bytes(copied.step(action)) == expected
        assert as_bytes(unused.step(action)) == expected


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([[0.0, np.nan]], "CarGoal1: actions must be finite, got [[0.0, nan]]"),
        ([[0.0, -np.inf]], "CarGoal1: actions must be finite, got [[0.0, -inf]]"),
        ([[0.0]], "CarGoal1: actions must be numbers of shape (1, 2), got float64 of shape (1, 1)"),
    ],
)
def test_bad_actions_get_one_clear_sentence(actions: list[list[float]], message: str) -> None:
    environment = SafetyGymVectorEnv("CarGoal1", 1)
    environment.reset(seed=0)
    before = environment.batch.simulations.rows.copy()
    with pytest.raises(ValueError, match="actions") as error:
        environment.step(np.array(actions))
    assert str(error.value) == message
    assert np.array_equal(environment.batch.simulations.rows, before)


def test_actions_out_of_range_are_clipped() -> None:
    streams = []
    for action in ([3.0, -7.0], [1.0, -1.0]):
        environment = SafetyGymEnv("CarGoal0")
        environment.reset(seed=0)
        streams.append([environment.step(np.array(action))[0].tobytes() for _ in range(5)])
    assert streams[0] == streams[1]


def test_one_cost_a_term_sums_to_what_the_single_cost_indicates() -> None:
    single, several = SafetyGymVectorEnv("CarGoal2", 4), SafetyGymVectorEnv("CarGoal2", 4, cost="per_hazard")
    assert single.cmdp.cost_names == ("cost",)
    assert several.cmdp.cost_names == ("hazards", "vases_contact", "vases_velocity")
    single.reset(seed=2)
    several.reset(seed=2)
    costly = 0
    for action in held_actions(300, 4):
        one, many = single.step(action)[4], several.step(action)[4]
        assert np.array_equal(one["cost"][:, 0], many["cost"].max(axis=1))
        assert np.array_equal(many["cost"][:, 1], one["cost_vases_contact"])
        costly += int(one["cost"].sum())
    assert costly > 0


def test_the_option_for_several_costs_says_that_there_is_one_for_each_term() -> None:
    description = str(SafetyGymOptions.model_fields["cost"].description)
    assert "per_hazard: one cost for each cost term" in description
    assert ", ".join(SAFETY_TASKS["CarGoal2"].cost_terms) in description


def test_costs_of_a_task_without_hazards_cannot_be_told_apart() -> None:
    with pytest.raises(
        ValueError,
        match="CarPush0: cost must be 'indicator', as nothing costs at level 0, got 'per_hazard'",
    ):
        SafetyGymEnv("CarPush0", cost="per_hazard")


def test_reaching_a_goal_pays_one_and_brings_another() -> None:
    environment = SafetyGymEnv("CarGoal0")
    environment.reset(seed=3)
    batch = environment.batch
    goals = 0
    while goals < 3:
        before = batch.distances[0, 0]
        _, reward, terminated, truncated, info = environment.step(drive(environment))
        assert not terminated
        assert not truncated
        if info["goal_met"]:
            goals += 1
            assert 1.0 < reward < 1.0 + 0.1
            assert batch.distances[0, 0] > 0.4 + 0.305 - 1e-9
        else:
            assert reward == pytest.approx(before - batch.distances[0, 0])


def test_buttons_hide_for_ten_steps_after_one_was_pressed() -> None:
    environment = SafetyGymEnv("CarButton0")
    observation, _ = environment.reset(seed=0)
    lidar = environment.batch.task.where("buttons_lidar")
    assert observation[lidar].any()
    met = False
    while not met:
        observation, reward, *_, info = environment.step(drive(environment))
        met = bool(info["goal_met"])
    assert reward > 0.9
    assert not observation[lidar].any()
    backwards = np.array([-1.0, -1.0])
    seen = [environment.step(backwards)[0][lidar].any() for _ in range(12)]
    if not environment.batch.touching[0, environment.batch.scene.touchable["buttons"]].any():
        assert seen[-1]
    assert not any(seen[:9])


def test_an_episode_is_truncated_after_a_thousand_steps() -> None:
    environment = SafetyGymEnv("PointGoal1")
    environment.reset(seed=0)
    for step in range(1, 1001):
        _, _, terminated, truncated, _ = environment.step(np.zeros(2))
        assert (terminated, truncated) == (False, step == 1000)


def test_who_goes_on_after_the_end_of_an_episode_meets_gremlins_where_they_were() -> None:
    environment = SafetyGymVectorEnv("CarButton2", 2)
    environment.reset(seed=0)
    environment.batch.steps[:] = 5000
    environment.batch.embodied[0] = 0
    environment.batch.advance()
    assert np.isfinite(environment.batch.observations()).all()


@pytest.mark.parametrize("name", LEVEL_2)
def test_broken_physics_ends_the_episode_with_a_penalty(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    environment = SafetyGymVectorEnv(name, 2)
    environment.reset(seed=0)
    environment.batch.qvel[1, 0] = 1e12
    observations, rewards, terminated, truncated, info = environment.step(np.zeros((2, 2)))
    assert rewards[1] == -10.0
    assert terminated.tolist() == [False, True]
    assert not truncated.any()
    assert info["cost_exception"].tolist() == [0.0, 1.0]
    assert info["cost"][1].tolist() == [0.0]
    assert np.isfinite(observations).all()
    assert np.isfinite(info["final_obs"]).all()
    *_, terminated, _, info = environment.step(np.zeros((2, 2)))
    assert not terminated.any()
    assert "cost_exception" not in info


def test_an_episode_ends_when_there_is_no_room_for_a_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = SafetyGymEnv("CarGoal0")
    environment.reset(seed=0)
    monkeypatch.setattr("recrl.environments.safety_gym.safety_gym_batch.sample_goal", lambda *_: None)
    terminated, info = False, {"goal_met": False}
    while not terminated:
        assert not info["goal_met"]
        *_, terminated, truncated, info = environment.step(drive(environment))
    assert info["goal_met"]
    assert not truncated


def test_a_refused_action_leaves_no_trace_in_a_copy() -> None:
    environment = SafetyGymVectorEnv("CarGoal2", 2)
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="actions must be finite"):
        environment.step(np.full((2, 2), np.nan))
    twin = copy.deepcopy(environment)
    for action in held_actions(5, 2):
        assert as_bytes(environment.step(action)) == as_bytes(twin.step(action))


def test_costs_share_no_memory_with_their_terms() -> None:
    environment = SafetyGymVectorEnv("CarGoal2", 2, cost="per_hazard")
    environment.reset(seed=0)
    info = environment.step(np.zeros((2, 2)))[4]
    terms = [info[f"cost_{name}"] for name in environment.cmdp.cost_names]
    assert not any(np.shares_memory(info["cost"], term) for term in terms)


def test_an_episode_without_room_for_another_goal_begins_with_that_of_its_layout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    environment = SafetyGymVectorEnv("CarGoal2", 20)
    environment.reset(seed=0)
    monkeypatch.setattr("recrl.environments.safety_gym.safety_gym_batch.sample_goal", lambda *_: None)
    environment.reset(seed=1)
    batch = environment.batch
    goals = batch.points[:, batch.group["goal"].start]
    for kind in ("hazards", "vases"):
        apart = np.linalg.norm(batch.points[:, batch.group[kind]] - goals[:, None], axis=-1)
        assert apart.min() >= sum(keepouts(batch.task)[it][1] for it in (kind, "goal"))


def test_an_unknown_task_or_option_is_refused() -> None:
    with pytest.raises(ValueError, match=r"task must be one of CarGoal0, .*, got 'DoggoGoal1'"):
        SafetyGymEnv("DoggoGoal1")
    with pytest.raises(ValueError, match="lidar_bins"):
        SafetyGymEnv("CarGoal1", lidar_bins=10)


@pytest.mark.parametrize("name", [*LEVEL_2, "PointButton2", "PointGoal2", "PointPush2"])
def test_what_a_robot_touches_is_what_mujoco_has_in_contact_with_it(name: str) -> None:
    environment = SafetyGymVectorEnv(name, 4)
    environment.reset(seed=7)
    batch, model = environment.batch, environment.batch.scene.model
    kinds, data = batch.scene.touchable, batch.simulations.data(0)
    felt = dict.fromkeys(kinds, 0)
    for action in held_actions(250, 4, seed=2):
        environment.step(action)
        for index in range(4):
            contact = batch.simulations.data(index, into=data).contact
            roots = model.body_rootid[model.geom_bodyid[contact.geom]]
            others = {int(other) for pair in roots for other in pair if batch.scene.robot_body in pair}
            for kind, bodies in kinds.items():
                expected = [body in others for body in range(bodies.start, bodies.stop)]
                assert batch.touching[index, bodies].tolist() == expected
                felt[kind] += sum(expected)
    assert all(felt.values()), felt


@pytest.mark.parametrize("name", ["CarPush2", "PointPush2"])
@pytest.mark.parametrize("cost", ["indicator", "per_hazard"])
def test_a_pillar_costs_one_while_the_robot_touches_it_and_nothing_else(name: str, cost: str) -> None:
    environment = SafetyGymEnv(name, cost=cost)
    environment.reset(seed=0)
    batch = environment.batch
    batch.points[0, batch.group["hazards"]] = 50.0  # out of reach
    batch.mocap_pos[0, batch.scene.pillar_mocap[0], :2] = batch.qpos[0, :2] + 0.5 * heading(environment)
    forwards, costs = {"Car": [1.0, 1.0], "Point": [1.0, 0.0]}[batch.task.robot], []
    for _ in range(60):
        *_, info = environment.step(np.array(forwards))
        touched = batch.touching[0, batch.scene.touchable["pillars"]]
        assert info["cost_pillars"] == float(touched.any())
        costs.append(info["cost"].tolist())
    free, costly = ([0.0], [1.0]) if cost == "indicator" else ([0.0, 0.0], [0.0, 1.0])
    assert costs[0] == free
    assert costly in costs
    assert all(each in (free, costly) for each in costs)


@pytest.mark.parametrize("name", ["CarButton2", "PointButton2"])
def test_a_gremlin_costs_one_while_the_robot_touches_it(name: str) -> None:
    environment = SafetyGymVectorEnv(name, 16)
    environment.reset(seed=0)
    gremlins, costs = environment.batch.scene.touchable["gremlins"], set()
    for action in held_actions(300, 16, seed=2):
        *_, info = environment.step(action)
        touched = environment.batch.touching[:, gremlins].any(axis=1)
        assert info["cost_gremlins"].tolist() == touched.astype(float).tolist()
        costs |= set(info["cost_gremlins"].tolist())
    assert costs == {0.0, 1.0}


def test_robots_cannot_tell_that_gremlins_far_away_are_no_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    some = SafetyGymVectorEnv("CarButton2", 4)
    monkeypatch.setattr(
        "recrl.environments.safety_gym.task_record.ALERT", 100.0
    )  # the nearest is always a body
    always = SafetyGymVectorEnv("CarButton2", 4)
    some.reset(seed=8)
    always.reset(seed=8)
    untouched, bodies = np.ones(4, np.bool_), 0
    for action in held_actions(250, 4, seed=3):
        seen, expected = some.step(action)[0], always.step(action)[0]
        assert (always.batch.embodied >= 0).all()
        bodies += int((some.batch.embodied >= 0).sum())
        # Off their course, or where touching makes chaos of the smallest difference, they may differ.
        untouched &= ~(some.batch.touching | always.batch.touching).any(axis=1)
        np.testing.assert_allclose(seen[untouched], expected[untouched], atol=2e-3)
        robots = some.batch.qpos[untouched, :13], always.batch.qpos[untouched, :13]
        np.testing.assert_allclose(*robots, rtol=0.0, atol=1e-9)
    assert 0 < bodies < 1000
    assert untouched.any()
