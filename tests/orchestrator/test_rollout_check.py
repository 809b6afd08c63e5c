"""A task that returns what is no number is named, and what it returned; a right rollout passes."""

import numpy as np
import pytest

from recrl.agents.agent import Rollout
from recrl.orchestrator.trial.rollout_check import TaskOutputError, check_rollout


def rollout() -> Rollout:
    """T = 3 steps of B = 2 environments with k = 1 cost; one episode was cut off."""
    shape = (3, 2)
    return Rollout(
        observations=np.zeros((*shape, 4), np.float32),
        actions=np.zeros(shape, np.int64),
        rewards=np.zeros(shape),
        costs=np.zeros((*shape, 1)),
        terminated=np.zeros(shape, np.bool_),
        truncated=np.zeros(shape, np.bool_),
        final_observations=np.zeros((1, 4), np.float32),
        last_observations=np.zeros((2, 4), np.float32),
        carried_costs=np.zeros((2, 1)),
        carried_lengths=np.zeros(2, np.int64),
    )


def test_a_right_rollout_passes() -> None:
    right = rollout()
    check_rollout(right, "mine")
    right.rewards[:] = 1e308  # whose sum is infinite
    check_rollout(right, "mine")


@pytest.mark.parametrize(
    ("field", "index", "value", "sentence"),
    [
        (
            "rewards",
            (2, 0),
            np.nan,
            "the task mine returned a reward of nan at step 2 of the rollout in environment 0 (1 of 6 "
            "numbers); all must be finite",
        ),
        (
            "observations",
            (1, 1, 3),
            -np.inf,
            "the task mine returned an observation of -inf at step 1 of the rollout in environment 1 (1 "
            "of 24 numbers); all must be finite",
        ),
        (
            "costs",
            (0, 1, 0),
            -0.5,
            "the task mine returned a cost of -0.5 at step 0 of the rollout in environment 1 (1 of 6 "
            "numbers); costs must be at least 0",
        ),
        (
            "final_observations",
            (0, 2),
            np.nan,
            "the task mine returned a last observation of nan (1 of 4 numbers); all must be finite",
        ),
        (
            "last_observations",
            (1, 2),
            np.nan,
            "the task mine returned an observation of nan (1 of 8 numbers); all must be finite",
        ),
    ],
)
def test_what_is_wrong_is_named(field: str, index: tuple[int, ...], value: float, sentence: str) -> None:
    wrong = rollout()
    getattr(wrong, field)[index] = value
    with pytest.raises(TaskOutputError) as caught:
        check_rollout(wrong, "mine")
    assert str(caught.value) == sentence
