"""The tests of the benchmark scripts that no library has as they are needed."""

import re

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.benchmarks.differences import average
from tests.benchmarks.safety_gym_table import sign_flips

GROUPS = ([6.1, 7.4, 3.2], [9.0, 9.2, 9.9, 10.4])


def rows_of(values: list[float], task: str) -> pd.DataFrame:
    return pd.DataFrame({"task": task, "return": values})


def test_the_average_over_one_task_is_welchs_difference() -> None:
    test = stats.ttest_ind(*GROUPS, equal_var=False)
    interval = test.confidence_interval(0.95)
    said = average(rows_of(GROUPS[0], "one"), rows_of(GROUPS[1], "one"), "return")
    found = [float(number) for number in re.findall(r"-?[0-9.]+(?= |\)|;)", said)]
    expected = [np.mean(GROUPS[0]) - np.mean(GROUPS[1]), interval.low, interval.high, test.df]
    assert found == pytest.approx(expected, abs=0.05)


def test_a_task_without_spread_adds_no_uncertainty_to_the_average() -> None:
    one, two = (pd.concat([rows_of(it, "one"), rows_of([4.0, 4.0], "two")]) for it in GROUPS)
    alone = average(rows_of(GROUPS[0], "one"), rows_of(GROUPS[1], "one"), "return")
    both = average(one, two, "return")
    ends = [[float(it) for it in re.findall(r"-?[0-9.]+(?= |\)|;)", text)][:3] for text in (alone, both)]
    assert 2.0 * np.array(ends[1]) == pytest.approx(np.array(ends[0]), abs=0.02)


@pytest.mark.parametrize("differences", [[3, -1, 2, 0, 5], [1, 2, 3], [0, 0], [2, -2, 1, 1, 1, 4, -3, 2, 5]])
def test_sign_flips_are_scipys_permutations_of_pairs(differences: list[int]) -> None:
    zeros = np.zeros(len(differences))
    expected = stats.permutation_test(
        (np.array(differences), zeros),
        lambda one, other, axis: abs((one - other).sum(axis=axis)),
        permutation_type="samples",
        n_resamples=10**6,  # more than there are: all
        alternative="greater",
    )
    assert sign_flips(np.array(differences)) == pytest.approx(expected.pvalue)
