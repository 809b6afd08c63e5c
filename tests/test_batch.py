"""Collapsing repeated observations changes no mean over samples."""

import numpy as np
import pytest
import torch

from recrl.agents.batch import LearningBatch, distinct_rows
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate, surrogate

ROWS = np.eye(4, dtype=np.float32)
STATES = np.array([0, 1, 0, 2, 0, 1, 0, 2, 2, 1])
ACTIONS = np.array([0, 1, 1, 0, 0, 1, 0, 0, 1, 0])


def test_distinct_rows_are_found_and_lead_back_to_the_samples() -> None:
    found = distinct_rows(ROWS[STATES])
    assert found is not None
    first, row = found
    assert len(first) == 3
    np.testing.assert_array_equal(ROWS[STATES][first][row], ROWS[STATES])


def test_rows_that_seldom_repeat_are_left_alone() -> None:
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    observations[:10] = observations[10:20]
    assert distinct_rows(observations) is None


@pytest.mark.parametrize("actions", [ACTIONS, np.linspace(-1.0, 1.0, 10, dtype=np.float32)[:, None]])
@pytest.mark.parametrize("compact", [True, False])
def test_weights_and_sums_are_means_over_samples(actions: np.ndarray, compact: bool) -> None:
    batch = LearningBatch.gather(ROWS[STATES], actions, compact=compact)
    assert float(batch.row_weights.sum()) == pytest.approx(1.0)
    values = np.random.default_rng(0).normal(size=(10, 2))
    np.testing.assert_allclose(batch.per_row(values).sum(axis=0), values.mean(axis=0))
    np.testing.assert_allclose(batch.per_decision(values).numpy().sum(axis=0), values.mean(axis=0), atol=1e-6)
    rows = batch.rows if batch.decision_rows is None else batch.rows[batch.decision_rows]
    if compact and actions is ACTIONS:
        assert (len(batch.rows), len(rows), len(batch.actions)) == (3, 6, 6)
    else:
        assert len(rows) == len(batch.actions) == 10
    np.testing.assert_array_equal(batch.per_sample(batch.rows.numpy().astype(np.float64)), ROWS[STATES])


def test_surrogates_are_the_same_with_and_without_collapsing() -> None:
    generator = np.random.default_rng(0)
    advantages, log_ratios = generator.normal(size=10), generator.normal(0.0, 0.3, size=(4, 2))
    ratios = np.exp(log_ratios)[STATES, ACTIONS]
    expected = np.minimum(ratios * advantages, np.clip(ratios, 0.8, 1.2) * advantages).mean()
    for compact in (True, False):
        batch = LearningBatch.gather(ROWS[STATES], ACTIONS, compact=compact)
        rows = batch.rows if batch.decision_rows is None else batch.rows[batch.decision_rows]
        chosen = torch.from_numpy(np.exp(log_ratios)).float()[rows.argmax(dim=1), batch.actions]
        signed = SignedAdvantages.split(batch, advantages)
        assert clipped_surrogate(chosen, signed, 0.2).item() == pytest.approx(expected, abs=1e-6)
        plain = surrogate(chosen, batch.per_decision(advantages)).item()
        assert plain == pytest.approx((ratios * advantages).mean(), abs=1e-6)


def test_the_clipped_surrogate_is_pessimistic_by_hand() -> None:
    signed = SignedAdvantages(torch.tensor([1.0, 0.0]), torch.tensor([0.0, -1.0]))
    # a gain from a ratio of 1.5 counts as 1.2; a loss from 0.5 counts as 0.8
    assert clipped_surrogate(torch.tensor([1.5, 0.5]), signed, 0.2).item() == pytest.approx(1.2 - 0.8)
    # what makes things worse counts in full
    assert clipped_surrogate(torch.tensor([0.5, 1.5]), signed, 0.2).item() == pytest.approx(0.5 - 1.5)
