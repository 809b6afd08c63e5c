"""``--only`` takes the trials that match every key, and refuses what the grid does not have."""

import pytest

from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.grid.only_selection import number_of_pairs, parse_only, select

GRID = b"""\
name: selection
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag, cpo]
methods: [none, linear]
seeds: 2
run: {total_steps: 1000, num_envs: 1}
"""
SPECS = parse_grid(GRID, source="grid.yaml").trials()


def test_a_list_of_pairs_ends_before_a_grid_file_or_a_flag() -> None:
    assert number_of_pairs(["method=none", "seed=0", "grid.yaml"]) == 2
    assert number_of_pairs(["seed=0", "a=b.yaml"]) == 1
    assert number_of_pairs(["seed=0", "--retry-failed", "seed=1"]) == 1
    assert number_of_pairs(["linear", "demo"]) == 1


def test_a_pair_without_a_value_is_refused() -> None:
    with pytest.raises(RecrlError) as caught:
        parse_only(["seed=0", "method="])
    assert str(caught.value) == "--only: must look like method=dynamic or seed=0,1, got 'method='"


def test_a_selection_takes_what_matches_every_key() -> None:
    chosen = select(SPECS, parse_only(["method=linear", "seed=0,1", "agent=cpo"]))
    assert [spec.title for spec in chosen] == ["two-state cpo linear seed 0", "two-state cpo linear seed 1"]


def test_a_selection_of_what_is_not_there_is_refused() -> None:
    with pytest.raises(RecrlError) as caught:
        select(SPECS, {"method": ["linaer"]})
    assert str(caught.value) == (
        "--only: no trial has method 'linaer'; did you mean 'linear'? (known: none, linear)"
    )
    with pytest.raises(RecrlError) as caught:
        select(SPECS, {"colour": ["red"]})
    assert str(caught.value) == "--only: trials are chosen by task, agent, method, seed, got 'colour'"


def test_a_selection_that_no_trial_matches_is_refused() -> None:
    some = select(SPECS, {"method": ["linear"], "agent": ["cpo"]})
    others = select(SPECS, {"method": ["none"]})
    with pytest.raises(RecrlError) as caught:
        select([*some, *others], parse_only(["method=linear", "agent=ppo-lag", "seed=0,1"]))
    assert str(caught.value) == (
        "--only: no trial has method linear and agent ppo-lag and seed 0 or 1 together"
    )


def test_a_label_with_a_comma_is_selected_whole() -> None:
    labelled = GRID.replace(b"linear]", b"{name: linear, label: 'linear, slow'}]")
    specs = parse_grid(labelled, source="grid.yaml").trials()
    assert {it.method.label for it in select(specs, parse_only(["method=linear, slow"]))} == {"linear, slow"}
    both = select(specs, parse_only(["method=linear, slow", "method=none", "seed=0,1"]))
    assert len(both) == len(specs)
