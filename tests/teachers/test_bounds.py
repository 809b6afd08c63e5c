"""Lemma 1, the sums of limits and their inverse: by hand, and on random CMDPs."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from recrl.environments.cmdp import CostLimits, Floats
from recrl.teachers.bounds import (
    DECAYS,
    discounted_excess,
    largest_train_limit,
    undiscounted_excess,
    weight_sum,
)
from recrl.teachers.registry import TEACHERS, make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec

# integral_0^1 w(p) dp, as docs/explanation/bounds.md has them
MEAN_WEIGHTS = {
    "none": 0.0,
    "step": 1.0,
    "dynamic": 1.0,
    "linear": 1 / 2,
    "cosine": 2 / math.pi,
    "exponential": (math.e - 2) / (math.e - 1),
}


def test_lemma_1_by_hand() -> None:
    assert discounted_excess(0.02, 3.0, discount=0.5) == pytest.approx(0.2 * 0.5 * 3 / 0.25)
    assert 25.0 + discounted_excess(0.02, 3.0, discount=0.5) == pytest.approx(26.2)


def test_lemma_1_says_nothing_without_a_discount() -> None:
    assert discounted_excess(0.02, 5.0, discount=1.0) == math.inf


def test_an_update_that_changes_nothing_exceeds_nothing() -> None:
    assert discounted_excess(0.0, 3.0, discount=0.99) == 0.0
    assert discounted_excess(0.0, math.inf, discount=0.99) == 0.0
    assert math.isnan(discounted_excess(0.0, math.nan, discount=0.99))
    assert undiscounted_excess(0.0, math.inf, horizon=200) == 0.0
    assert undiscounted_excess(0.0, 3.0, horizon=200) == 0.0
    assert undiscounted_excess(0.02, 3.0, horizon=1) == 0.0


@pytest.mark.parametrize(
    ("curriculum", "weights"),
    [
        ("none", 0.0),
        ("linear", 1.0 + 0.75 + 0.5 + 0.25),
        ("step", 4.0),
        ("dynamic", 4.0),
        ("cosine", 1.0 + 0.9238795 + 0.7071068 + 0.3826834),  # cos 0, 22.5, 45 and 67.5 degrees
        # (e^-p - 1 / e) / (1 - 1 / e)
        ("exponential", 1.0 + (0.7788008 + 0.6065307 + 0.4723666 - 3 * 0.3678794) / 0.6321206),
    ],
)
def test_the_weights_over_four_policies_by_hand(curriculum: str, weights: float) -> None:
    assert weight_sum(curriculum, 4) == pytest.approx(weights, abs=1e-6)


def test_each_curriculum_has_a_bound_or_is_said_to_have_none() -> None:
    without = {"unconstrained", "cooling"}  # `bound --budget` names them: orchestrator/cli/curricula.py
    assert set(DECAYS) == TEACHERS.keys() - without, "DECAYS is in teachers/bounds.py"


@pytest.mark.parametrize("curriculum", DECAYS)
@pytest.mark.parametrize("policies", [1, 2, 10, 333])
def test_the_papers_mean_lies_between_the_sums_of_algorithm_1_and_of_a_trial(
    curriculum: str, policies: int
) -> None:
    """Algorithm 1 has p = b / n, so its sum lacks w(0) - w(1) of a trial's."""
    trial = weight_sum(curriculum, policies)
    algorithm_1 = trial - (curriculum != "none")
    assert algorithm_1 - 1e-9 <= policies * MEAN_WEIGHTS[curriculum] <= trial + 1e-9


@pytest.mark.parametrize("curriculum", ["none", "step", "linear", "cosine", "exponential"])
def test_the_clock_of_a_trial_is_that_of_its_teacher(curriculum: str) -> None:
    teacher = make_teacher(TeacherSpec(curriculum, {}, CostLimits((100.0,)), CostLimits((20.0,)), 700))
    lesson, state = teacher.start()
    limits = [lesson.limits[0]]
    for update in range(1, 7):
        lesson, state = teacher.step(state, ProgressReport(update, 100 * update, ()))
        limits.append(lesson.limits[0])
    assert sum(limits) == pytest.approx(7 * 20.0 + weight_sum(curriculum, 7) * 80.0)


@pytest.mark.parametrize("curriculum", ["step", "linear", "cosine", "exponential", "dynamic"])
def test_the_inverse_spends_the_budget_exactly(curriculum: str) -> None:
    excesses = [0.1 * b for b in range(50)]
    train_limit = largest_train_limit(curriculum, 4000.0, 20.0, excesses=excesses)
    spent = 50 * 20.0 + weight_sum(curriculum, 50) * (train_limit - 20.0) + sum(excesses)
    assert spent == pytest.approx(4000.0)
    assert train_limit > 20.0


def test_a_budget_without_slack_allows_d_d_only() -> None:
    assert largest_train_limit("linear", 81.0, 20.0, excesses=[0.25] * 4) == 20.0


def test_d_t_does_not_matter_without_a_curriculum() -> None:
    assert largest_train_limit("none", 81.0, 20.0, excesses=[0.25] * 4) == math.inf


def test_a_budget_below_that_of_d_d_is_refused() -> None:
    with pytest.raises(ValueError) as error:
        largest_train_limit("linear", 50.0, 20.0, excesses=[0.25] * 4)
    assert str(error.value) == (
        "budget must be at least 81, the bound for d_t = d_d = 20 over 4 policies, got 50"
    )


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda: discounted_excess(0.02, 3.0, discount=1.5), "discount must lie in [0, 1], got 1.5"),
        (
            lambda: discounted_excess(-0.02, 3.0, discount=0.5),
            "kl and advantage must be at least 0, got -0.02 and 3",
        ),
        (
            lambda: undiscounted_excess(0.02, -3.0, horizon=9),
            "kl and advantage must be at least 0, got 0.02 and -3",
        ),
        (lambda: undiscounted_excess(0.02, 3.0, horizon=0), "horizon must be at least 1, got 0"),
        (
            lambda: largest_train_limit("linear", 100.0, -5.0, excesses=[0.0]),
            "deploy_limit must be finite and at least 0, got -5",
        ),
        (
            lambda: largest_train_limit("linear", 100.0, math.inf, excesses=[0.0]),
            "deploy_limit must be finite and at least 0, got inf",
        ),
        (
            lambda: largest_train_limit("linear", math.nan, 5.0, excesses=[0.0]),
            "budget must be at least 5, the bound for d_t = d_d = 5 over 1 policies, got nan",
        ),
        (
            lambda: largest_train_limit("linear", 100.0, 20.0, excesses=[]),
            "there must be at least 1 policy, got 0",
        ),
    ],
)
def test_arguments_out_of_their_range_are_one_sentence(wrong: Callable[[], float], sentence: str) -> None:
    with pytest.raises(ValueError) as error:
        wrong()
    assert str(error.value) == sentence


def test_a_curriculum_without_a_bound_is_refused() -> None:
    with pytest.raises(ValueError) as error:
        weight_sum("unconstrained", 3)
    assert str(error.value) == (
        "only none, step, dynamic, linear, cosine, exponential have a bound before they have run, "
        "got 'unconstrained'"
    )


@dataclass(frozen=True)
class FiniteCMDP:
    """Transitions [S, A, S], costs [S, A], first states [S], an old policy and a new one, both [S, A]."""

    transitions: Floats
    costs: Floats
    first: Floats
    old: Floats
    new: Floats

    @classmethod
    def random(cls, seed: int) -> "FiniteCMDP":
        """Four states, three actions; the new policy is the old one moved by a random amount."""
        generator = np.random.default_rng(seed)
        old, other = generator.dirichlet(np.ones(3), size=(2, 4))
        mix = generator.choice([0.003, 0.03, 0.3])
        return cls(
            generator.dirichlet(np.full(4, 0.3), size=(4, 3)),
            generator.random((4, 3)) * (generator.random((4, 3)) < 0.5),
            generator.dirichlet(np.ones(4)),
            old,
            (1 - mix) * old + mix * other,
        )

    @property
    def kl(self) -> Floats:
        """KL(new || old), [S]."""
        divergence: Floats = np.sum(self.new * np.log(self.new / self.old), axis=1)
        return divergence

    def moves(self, policy: Floats) -> Floats:
        """The state transitions under a policy, [S, S]."""
        moves: Floats = np.einsum("sa,sat->st", policy, self.transitions)
        return moves


@pytest.mark.parametrize("discount", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("seed", range(20))
def test_lemma_1_holds_on_random_cmdps(seed: int, discount: float) -> None:
    cmdp = FiniteCMDP.random(seed)

    def values(policy: Floats) -> Floats:
        per_state = np.sum(policy * cmdp.costs, axis=1)
        solved: Floats = np.linalg.solve(np.eye(4) - discount * cmdp.moves(policy), per_state)
        return solved

    old_values = values(cmdp.old)
    visits = np.linalg.solve(np.eye(4) - discount * cmdp.moves(cmdp.old).T, cmdp.first)  # sums to 1/(1-gamma)
    advantages = cmdp.costs + discount * cmdp.transitions @ old_values - old_values[:, None]
    drift = np.sum(cmdp.new * advantages, axis=1)
    limit = cmdp.first @ old_values + visits @ drift  # the constraint of (2), active
    excess = discounted_excess(
        float((1 - discount) * visits @ cmdp.kl), float(np.abs(drift).max()), discount=discount
    )
    assert cmdp.first @ values(cmdp.new) <= float(limit) + excess + 1e-12


@pytest.mark.parametrize("horizon", [1, 2, 5, 30])
@pytest.mark.parametrize("seed", range(20))
def test_the_undiscounted_bound_holds_on_random_cmdps(seed: int, horizon: int) -> None:
    cmdp = FiniteCMDP.random(seed)

    def values(policy: Floats) -> Floats:
        """Cost that remains from each step on, [H + 1, S]."""
        remaining = np.zeros((horizon + 1, 4))
        for t in reversed(range(horizon)):
            remaining[t] = np.sum(policy * (cmdp.costs + cmdp.transitions @ remaining[t + 1]), axis=1)
        return remaining

    old_values = values(cmdp.old)
    limit = cmdp.first @ old_values[0]
    states, largest, mean_kl = cmdp.first, 0.0, 0.0
    for t in range(horizon):
        advantages = cmdp.costs + cmdp.transitions @ old_values[t + 1] - old_values[t][:, None]
        drift = np.sum(cmdp.new * advantages, axis=1)
        limit = limit + states @ drift
        largest = max(largest, float(np.abs(drift).max()))
        mean_kl += float(states @ cmdp.kl) / horizon
        states = states @ cmdp.moves(cmdp.old)
    excess = undiscounted_excess(mean_kl, largest, horizon=horizon)
    assert cmdp.first @ values(cmdp.new)[0] <= float(limit) + excess + 1e-12
