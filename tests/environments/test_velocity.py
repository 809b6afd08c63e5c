"""Velocity tasks: safety-gymnasium's in every recorded state, Gymnasium's robots, a cost above a speed."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from recrl.environments.cmdp import Floats
from recrl.environments.registry import find_task, make_drawn
from recrl.environments.simulation.camera import RenderingUnavailableError
from recrl.environments.velocity.model import make_model
from recrl.environments.velocity.task_definitions import VELOCITY_TASKS
from recrl.environments.velocity.velocity_batch import VelocityBatch
from recrl.environments.velocity.velocity_environments import VelocityEnv, VelocityVectorEnv
from tests.benchmarks.velocity_parity import compare_velocity_recording

TASKS = list(VELOCITY_TASKS)
ROBOTS = [task.robot for task in VELOCITY_TASKS.values()]
FALLING = [name for name in TASKS if VELOCITY_TASKS[name].healthy is not None]
RECORDINGS = Path(__file__).parents[1] / "parity_velocity"


def two_robots(name: str) -> VelocityVectorEnv:
    environment = VelocityVectorEnv(name, 2)
    environment.reset(seed=0)
    return environment


def still(environment: VelocityVectorEnv) -> Floats:
    return np.zeros(environment.action_space.shape or ())


def random_actions(environment: VelocityVectorEnv, steps: int, seed: int = 0) -> list[Any]:
    environment.action_space.seed(seed)
    return [environment.action_space.sample() for _ in range(steps)]


def as_bytes(transition: tuple[Any, ...]) -> bytes:
    observations, rewards, terminated, truncated, info = transition
    return b"".join(array.tobytes() for array in (observations, rewards, terminated, truncated, info["cost"]))


@pytest.mark.parametrize("robot", ROBOTS)
def test_robots_are_safety_gymnasiums_in_every_recorded_state(robot: str) -> None:
    episodes = compare_velocity_recording(RECORDINGS / f"velocity_{robot}.npz")
    assert len(episodes) == 6
    for episode in episodes:
        assert episode.equal, episode
    if robot in ("Ant", "Swimmer"):
        assert sum(episode.costly for episode in episodes) > 10, "costs were recorded, too"
    if VELOCITY_TASKS[f"Safety{robot}Velocity"].healthy and robot != "Ant":
        assert all(episode.states < 100 for episode in episodes), "every episode ended in a fall"


def test_what_humanoids_contacts_decide_agrees_but_for_the_solver() -> None:
    """MuJoCo 2.3.3's solver stopped after 50 iterations; no setting of MuJoCo 4's finds the same forces."""
    episodes = compare_velocity_recording(RECORDINGS / "velocity_Humanoid.npz")
    velocities = np.concatenate([episode.velocity for episode in episodes])
    forces = np.concatenate([episode.force for episode in episodes])
    assert len(forces) == 132
    assert velocities.max() < 3e-5
    assert (velocities > 1e-5).sum() <= 5
    assert forces.max() < 3e-3
    assert (forces > 1e-5).sum() <= 27


def gymnasiums_step(name: str, data: mujoco.MjData, action: Floats) -> tuple[Floats, float]:
    """What Gymnasium's environment of version 4 does, on one simulation: (observation, reward)."""
    model, task = make_model(VELOCITY_TASKS[name]), VELOCITY_TASKS[name]

    def place() -> Floats:
        if task.measured == "mass":
            return np.asarray(model.body_mass @ data.xipos / model.body_mass.sum())
        return np.array(data.xpos[1] if task.measured == "torso" else data.qpos)

    before = place()
    data.ctrl[:] = action
    mujoco.mj_step(model, data, task.frame_skip)
    mujoco.mj_rnePostConstraint(model, data)
    forward = (place() - before)[0] / (model.opt.timestep * task.frame_skip)
    parts = [data.qpos[task.hidden :], np.clip(data.qvel, -task.velocity_bound, task.velocity_bound)]
    if task.observes_bodies:
        parts += [data.cinert.ravel(), data.cvel.ravel(), data.qfrc_actuator, data.cfrc_ext.ravel()]
    effort = task.control_weight * float(np.square(action).sum())
    return np.concatenate(parts), task.forward_weight * forward - effort + task.healthy_reward


@pytest.mark.parametrize("name", TASKS)
def test_robots_move_as_gymnasiums_do(name: str) -> None:
    ours = VelocityEnv(name)
    ours.reset(seed=0)
    data = mujoco.MjData(ours.batch.model)
    data.qpos[:], data.qvel[:] = ours.batch.qpos[0], ours.batch.qvel[0]
    mujoco.mj_forward(ours.batch.model, data)
    ours.action_space.seed(1)
    for _ in range(60):
        action = ours.action_space.sample().astype(np.float64)
        observation, reward, *_ = ours.step(action)
        expected, earned = gymnasiums_step(name, data, action)
        assert np.array_equal(observation, expected.astype(np.float32))
        assert reward == pytest.approx(earned, abs=1e-12)


def test_a_robot_rests_where_it_rested_in_mujoco_2() -> None:
    """MuJoCo adds margins up since version 3: with the model's own, Ant would hover a centimetre higher."""
    for name in TASKS:
        model = make_model(VELOCITY_TASKS[name])
        assert len(np.unique(model.geom_margin)) == 1
    ant = make_model(VELOCITY_TASKS["SafetyAntVelocity"])
    assert 2.0 * ant.geom_margin[0] == 0.01
    cheetah = make_model(VELOCITY_TASKS["SafetyHalfCheetahVelocity"])
    assert cheetah.body_mass.sum() == pytest.approx(14.0)


@pytest.mark.parametrize("name", TASKS)
def test_a_step_costs_one_above_the_threshold_and_nothing_below(name: str) -> None:
    environment = two_robots(name)
    batch, threshold = environment.batch, VELOCITY_TASKS[name].threshold
    batch.qvel[0, 0] = 1.5 * threshold + 0.5
    batch.qvel[1, 0] = 0.0
    _, rewards, _, _, info = environment.step(still(environment))
    assert info["cost"].tolist() == [[1.0], [0.0]]
    assert info["velocity"][0] > threshold > info["velocity"][1]
    assert rewards[0] > rewards[1]
    # Backwards it costs only where the velocity has no sign.
    batch.qvel[0, 0] = -2.0 * threshold - 1.0
    cost = environment.step(still(environment))[4]["cost"][0, 0]
    assert cost == (1.0 if VELOCITY_TASKS[name].axes == 2 else 0.0)


@pytest.mark.parametrize("name", ["SafetyAntVelocity", "SafetyHumanoidVelocity"])
def test_running_sideways_costs_as_well_but_earns_nothing(name: str) -> None:
    environment = two_robots(name)
    batch, task = environment.batch, VELOCITY_TASKS[name]
    batch.qvel[:] = 0.0
    batch.qvel[0, 1] = 2.0 * task.threshold
    _, rewards, _, _, info = environment.step(still(environment))
    assert info["cost"].tolist() == [[1.0], [0.0]]
    assert rewards[0] == pytest.approx(rewards[1], abs=0.3)


def test_effort_and_health_are_weighed_as_gymnasium_does() -> None:
    weights = {name: (task.forward_weight, task.control_weight) for name, task in VELOCITY_TASKS.items()}
    assert list(weights.values()) == [(1, 0.5), (1, 0.1), (1, 1e-3), (1.25, 0.1), (1, 1e-4), (1, 1e-3)]
    assert [task.healthy_reward for task in VELOCITY_TASKS.values()] == [1, 0, 1, 5, 0, 1]
    batch = VelocityBatch(VELOCITY_TASKS["SafetyHumanoidVelocity"], 1)
    actions = np.full((1, batch.model.nu), 0.2)
    rewards, velocities, costs = batch.rewards_and_costs(np.array([[0.8, 0.6]]), actions)
    assert rewards[0] == pytest.approx(1.25 * 0.8 - 0.1 * 17 * 0.04 + 5.0)
    assert velocities[0] == pytest.approx(1.0)
    assert costs[0] == 0.0


@pytest.mark.parametrize("name", TASKS)
def test_who_has_fallen_begins_anew_and_cheetahs_and_swimmers_never_fall(name: str) -> None:
    environment = two_robots(name)
    batch = environment.batch
    if name == "SafetyAntVelocity":
        batch.qpos[0, 2] = 1.5  # too high
    else:
        batch.qpos[0, 2 if name == "SafetyHumanoidVelocity" else 1] -= 1.3
    _, _, terminated, _, info = environment.step(still(environment))
    assert terminated.tolist() == [name in FALLING, False]
    assert ("final_obs" in info) == (name in FALLING)
    assert batch.steps.tolist() == [0 if name in FALLING else 1, 1]


@pytest.mark.parametrize("name", TASKS)
def test_episodes_begin_near_the_models_own_state(name: str) -> None:
    batch, task = VelocityBatch(VELOCITY_TASKS[name], 300), VELOCITY_TASKS[name]
    batch.seed(0)
    batch.restart(np.arange(300))
    moved = batch.qpos - batch.model.qpos0
    assert task.position_noise * 0.98 < np.abs(moved).max() <= task.position_noise
    if task.normal_velocities:
        assert batch.qvel.std() == pytest.approx(task.velocity_noise, rel=0.05)
    else:
        assert task.velocity_noise * 0.98 < np.abs(batch.qvel).max() <= task.velocity_noise


def test_an_episode_is_truncated_after_a_thousand_steps() -> None:
    environment = two_robots("SafetyHalfCheetahVelocity")
    for _ in range(999):
        assert not environment.step(still(environment))[3].any()
    *_, truncated, info = environment.step(still(environment))
    assert truncated.all()
    assert "final_obs" in info


@pytest.mark.parametrize("name", TASKS)
def test_results_do_not_depend_on_threads(name: str) -> None:
    streams = []
    for num_threads in (1, 2):
        environment = VelocityVectorEnv(name, 3, num_threads=num_threads)
        environment.reset(seed=0)
        streams.append([as_bytes(environment.step(each)) for each in random_actions(environment, 60)])
    assert streams[0] == streams[1]


@pytest.mark.parametrize("name", TASKS)
def test_a_resumed_run_is_the_uninterrupted_one(name: str) -> None:
    environment = VelocityVectorEnv(name, 3)
    environment.reset(seed=1)
    actions = random_actions(environment, 500)
    for step, action in enumerate(actions[:400]):
        environment.step(action)
        if step % 100 == 57:
            resumed = VelocityVectorEnv(name, 3)
            resumed.load_state_dict(environment.state_dict())
    for action in actions[358:400]:
        resumed.step(action)
    for action in actions[400:]:
        assert as_bytes(resumed.step(action)) == as_bytes(environment.step(action))


@pytest.mark.parametrize("name", TASKS)
def test_a_single_environment_is_the_first_of_a_batch_with_its_seed(name: str) -> None:
    single, batch = VelocityEnv(name), VelocityVectorEnv(name, 3)
    assert np.array_equal(single.reset(seed=4)[0], batch.reset(seed=4)[0][0])
    for action in random_actions(batch, 30):
        observation, reward, terminated, _, info = single.step(action[0])
        observations, rewards, _, _, infos = batch.step(action)
        assert reward == rewards[0]
        assert np.array_equal(info["cost"], infos["cost"][0])
        if terminated:
            return
        assert np.array_equal(observation, observations[0])


@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_makes_every_task_and_finds_nothing_wrong(name: str) -> None:
    identity = f"recrl.environments.registration:recrl/{name}-v1"
    environment = gymnasium.make(identity)
    assert environment.metadata["render_fps"] == round(1.0 / environment.unwrapped.batch.seconds)  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # bounds may be infinite
        check_env(environment.unwrapped, skip_render_check=True)
    batch = gymnasium.make_vec(identity, num_envs=2)
    assert batch.reset(seed=0)[0].shape == (2, *(environment.observation_space.shape or ()))


def test_pickled_environments_continue_alike() -> None:
    environment = two_robots("SafetyHumanoidVelocity")
    actions = random_actions(environment, 20)
    for action in actions[:10]:
        environment.step(action)
    copied = pickle.loads(pickle.dumps(environment))  # noqa: S301  # our own
    for action in actions[10:]:
        assert as_bytes(copied.step(action)) == as_bytes(environment.step(action))


def test_bad_actions_get_one_clear_sentence() -> None:
    environment = two_robots("SafetyHumanoidVelocity")
    good = still(environment)
    with pytest.raises(ValueError) as error:
        environment.step(good[:, :-1])
    assert str(error.value) == (
        "SafetyHumanoidVelocity: actions must be numbers of shape (2, 17), got float64 of shape (2, 16)"
    )
    with pytest.raises(ValueError, match="SafetyHumanoidVelocity: actions must be finite, got"):
        environment.step(good + np.nan)
    with pytest.raises(ValueError, match="SafetyAntVelocity: call reset before the first step"):
        VelocityEnv("SafetyAntVelocity").step(np.zeros(8))


def test_actions_out_of_range_are_clipped() -> None:
    clipping, plain = (VelocityVectorEnv("SafetyHopperVelocity", 2) for _ in range(2))
    clipping.reset(seed=0)
    plain.reset(seed=0)
    actions = np.array([[3.0, -0.5, 1.0], [0.1, -7.0, 0.2]])
    assert as_bytes(clipping.step(actions)) == as_bytes(plain.step(np.clip(actions, -1.0, 1.0)))


def test_broken_physics_ends_the_episode_and_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    environment = two_robots("SafetyHalfCheetahVelocity")
    environment.batch.qvel[1] = 1e12
    observations, rewards, terminated, truncated, info = environment.step(still(environment))
    assert terminated.tolist() == [False, True]
    assert not truncated.any()
    assert rewards[1] == 0.0
    assert info["cost"].tolist() == [[0.0], [0.0]]
    assert info["cost_exception"].tolist() == [0.0, 1.0]
    assert np.abs(observations[1]).max() < 1.0, "a new episode has begun"
    *_, info = environment.step(still(environment))
    assert "cost_exception" not in info


def test_an_unknown_task_or_option_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"task must be one of SafetyAntVelocity, .*, got 'SafetyFishVelocity'"
    ):
        VelocityEnv("SafetyFishVelocity")
    with pytest.raises(ValueError, match="Extra inputs are not permitted"):
        VelocityEnv("SafetyAntVelocity", cost="per_hazard")


def test_the_registry_says_what_the_tasks_say() -> None:
    assert find_task("SafetyAntVelocity").summary == (
        "Safety-Gymnasium: Ant runs, at a cost of 1 in each step above 2.6222 m/s."
    )


@pytest.mark.parametrize("name", TASKS)
def test_a_picture_is_rgb_follows_the_robot_and_changes_nothing(name: str) -> None:
    seen, unseen = make_drawn(name), VelocityEnv(name)
    seen.reset(seed=3)
    unseen.reset(seed=3)
    try:
        first: Any = seen.render()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    assert first.shape == (360, 480, 3)
    assert first.dtype == np.uint8
    assert first.std() > 5.0, "there is something to be seen"
    assert np.array_equal(first, np.asarray(seen.render()))
    for _ in range(5):
        action = np.full(unseen.action_space.shape or (), 0.3)
        assert np.array_equal(seen.step(action)[0], unseen.step(action)[0])
        seen.render()
    assert not np.array_equal(first, np.asarray(seen.render()))
    seen.close()


def test_a_picture_needs_a_mode_and_a_reset() -> None:
    with pytest.raises(
        ValueError, match="SafetyAntVelocity: to render, make the environment with render_mode="
    ):
        two_robots("SafetyAntVelocity").render()
    with pytest.raises(ValueError, match="SafetyAntVelocity: call reset before the first frame"):
        VelocityEnv("SafetyAntVelocity", render_mode="rgb_array").render()
