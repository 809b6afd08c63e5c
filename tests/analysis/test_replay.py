"""A run's own teacher, asked again, says what it said; another one is asked the same questions."""

from dataclasses import replace as changed
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.figures.curriculum_replay import Replayed, replayed_limits
from recrl.analysis.report.text_tables import replay_summary
from recrl.analysis.statistics.curriculum_replay import progress_reports, replay
from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.cli.curricula import _teacher
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.teachers.registry import teacher_config

SPEC = TrialSpec(
    task=Choice("two-state", {"horizon": 10}),
    agent=Choice("ppo-lag", {"hidden_sizes": [8], "policy_steps": 4, "critic_steps": 4}),
    method=Choice("dynamic", {"window": 8, "start_fraction": 0.1}),
    train_limits=CostLimits.unlimited(1),
    deploy_limits=CostLimits((1.0,)),
    train_steps=37 * 60 - 1,  # deployment begins within the last update
    deploy_steps=120,
    num_envs=4,
    rollout_steps=15,  # not a multiple of the horizon: some updates see more episodes than others
    evaluation_episodes=0,
    seed=1,
)


def run(root: Path, spec: TrialSpec) -> TrialStore:
    store = SweepStore(root, "sweep")
    trial = store.trial(spec)
    run_recorded(spec, trial, should_stop=lambda: False)
    store.write_info({"name": store.name})
    return trial


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    return run(tmp_path_factory.mktemp("runs"), SPEC)


@pytest.mark.parametrize(
    "method",
    [
        SPEC.method,
        Choice("dynamic", {"window": 2, "start_fraction": 0.1}),
        Choice("linear"),
        Choice("exponential"),
        Choice("step"),
        Choice("unconstrained"),
    ],
    ids=lambda method: method.name,
)
def test_a_runs_own_teacher_gives_its_own_limits(tmp_path: Path, method: Choice) -> None:
    rows = replay(run(tmp_path, changed(SPEC, method=method)), method)
    assert rows["replayed_limit_0"].tolist() == rows["limit_0"].tolist()
    assert rows["replayed_noise"].tolist() == rows["noise"].tolist()
    assert rows["phase"].tolist() == ["training"] * 37 + ["deployment"] * 2


def test_every_episode_is_reported_once_with_the_update_it_ended_in(trial: TrialStore) -> None:
    reports = list(progress_reports(trial, trial.updates()))
    assert [episode.index for report in reports for episode in report.episodes] == list(
        range(len(trial.episodes()))
    )
    for report in reports:
        assert all(
            report.env_steps - 60 < episode.end_step <= report.env_steps for episode in report.episodes
        )
        assert all(episode.begin_step == episode.end_step - 40 for episode in report.episodes)  # 4 x 10 steps


def test_another_teacher_sets_its_limits_on_the_same_episodes(trial: TrialStore) -> None:
    rows = replay(trial, Choice("none"))
    assert (rows["replayed_limit_0"] == 1.0).all()
    (line,) = replay_summary(trial, rows).to_dict("records")
    assert (line["cost"], line["replayed"], line["replayed reaches d_d"]) == ("0", "1.00", "0%")
    assert line["other limit"] == str((rows["limit_0"].iloc[:37] != 1.0).sum())


def test_when_the_limit_arrives_is_a_share_of_the_whole_training_phase(trial: TrialStore) -> None:
    def arrival(rows: pd.DataFrame) -> str:
        (line,) = replay_summary(trial, rows).to_dict("records")
        return str(line["reaches d_d"])

    rows = replay(trial, SPEC.method)
    limits = np.full(len(rows), 2.0)
    limits[18:] = 1.0
    rows["limit_0"] = limits
    assert arrival(rows) == arrival(rows.iloc[:20]) == f"{18 * 60 / SPEC.train_steps:.0%}" == "49%"
    assert arrival(rows.iloc[:10]) == "not yet"
    rows["limit_0"] = 2.0
    assert arrival(rows) == "at its end"


RISING = """
from pydantic import BaseModel

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.registry import TeacherKind


class Options(BaseModel):
    pass


class Rising:
    def __init__(self, spec):
        pass

    def start(self):
        return CurriculumStep(CostLimits((2.0,))), {"update": 0}

    def step(self, state, report):
        return CurriculumStep(CostLimits((2.0 + report.update,))), {"update": report.update}


KIND = TeacherKind("Rises.", Options, Rising)
"""


def test_an_answer_that_a_trial_would_refuse_is_refused(
    trial: TrialStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_rising.py").write_text(RISING)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ValueError, match=r"own_rising:KIND: the limit of cost 0 rose from 2 to 3 after update 1"
    ):
        replay(trial, Choice("own_rising:KIND"))


def test_a_run_without_updates_cannot_be_replayed(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    store.begin(SPEC)
    with pytest.raises(RecrlError) as error:
        replay(store, SPEC.method)
    assert str(error.value) == (
        "two-state ppo-lag dynamic seed 1: cannot be replayed, because it has no policy update yet"
    )


def test_the_command_takes_methods_and_options(trial: TrialStore, capsys: pytest.CaptureFixture[str]) -> None:
    root = trial.folder.parent.parent.parent
    SweepStore(root, "sweep").write_specs([trial.spec])
    command = ["replay", "--root", str(root), "--teacher"]
    assert main([*command, "dynamic", "--option", "window=4"]) == ExitCode.OK
    assert "two-state ppo-lag dynamic seed 1" in capsys.readouterr().out
    written = {path.name for path in (root / "sweep" / "replays").iterdir()}
    called = Choice("dynamic", {**trial.spec.method.options, "window": 4}).file_name
    assert called.startswith("dynamic__")
    assert written == {f"{trial.folder.name}__{called}.csv", f"{called}.pdf", f"{called}.png"}
    assert main([*command, "dynamic", "--option", "window=5"]) == ExitCode.OK
    assert len(list((root / "sweep" / "replays").iterdir())) == 6, "other options, other files"
    capsys.readouterr()
    assert main([*command, "dynamic", "--option", "preset=paper"]) == ExitCode.OK
    paper = Choice("dynamic", {**trial.spec.method.options, "preset": "paper"}).file_name
    assert (root / "sweep" / "replays" / f"{paper}.png").exists()
    capsys.readouterr()
    assert main([*command, "dynamik"]) == ExitCode.WRONG_INPUT
    assert "did you mean 'dynamic'?" in capsys.readouterr().err
    assert main([*command, "dynamic", "--option", "window=0"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == ("recrl-sweep: --option: dynamic: window: must be at least 1, got 0\n")
    assert main([*command, "dynamic", "--option", "windw=3"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "recrl-sweep: --option: dynamic: windw: unknown key; did you mean 'window'?\n"
    )


def test_another_preset_replaces_the_defaults_of_the_one_before(tmp_path: Path) -> None:
    full = teacher_config("dynamic", {"window": 4}).model_dump()
    store = SweepStore(tmp_path, "sweep")
    store.write_specs([changed(SPEC, method=Choice("dynamic", full))])
    request: Any = SimpleNamespace(teacher="dynamic", option=("preset=paper",))
    options = _teacher(store, request).options
    assert teacher_config("dynamic", options) == teacher_config("dynamic", {"preset": "paper", "window": 4})


def test_the_figure_shows_what_was_and_what_would_have_been(trial: TrialStore) -> None:
    rows = replay(trial, Choice("none"))
    figure = replayed_limits([Replayed(SPEC, rows)], "none")
    (axes,) = figure.axes
    limits = [line for line in axes.get_lines() if line.get_drawstyle() == "steps-pre"]
    recorded, replayed = (np.asarray(line.get_ydata(), dtype=float) for line in limits)
    known = rows["limit_0"].iloc[:37]
    assert recorded.tolist() == pytest.approx(known.where(np.isfinite(known)).tolist(), nan_ok=True)
    assert replayed.tolist() == [1.0] * 37
