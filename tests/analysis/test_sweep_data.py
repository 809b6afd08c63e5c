"""A sweep's files come back as tidy frames."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.labels import KEY, METHOD_ORDER
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures.styles import STYLES
from recrl.environments.cmdp import Phase
from recrl.environments.registry import optimal_return
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.teachers.registry import TEACHERS


def test_every_frame_begins_with_the_key(finished: Sweep) -> None:
    for frame in (
        finished.trials,
        finished.phases,
        finished.updates,
        finished.evaluations,
        finished.events,
    ):
        assert tuple(frame.columns[:4]) == KEY
        assert len(frame)


def test_every_curriculum_of_ours_has_a_place_in_the_order() -> None:
    assert sorted(METHOD_ORDER) == sorted(TEACHERS), "METHOD_ORDER is in analysis/data/labels.py"
    assert sorted(STYLES) == sorted(TEACHERS), "STYLES is in analysis/figures/styles.py"


def test_methods_come_in_one_order_everywhere(finished: Sweep) -> None:
    assert list(finished.updates["method"].unique()) == ["none", "linear", "dynamic"]
    assert list(finished.updates["agent"].unique()) == ["ppo-lag", "cpo"]
    assert finished.trials["seed"].tolist()[:4] == [0, 1, 2, 0]


def test_trials_know_their_budget_limits_and_optimum(finished: Sweep, finished_sweep: SweepStore) -> None:
    spec = finished_sweep.trials()[0].spec
    row = finished.trials.set_index("trial_id").loc[spec.trial_id]
    assert (row["train_steps"], row["boundary_step"], row["total_steps"]) == (15_200, 15_200, 16_000)
    assert (row["train_limit_0"], row["deploy_limit_0"], row["status"]) == (100.0, 5.0, "complete")
    assert row["optimal_return"] == optimal_return("two-state", {"horizon": 10}, spec.deploy_limits)


def test_phases_are_the_sums_over_the_episodes(finished: Sweep, finished_sweep: SweepStore) -> None:
    trial = finished_sweep.trials()[3]
    episodes = trial.episodes()
    deployed = episodes[episodes["phase"] == "deployment"]
    ids = finished.trials.set_index("trial_id")
    key = tuple(ids.loc[trial.spec.trial_id, list(KEY)])
    row = finished.phases.set_index([*KEY, "phase"]).loc[(*key, "deployment")]
    assert row["episodes"] == len(deployed)
    assert row["steps"] == deployed["length"].sum()
    assert row["episode_return"] == pytest.approx(deployed["episode_return"].mean())
    assert row["cost_0_std"] == pytest.approx(np.std(deployed["cost_0"], ddof=1))
    assert row["cost_0_total"] == pytest.approx(deployed["cost_0"].sum())
    over = [cost - 5.0 for cost in deployed["cost_0"] if cost > 5.0]
    assert row["excess_0_total"] == pytest.approx(sum(over))


def test_episodes_of_one_phase_and_some_columns(finished_sweep: SweepStore) -> None:
    rows = sweep_data.load_episodes(finished_sweep, columns=["end_step", "cost_0"], phase=Phase.DEPLOYMENT)
    assert list(rows.columns) == [*KEY, "end_step", "cost_0"]
    assert rows["end_step"].min() > 15_200
    assert len(sweep_data.load_episodes(finished_sweep)) > len(rows)
    sweep = sweep_data.load(finished_sweep)
    assert sweep_data.load_episodes(sweep).equals(sweep_data.load_episodes(finished_sweep))
    with pytest.raises(RecrlError, match="an export and MLflow hold no single episodes of training"):
        sweep_data.load_episodes(replace(sweep, folder=None))
    with pytest.raises(
        ValueError, match=r"^no column 'cost0'; did you mean 'cost_0'\? \(episodes have index, "
    ):
        sweep_data.load_episodes(finished_sweep, columns=["length", "cost0"])
    chosen = sweep_data.load_episodes(finished_sweep, columns=["seed", "length"])
    assert list(chosen.columns) == [*KEY, "length"]


def test_a_running_sweep_shows_what_is_committed(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=2,
        tasks=["river-a"],
        agents=["cpo"],
        methods=["none", "linear"],
        unfinished=["river-a cpo linear seed 0"],
        failed=["river-a cpo linear seed 1"],
    )
    sweep = sweep_data.load(store)
    status = sweep.trials.set_index(["method", "seed"])["status"]
    assert status.tolist() == ["complete", "complete", "running", "failed"]
    assert sweep.trials["error"].iloc[3] == "ValueError: the river froze"
    halves = sweep.updates.groupby(["method", "seed"], observed=True)["update"].max()
    assert halves.tolist() == [40, 40, 20, 20]


def test_an_empty_sweep_has_empty_frames_with_columns(tmp_path: Path) -> None:
    sweep = sweep_data.load(SweepStore(tmp_path, "nothing"))
    assert sweep.num_costs == 0
    assert {"task", "status", "optimal_return"} <= set(sweep.trials)
    assert {"phase", "episode_return"} <= set(sweep.updates)
    assert not len(sweep.trials)


def test_trials_never_started_are_there_as_waiting(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=2, tasks=["river-a"], agents=["cpo"], methods=["none"])
    specs = [trial.spec for trial in store.trials()]
    store.write_specs([*specs, replace(specs[0], seed=7)])
    sweep = sweep_data.load(store)
    assert sweep.trials[["seed", "status"]].to_numpy().tolist() == [
        [0, "complete"],
        [1, "complete"],
        [7, "waiting"],
    ]


def test_trials_of_an_older_grid_are_left_out(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=2, tasks=["river-a"], agents=["cpo"], methods=["none", "linear"])
    store.write_specs([store.trials()[0].spec])
    assert len(sweep_data.load(store).trials) == 1


def test_groups_with_equal_labels_are_kept_apart(made_up_sweep: Callable[..., SweepStore]) -> None:
    fields = {"seeds": 1, "tasks": ["river-a"], "agents": ["cpo"], "methods": ["linear"]}
    made_up_sweep(**fields, updates=40)
    sweep = sweep_data.load(made_up_sweep(**fields, updates=60))
    one, two = sweep.trials["task"].cat.categories
    assert all(re.fullmatch(r"river-a \[[0-9a-f]{10}\]", label) for label in (one, two))
    assert set(sweep.trials["method"]) == {"linear"}
    long = sweep.trials.set_index("task")["total_steps"] == 24_000
    train_steps = {task: "train_steps 22800, deploy_steps 1200" if long[task] else
                   "train_steps 15200, deploy_steps 800" for task in (one, two)}  # fmt: skip
    (note,) = sweep.notes
    first, second = sorted((one, two), key=note.index)
    assert note == (
        "2 tasks have the label river-a but different settings; they are kept apart as "
        f"{first} ({train_steps[first]}), {second} ({train_steps[second]})"
    )
