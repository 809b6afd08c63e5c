"""What networks see of an observation."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from recrl.agents.observation_features import Encoder, ProximityObservation, RunningMoments
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CMDPSpec, ObservationComponent
from recrl.environments.gymnasium_adapter import SyncCMDPVectorEnv
from recrl.environments.registry import make_vector
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS

SPEED = ObservationComponent("speed", 1)
WALLS = ObservationComponent("walls_lidar", 2, lidar_range=3.0)


def encoder(*, normalise: bool = False, scales: tuple[float, ...] = (0.15, 0.4)) -> Encoder:
    return Encoder(3, (SPEED, WALLS), scales=scales, normalise=np.full(3, normalise))


def test_proximity_features_are_the_ones_computed_by_hand() -> None:
    """A hazard's centre is 0.3 m away: 10% of the range; the other direction is empty."""
    found = encoder()(np.array([[7.0, 0.9, 0.0]], np.float32))
    assert found.dtype == np.float32
    assert found[0].tolist() == pytest.approx(
        [7.0, 0.9, 0.0, math.exp(-2.0), 0.0, math.exp(-0.75), 0.0], 1e-5
    )


def test_at_a_distance_of_0_every_proximity_is_1() -> None:
    assert encoder()(np.ones((1, 3), np.float32))[0].tolist() == [1.0] * 7


def test_without_a_declared_lidar_nothing_is_added() -> None:
    observations = np.ones((2, 3), np.float32)
    plain = Encoder(3, (), scales=(0.15,), normalise=np.zeros(3, np.bool_))
    assert plain.size == 3
    assert plain(observations) is observations
    assert encoder(scales=()).size == 3


def test_a_normalised_observation_has_mean_0_and_variance_1_over_all_that_was_seen() -> None:
    generator = np.random.default_rng(0)
    parts = [generator.normal((5.0, -3.0), (0.1, 40.0), (n, 2)).astype(np.float32) for n in (1, 70, 400)]
    moments = RunningMoments(2)
    for part in parts:
        moments.add(part)
    found = moments.standardised(np.concatenate(parts))
    assert found.mean(axis=0) == pytest.approx([0.0, 0.0], abs=1e-4)
    assert found.std(axis=0) == pytest.approx([1.0, 1.0], abs=1e-4)


def test_normalisation_clips_and_leaves_constants_at_0() -> None:
    moments = RunningMoments(2)
    moments.add(np.array([[4.0, 0.0], [4.0, 1.0]], np.float32))
    assert moments.standardised(np.array([[4.0, 1e6]], np.float32)).tolist() == [[0.0, 10.0]]


def test_normalisation_changes_only_after_an_update() -> None:
    """What was acted on is what is learnt from; and what is saved goes on as it was."""
    one = encoder(normalise=True)
    before = np.array([[2.0, 0.5, 0.5]], np.float32)
    assert one(before)[0, 0] == 2.0
    one.learn(np.array([[0.0, 0.5, 0.5], [4.0, 0.5, 0.5]], np.float32))
    assert one(before)[0, 0] == 0.0
    again = encoder(normalise=True)
    again.load_state_dict(one.state_dict())
    other = np.array([[3.0, 0.1, 0.2]], np.float32)
    assert again(other).tobytes() == one(other).tobytes()


def test_proximity_is_of_the_distance_and_not_of_the_normalised_number() -> None:
    one = encoder(normalise=True)
    one.learn(np.random.default_rng(0).random((50, 3), np.float32))
    assert one(np.array([[0.0, 0.9, 0.0]], np.float32))[0, 3] == pytest.approx(math.exp(-2.0), 1e-5)


@pytest.mark.parametrize("name", ["CarGoal2", "PointButton1", "CarPush0"])
def test_safety_gyms_tasks_declare_their_lidars(name: str) -> None:
    task, environments = SAFETY_TASKS[name], make_vector(name, 2)
    declared = environments.cmdp.components
    assert [(part.name, part.size) for part in declared] == list(task.components)
    assert {part.lidar_range for part in declared if part.name.endswith("_lidar")} == {3.0}
    agent = make_agent("ppo-lag", environments.cmdp, {}, np.random.SeedSequence(0))
    observations, _ = environments.reset(seed=0)
    assert agent.act_greedily(observations).shape == (2, 2)


def test_components_must_add_up_to_the_observation() -> None:
    space = Box(-1.0, 1.0, (4,), np.float32)
    with pytest.raises(ValueError, match="add up to the 4 numbers of an observation, got 3"):
        CMDPSpec("mine", space, space, ("cost",), 10, (SPEED, WALLS))


def test_the_wrapper_gives_other_libraries_agents_the_same_numbers() -> None:
    plain = gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0")
    wrapped = ProximityObservation(gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0"))
    seen, shown = plain.reset(seed=3)[0], wrapped.reset(seed=3)[0]
    components = make_vector("CarGoal2", 1).cmdp.components
    expected = Encoder(72, components, scales=(0.15, 0.4), normalise=np.zeros(72, np.bool_))(seen[None])[0]
    assert shown.tobytes() == expected.tobytes()
    assert wrapped.observation_space.contains(shown)
    assert wrapped.observation_space.shape == (168,)


def test_the_wrapper_refuses_observations_in_which_nothing_is_a_lidar() -> None:
    with pytest.raises(ValueError, match="with a declared lidar"):
        ProximityObservation(gymnasium.make("CartPole-v1"))


def test_a_wrapped_environment_is_a_task_to_which_nothing_more_is_added() -> None:
    def wrapped() -> gymnasium.Env[Any, Any]:
        return ProximityObservation(gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0"))

    environments = SyncCMDPVectorEnv("wrapped", [wrapped])
    parts = environments.cmdp.components
    assert sum(part.size for part in parts) == 168
    assert (parts[-1].name, parts[-1].size) == ("proximity", 96)
    assert not any(part.lidar_range for part in parts)


def test_the_wrapper_refuses_other_components_and_scales_of_0() -> None:
    plain = gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0")
    with pytest.raises(ValueError, match=r"^components: must have the 72 numbers of an observation, got 3$"):
        ProximityObservation(plain, (SPEED, WALLS))
    with pytest.raises(ValueError, match=r"^scales: must be finite and above 0, got \[0\.15, 0\.0\]$"):
        ProximityObservation(plain, scales=(0.15, 0.0))


@pytest.mark.parametrize(
    ("task", "option", "expected"),
    [
        ("SafetyHopperVelocity", "unbounded", 11),
        ("SafetyHopperVelocity", "none", 0),
        ("CarGoal1", "unbounded", 0),  # its numbers are declared
        ("CarGoal1", "all", 72),
        ("rivergrid-1a", "unbounded", 0),  # its numbers are bounded
    ],
)
def test_numbers_of_unknown_scale_are_standardised(task: str, option: str, expected: int) -> None:
    environments = make_vector(task, 1)
    agent = make_agent(
        "ppo-lag", environments.cmdp, {"normalise_observations": option}, np.random.SeedSequence(0)
    )
    state = agent.state_dict()["encoder"]
    assert len(state.get("mean", ())) == expected


def test_only_the_chosen_numbers_are_standardised() -> None:
    one = Encoder(2, (), scales=(), normalise=np.array([False, True]))
    one.learn(np.array([[1.0, 0.0], [3.0, 4.0]], np.float32))
    assert one(np.array([[7.0, 4.0]], np.float32))[0] == pytest.approx([7.0, 1.0], 1e-5)
