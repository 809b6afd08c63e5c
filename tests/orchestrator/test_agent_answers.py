"""What an agent of the user's returns is checked before it is written."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest

from recrl.orchestrator.errors import RowError
from recrl.orchestrator.trial.agent_answers import checked_metrics, checked_noise


def test_metrics_may_be_any_numbers() -> None:
    metrics = {"kl": np.float32(0.5), "steps": 3, "unknown": math.nan}
    assert checked_metrics("own", metrics, {"update", "cost_0"}) == metrics


@pytest.mark.parametrize(
    "name",
    [
        "update",
        "cost_0",
        "cost_1",
        "limit_12",
        "entropy_coefficient",
        "trial",
        "task",
        "agent",
        "method",
        "seed",
    ],
)
def test_metrics_do_not_take_the_names_of_columns_of_this_or_another_trial(name: str) -> None:
    with pytest.raises(RowError, match=rf"^agent own: its metrics must have other names .* got {name}$"):
        checked_metrics("own", {name: 1.0}, {"update", "cost_0"})


def test_what_noise_changed_is_written_as_json() -> None:
    details = checked_noise("own", {"scale": np.float32(0.5), "steps": np.int64(3), "more": 1.5})
    assert json.loads(json.dumps(details)) == {"scale": 0.5, "steps": 3, "more": 1.5}


@pytest.mark.parametrize(
    ("details", "sentence"),
    [
        (None, "agent own: add_noise must return a mapping of numbers, got None"),
        ({"scale": "large"}, "agent own: number scale must be a finite number or NaN, got 'large'"),
        ({"scale": True}, "agent own: number scale must be a finite number or NaN, got True"),
        ({"scale": np.complex64(1j)}, "agent own: number scale must be a finite number or NaN, got "),
        ({"scale": 10**400}, "agent own: number scale must be a finite number or NaN, got 1000"),
        ({"scale": math.nan}, "agent own: number scale of add_noise must be finite, got nan"),
        ({"update": 3}, "agent own: add_noise must not name update; the event has these keys"),
        (
            {2: 3.0},
            "agent own: the name of a number must consist of letters, digits and _, and not begin with",
        ),
    ],
)
def test_other_details_of_noise_are_refused(details: Any, sentence: str) -> None:
    with pytest.raises(RowError, match=f"^{re.escape(sentence)}"):
        checked_noise("own", details)
