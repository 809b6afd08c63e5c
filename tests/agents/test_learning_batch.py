"""Collapsing repeated observations changes no mean over samples."""

import numpy as np
import pytest
import torch

from recrl.agents.building_blocks.learning_batch import LearningBatch, find_repeated
from recrl.agents.building_blocks.surrogates import SignedAdvantages, clipped_surrogate, surrogate

ROWS = np.eye(4, dtype=np.float32)
STATES = np.array([0, 1, 0, 2, 0, 1, 0, 2, 2, 1])
ACTIONS = np.array([0, 1, 1, 0, 0, 1, 0, 0, 1, 0])


def test_distinct_rows_are_found_and_lead_back_to_the_samples() -> None:
    found = find_repeated(ROWS[STATES])
    assert found is not None
    first, row = found
    assert len(first) == 3
    np.testing.assert_array_equal(ROWS[STATES][first][row], ROWS[STATES])


def test_rows_that_seldom_repeat_are_left_alone() -> None:
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    observations[:10] = observations[10:20]
    assert find_repeated(observations) is None


@pytest.mark.parametrize("actions", [ACTIONS, np.linspace(-1.0, 1.0, 10, dtype=np.float32)[:, None]])
@pytest.mark.parametrize("compact", [True, False])
def test_weights_and_sums_are_means_over_samples(actions: np.ndarray, compact: bool) -> None:
    batch = LearningBatch.deduplicate(ROWS[STATES], actions, compact=compact)
    assert float(batch.observation_weights.sum()) == pytest.approx(1.0)
    values = np.random.default_rng(0).normal(size=(10, 2))
    np.testing.assert_allclose(batch.per_observation(values).sum(axis=0), values.mean(axis=0))
    np.testing.assert_allclose(batch.per_pair(values).numpy().sum(axis=0), values.mean(axis=0), atol=1e-6)
    rows = (
        batch.unique_observations
        if batch.pair_observations is None
        else batch.unique_observations[batch.pair_observations]
    )
    if compact and actions is ACTIONS:
        assert (len(batch.unique_observations), len(rows), len(batch.actions)) == (3, 6, 6)
    else:
        assert len(rows) == len(batch.actions) == 10
    np.testing.assert_array_equal(
        batch.per_sample(batch.unique_observations.numpy().astype(np.float64)), ROWS[STATES]
    )


def test_surrogates_are_the_same_with_and_without_collapsing() -> None:
    generator = np.random.default_rng(0)
    advantages, log_ratios = generator.normal(size=10), generator.normal(0.0, 0.3, size=(4, 2))
    ratios = np.exp(log_ratios)[STATES, ACTIONS]
    expected = np.minimum(ratios * advantages, np.clip(ratios, 0.8, 1.2) * advantages).mean()
    for compact in (True, False):
        batch = LearningBatch.deduplicate(ROWS[STATES], ACTIONS, compact=compact)
        rows = (
            batch.unique_observations
            if batch.pair_observations is None
            else batch.unique_observations[batch.pair_observations]
        )
        chosen = torch.from_numpy(np.exp(log_ratios)).float()[rows.argmax(dim=1), batch.actions]
        signed = SignedAdvantages.split(batch, advantages)
        assert clipped_surrogate(chosen, signed, 0.2).item() == pytest.approx(expected, abs=1e-6)
        plain = surrogate(chosen, batch.per_pair(advantages)).item()
        assert plain == pytest.approx((ratios * advantages).mean(), abs=1e-6)


def test_the_clipped_surrogate_is_pessimistic_by_hand() -> None:
    signed = SignedAdvantages(torch.tensor([1.0, 0.0]), torch.tensor([0.0, -1.0]))
    # a gain from a ratio of 1.5 counts as 1.2; a loss from 0.5 counts as 0.8
    assert clipped_surrogate(torch.tensor([1.5, 0.5]), signed, 0.2).item() == pytest.approx(1.2 - 0.8)
    # what makes things worse counts in full
    assert clipped_surrogate(torch.tensor([0.5, 1.5]), signed, 0.2).item() == pytest.approx(0.5 - 1.5)


def distinct_batch(num_samples: int = 10) -> LearningBatch:
    """Each sample its own row: the number of the sample."""
    observations = np.arange(num_samples, dtype=np.float32)[:, None]
    return LearningBatch.deduplicate(observations, np.arange(num_samples), compact=True)


def test_a_pass_has_every_sample_once_in_a_new_order() -> None:
    generator = np.random.default_rng(0)
    batch = distinct_batch()
    assert batch.num_minibatches(4) == 3
    passes = []
    parts = batch.minibatches(4, generator)
    for _ in range(2):
        found = [next(parts) for _ in range(3)]
        assert [len(part.unique_observations) for part in found] == [4, 3, 3]
        passes.append([row for part in found for row in part.unique_observations[:, 0].tolist()])
        assert sorted(passes[-1]) == list(range(10))
    assert passes[0] != passes[1]


def test_a_minibatch_picks_its_own_of_the_samples_values() -> None:
    part = distinct_batch().minibatch(np.array([7, 2]))
    values = 10.0 * np.arange(10.0)
    assert part.unique_observations.tolist() == [[7.0], [2.0]]
    assert part.actions.tolist() == [7, 2]
    assert part.per_observation(values).tolist() == part.per_pair(values).tolist() == [35.0, 10.0]
    assert float(part.observation_weights.sum()) == 1.0


@pytest.mark.parametrize("size", [None, 10, 100])
def test_a_batch_no_larger_than_a_minibatch_is_not_parted(size: int | None) -> None:
    batch, generator = distinct_batch(), np.random.default_rng(0)
    before = generator.bit_generator.state
    assert next(batch.minibatches(size, generator)) is batch
    assert generator.bit_generator.state == before


def test_repeated_rows_are_not_parted() -> None:
    batch = LearningBatch.deduplicate(ROWS[STATES], ACTIONS, compact=True)
    assert next(batch.minibatches(1, np.random.default_rng(0))) is batch


def test_more_distinct_rows_than_asked_for_leave_the_samples_alone() -> None:
    batch = LearningBatch.deduplicate(ROWS[STATES], ACTIONS, compact=True, most_observations=2)
    assert len(batch.unique_observations) == 10
    assert (
        len(
            LearningBatch.deduplicate(
                ROWS[STATES], ACTIONS, compact=True, most_observations=3
            ).unique_observations
        )
        == 3
    )


def test_thinning_keeps_the_samples_shares() -> None:
    generator = np.random.default_rng(0)
    rows, weights = distinct_batch(100).thinned(20, generator)
    assert len(set(rows[:, 0].tolist())) == 20
    assert weights.tolist() == pytest.approx([0.05] * 20)
    repeated = LearningBatch.deduplicate(
        np.repeat(np.eye(30, dtype=np.float32), 4, 0), np.zeros(120, np.int64), compact=True
    )
    rows, weights = repeated.thinned(20, generator)
    assert len(rows) <= 20
    assert float(weights.sum()) == pytest.approx(1.0)
    assert repeated.thinned(30, generator)[0] is repeated.unique_observations
