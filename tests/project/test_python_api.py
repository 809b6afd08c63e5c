"""The Python API: quick to import, the same checks and results as the command line."""

import dataclasses
import json
import math
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

import recrl
from recrl.analysis.data import export
from recrl.orchestrator.cli import launch
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.launch_grid import LaunchOptions
from recrl.orchestrator.trial.trial import Trial

RUN = {"total_steps": 160, "deploy_fraction": 0.5, "num_envs": 4, "rollout_steps": 10}
GRID = {
    "name": "small",
    "tasks": [{"name": "two-state", "deploy_limits": 2}],
    "agents": ["ppo-lag"],
    "methods": ["none", "linear"],
    "seeds": 1,
    "run": {**RUN, "evaluation_episodes": 2},
}
QUIETLY: Any = {"executor": "inline", "mlflow": False, "figures": False, "progress": False}
# the curriculum of two updates lands hard
pytestmark = pytest.mark.filterwarnings("ignore:hard landing:UserWarning")
OWN_TASK = """\
import gymnasium
import numpy as np

class Room(gymnasium.Env):
    horizon = 5
    observation_space = gymnasium.spaces.Dict({"at": gymnasium.spaces.Box(0.0, 9.0, (2,), np.float32)})
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return {"at": np.zeros(2, np.float32)}, {}
    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        return {"at": np.ones(2, np.float32)}, 1.0, False, self.steps == 5, {"cost": 1.0}

def make(render_mode=None):
    return Room()
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def train(**changes: Any) -> recrl.Training:
    settings: dict[str, Any] = {
        "deploy_limits": 2,
        "evaluation_episodes": 2,
        "progress": False,
        **RUN,
        **changes,
    }
    return recrl.train(settings.pop("task", "two-state"), **settings)


def test_importing_it_imports_nothing_else() -> None:
    code = (
        "import sys, recrl; assert recrl.__version__; assert 'train' in dir(recrl); "
        "print({'numpy', 'torch', 'pandas', 'pydantic', 'ray', 'gymnasium'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_every_name_is_there_and_documented() -> None:
    for name in recrl.__all__:
        assert getattr(recrl, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        recrl.trian  # noqa: B018


def test_training_returns_frames_and_a_policy_and_keeps_nothing(folder: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        training = train(method="linear")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert training.updates["end_step"].tolist() == [40, 80, 120, 160]
    assert len(training.evaluations) == 4
    assert training.sweep.trials["status"].tolist() == ["complete"]
    assert training.folder is None
    assert list(folder.iterdir()) == []


def test_training_equals_the_sweeps_trial(folder: Path) -> None:
    one = train(method="linear", folder="one")
    sweep = recrl.launch(GRID, **QUIETLY)
    assert one.folder is not None
    (other,) = SweepStore(folder / "runs", "small").find("two-state ppo-lag linear")
    for name in ("evaluation.csv", "episodes.csv"):
        assert (one.folder / name).read_bytes() == (other.folder / name).read_bytes()
    assert len(sweep.trials) == 2
    again = train(method="linear", folder="one")
    assert again.updates.equals(one.updates)


def test_figures_that_cannot_be_drawn_are_a_warning(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recrl.analysis.report.drawing.draw", full)
    with pytest.warns(
        UserWarning, match=r"not all figures are drawn \(OSError: .* No space left on device\)"
    ):
        recrl.launch(GRID, executor="inline", mlflow=False, progress=False)


def test_progress_is_plain_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    train(progress=True, total_steps=1200)
    lines = capsys.readouterr().err.splitlines()
    assert "\r" not in "".join(lines)
    assert [line.split()[1] for line in lines] == ["1", *(str(3 * i) for i in range(1, 11))]
    assert lines[-1].startswith("update 30 of 30, deployment: return ")


def test_progress_is_one_line_with_return_and_cost(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    train(progress=True)
    err = capsys.readouterr().err
    assert err.endswith("\n")
    lines = err.strip().split("\r")
    assert any(line.startswith("update 4 of 4, deployment: return ") for line in lines)
    assert any(" of limit 2.00" in line for line in lines)
    assert {len(line) for line in err.rstrip("\n").split("\r")} == {0, 79}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"task": "two-stat"}, "tasks.0: no task is called 'two-stat'; did you mean 'two-state'?"),
        ({"agent": {"name": "cpo", "options": {"discont": 1}}}, "unknown key; did you mean 'discount'?"),
        ({"deploy_limits": -1}, "deploy_limits: must be numbers of at least 0 (cost per episode), got -1"),
        ({"train_limits": 1}, "train_limits: must be at least the deploy_limits of two-state"),
        ({"rolout_steps": 3}, "run.rolout_steps: unknown key; did you mean 'rollout_steps'?"),
        ({"seed": -1}, "seeds: must be whole numbers from 0"),
        ({"folder": "my run"}, "folder: must be a name for a folder: letters, digits and . _ - only"),
        ({"deploy_limits": {1, 2}}, "must hold plain values only"),
    ],
)
def test_wrong_arguments_get_the_sentences_of_a_grid(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(recrl.GridError) as error:
        train(**changes)
    assert sentence in str(error.value)


def test_numbers_of_numpy_are_plain_numbers(folder: Path) -> None:
    training = train(
        seed=np.int64(3), deploy_limits=np.array([2.0]), total_steps=np.int32(160), train_limits=np.float32(4)
    )
    assert training.policy.spec.seed == 3
    assert training.evaluations.equals(train(seed=3, deploy_limits=[2.0], train_limits=4).evaluations)
    grid = recrl.validate({**GRID, "methods": ["none"], "seeds": np.arange(3)})
    assert [trial.seed for trial in grid.trials()] == [0, 1, 2]


def test_a_trial_that_fails_raises_with_its_traceback(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    later = '"cost": float(next(COUNT) < 40 or 1 / 0)'  # not yet in the steps of the check
    (folder / "broken_room.py").write_text(
        "import itertools\nCOUNT = itertools.count()\n" + OWN_TASK.replace('"cost": 1.0', later)
    )
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(recrl.RecrlError, match="ZeroDivisionError") as error:
        train(task="broken_room:make")
    assert "Traceback" in error.value.__notes__[0]


def test_a_failed_trial_runs_again_after_its_cause_is_corrected(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``train`` always tries again, ``launch`` if asked."""

    def failing(trial: Trial) -> None:
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(Trial, "advance", failing)
        with pytest.raises(recrl.RecrlError, match="ZeroDivisionError"):
            train(folder=folder / "kept")
        recrl.launch(GRID, **QUIETLY)
    assert len(train(folder=folder / "kept").updates) == 4
    assert set(recrl.launch(GRID, **QUIETLY).trials["status"]) == {"failed"}
    assert set(recrl.launch(GRID, retry_failed=True, **QUIETLY).trials["status"]) == {"complete"}


@pytest.mark.parametrize("progress", [False, True])
def test_ctrl_c_ends_a_loop_over_trainings_and_the_same_call_continues(
    folder: Path, monkeypatch: pytest.MonkeyPatch, progress: bool
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Trial, "advance", interrupting(Trial.advance))
        with pytest.raises(KeyboardInterrupt):
            train(folder=folder / "kept", progress=progress)
        with pytest.raises(KeyboardInterrupt):
            recrl.launch(GRID, executor="inline", mlflow=False, figures=False, progress=progress)
    assert len(train(folder=folder / "kept").updates) == 4


def interrupting(advance: Callable[[Trial], None]) -> Callable[[Trial], None]:
    """Press Ctrl-C after an update."""

    def pressed(trial: Trial) -> None:
        advance(trial)
        signal.raise_signal(signal.SIGINT)

    return pressed


def test_text_that_looks_like_a_number_stays_text(folder: Path) -> None:
    grid = {**GRID, "tasks": [{"name": "two-state", "label": "InfinityNaN"}], "deploy_limits": 2}
    *_, trial = recrl.validate(grid | {"train_limits": math.inf}).trials()
    assert trial.task.label == "InfinityNaN"
    assert list(trial.train_limits) == [math.inf]


@pytest.mark.parametrize(
    "text", ["x\U0001f600", "\\ud83d\\ude00", "a\x7f\x85\u2028\n\t\0", '"\\', "caf\xe9 \U0010ffff"]
)
def test_text_of_a_dictionary_arrives_as_it_is(folder: Path, text: str) -> None:
    (folder / "texts.py").write_text(OWN_TASK.replace("render_mode=None", "**texts"))
    task = {"name": "texts:make", "options": {text: [text]}, "deploy_limits": 2}
    *_, trial = recrl.validate({**GRID, "tasks": [task]}, trust=True).trials()
    assert trial.task.options == {text: [text]}


def test_labels_have_any_character_but_half_a_pair(folder: Path) -> None:
    task = {"name": "two-state", "label": "x\U0001f600", "deploy_limits": 2}
    *_, trial = recrl.validate({**GRID, "tasks": [task]}).trials()
    assert trial.task.label == "x\U0001f600"
    with pytest.raises(recrl.GridError) as error:
        recrl.validate({**GRID, "tasks": [{**task, "label": "x\ud83d"}]})
    (problem,) = error.value.problems
    assert problem.startswith("tasks.0.label: input should be a valid string, ")
    (folder / "halves.py").write_text(OWN_TASK.replace("render_mode=None", "half"))
    task = {"name": "halves:make", "options": {"half": "\ud83d"}, "deploy_limits": 2}
    *_, trial = recrl.validate({**GRID, "tasks": [task]}, trust=True).trials()
    assert trial.task.options == {"half": "\ud83d"}


def test_sweeps_are_loaded_from_a_folder_and_an_export(finished_sweep: SweepStore, tmp_path: Path) -> None:
    sweep = recrl.load_sweep(finished_sweep.folder)
    assert len(sweep.trials) == 36
    path = export.save(sweep, tmp_path / "made-up.zip")
    assert recrl.load_sweep(path).trials.equals(sweep.trials)
    assert repr(sweep) == (
        "<Sweep made-up: 36 trials (36 complete); data frames trials, phases, updates, evaluations, events, "
        "policies>"
    )
    with pytest.raises(recrl.RecrlError) as error:
        recrl.load_policy(recrl.load_sweep(path), sweep.trials["trial_id"].iloc[0])
    assert str(error.value) == (
        "made-up: an export and MLflow hold no policies; load the sweep from the folder it ran in"
    )


def test_a_policy_is_loaded_by_its_row_in_trials(
    folder: Path, made_up_sweep: Callable[..., SweepStore]
) -> None:
    training = train(folder="one")
    policy = recrl.load_policy(training.sweep, training.sweep.trials["trial_id"].iloc[0])
    assert repr(policy) == "<Policy of two-state ppo-lag none seed 0 after 4 of 4 updates>"
    assert repr(training) == f"<Training of two-state ppo-lag none seed 0, 4 updates in {training.folder}>"
    trial_id = training.sweep.trials["trial_id"].iloc[0]
    assert repr(recrl.load_policy(folder / "one", trial_id)) == repr(policy)
    with pytest.raises(recrl.RecrlError, match="one: no trial '3f2a' has begun; load_sweep"):
        recrl.load_policy(folder / "one", "3f2a")
    with pytest.raises(recrl.RecrlError, match=r"one\.zip: an export and MLflow hold no policies"):
        recrl.load_policy("one.zip", trial_id)
    with pytest.raises(recrl.RecrlError, match="one: has no trial '3f2a'; "):
        recrl.load_policy(training.sweep, "3f2a")
    sentence = "^source: must be a sweep, .* got {}; a training has its policy already, training.policy$"
    with pytest.raises(recrl.RecrlError, match=sentence.format("Training")):
        recrl.load_policy(training)  # type: ignore[arg-type]
    with pytest.raises(recrl.RecrlError, match=sentence.format("NoneType")):
        recrl.load_policy(None)  # type: ignore[arg-type]
    assert train().sweep.folder is None
    store = made_up_sweep(
        seeds=2, methods=["none"], tasks=["a"], agents=["cpo"], missing=["a cpo none seed 1"]
    )
    other = store.trials()[0].spec
    store.write_specs([other, dataclasses.replace(other, seed=1)], b"")
    sweep = recrl.load_sweep(store.folder)
    with pytest.raises(recrl.RecrlError, match="a cpo none seed 1: has not begun, so there is no policy yet"):
        recrl.load_policy(sweep, sweep.trials["trial_id"].iloc[1])


def test_a_policy_acts_on_one_and_on_many_alike(folder: Path) -> None:
    training = train(task="continuous-bandit", folder="bandit")
    assert training.folder is not None
    policy = recrl.load_policy(training.folder, seed=3)
    envs = recrl.make("continuous-bandit", 5)
    observations, _ = envs.reset(seed=0)
    many = policy.act(observations, deterministic=True)
    assert (many.shape, many.dtype) == (envs.action_space.shape, envs.action_space.dtype)
    # float32: a product of one row and of five may be summed in another order
    np.testing.assert_allclose(policy.act(observations[0], deterministic=True), many[0], rtol=1e-5)
    np.testing.assert_array_equal(training.policy.act(observations, deterministic=True), many)
    first = policy.act(observations)
    policy.seed(3)
    np.testing.assert_array_equal(policy.act(observations), first)
    assert (policy.act(observations) != first).any()
    with pytest.raises(ValueError, match=r"must have shape \(1,\), or \(B, 1\) for a batch, got \(5, 2\)"):
        policy.act(np.zeros((5, 2)))


def test_a_loaded_policy_repeats_the_trials_evaluation(folder: Path) -> None:
    """Rolled out by hand on fresh environments, it earns about what evaluation.csv says."""
    training = train(total_steps=4000, num_envs=8, evaluation_episodes=200, agent="cpo")
    told = training.evaluations.query("policy == 'deterministic'")["episode_return"].mean()
    envs = recrl.make("two-state", 64)
    observations, _ = envs.reset(seed=1)
    total = np.zeros(64)
    assert envs.cmdp.horizon is not None
    for _ in range(envs.cmdp.horizon):
        observations, rewards, *_ = envs.step(training.policy.act(observations, deterministic=True))
        total += rewards
    assert total.mean() == pytest.approx(told, rel=0.05)


def test_a_policy_is_evaluated_as_by_its_trial_and_the_command(folder: Path) -> None:
    training = train(task={"name": "rivergrid-1a", "options": {"horizon": 20}}, folder="one")
    told = training.evaluations.query("policy == 'stochastic'")
    rows = training.policy.evaluate(len(told), seed=None)
    shared = ["index", "length", "episode_return", "cost_0"]
    assert list(rows.columns) == shared
    np.testing.assert_array_equal(rows[shared].to_numpy(), told[shared].to_numpy())
    assert main(["evaluate", "one", "--root", ".", "--episodes", "5", "--seed", "7"]) == 0
    (written,) = folder.glob("one/trials/*/evaluations/*seed-7.csv")
    both = pd.read_csv(written)
    for deterministic, kind in ((False, "stochastic"), (True, "deterministic")):
        rows = training.policy.evaluate(5, seed=7, deterministic=deterministic)
        np.testing.assert_array_equal(
            rows[shared].to_numpy(), both[both["policy"] == kind][shared].to_numpy()
        )
    assert rows["length"].max() <= 20
    with pytest.raises(ValueError, match="episodes: must be at least 1, got 0"):
        training.policy.evaluate(0)
    with pytest.raises(ValueError, match="seed: must be at least 0 or None, got -1"):
        training.policy.evaluate(seed=-1)
    environment = training.policy.make_env()
    environment.reset(seed=0)
    ends = [environment.step(0)[3] for _ in range(20)]
    assert ends == [False] * 19 + [True]


def test_folders_that_hold_no_trial_are_refused(tmp_path: Path) -> None:
    with pytest.raises(recrl.RecrlError, match="is not the folder of a trial"):
        recrl.load_policy(tmp_path)


def test_files_run_no_code_unless_they_are_trusted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "own_room.py").write_text(OWN_TASK)
    monkeypatch.setattr(sys, "path", list(sys.path))
    training = train(task="own_room:make", folder="room")
    monkeypatch.delitem(sys.modules, "own_room")
    assert training.folder is not None
    with pytest.raises(recrl.RecrlError, match="if you trust it, pass trust=True"):
        recrl.load_policy(training.folder)
    with pytest.raises(recrl.RecrlError, match="if you trust it, pass trust=True"):
        recrl.validate({**GRID, "tasks": [{"name": "own_room:make", "deploy_limits": 2}]})
    assert "own_room" not in sys.modules
    recrl.load_sweep("room", root=".")
    assert "own_room" not in sys.modules
    sys.path.append(str(folder))
    assert recrl.load_policy(training.folder, trust=True).act([0.0, 0.0]).shape == (2,)
    env = recrl.make_env("own_room:make")
    observation, _ = env.reset(seed=0)
    _, _, _, _, info = env.step(training.policy.act(observation))
    assert info["cost"].tolist() == [1.0]


def test_modules_in_the_working_directory_are_found_by_every_call(folder: Path) -> None:
    """As by the installed command; of a script, Python itself searches only the script's own folder."""
    for name in ("room_i", "room_ii", "room_iii", "room_iv"):
        (folder / f"{name}.py").write_text(OWN_TASK)
    assert str(folder) not in sys.path
    assert recrl.make("room_i:make").num_envs == 1
    assert recrl.make_env("room_ii:make").reset(seed=0)[0].shape == (2,)
    recrl.validate({**GRID, "tasks": [{"name": "room_iii:make", "deploy_limits": 2}]}, trust=True)
    training = train(task="room_iv:make", folder="room")
    del sys.modules["room_iv"]
    assert training.folder is not None
    assert recrl.load_policy(training.folder, trust=True).act([0.0, 0.0]).shape == (2,)
    del sys.modules["room_iv"]
    recrl.load_sweep("room", root=".", trust=True)
    assert str(folder) not in sys.path


def test_a_deleted_working_directory_does_not_matter(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "gone").mkdir()
    monkeypatch.chdir(folder / "gone")
    (folder / "gone").rmdir()
    assert recrl.make("two-state").num_envs == 1


def test_tasks_say_what_is_wrong() -> None:
    with pytest.raises(recrl.RecrlError, match="no task is called 'rivergrid-1'; did you mean 'rivergrid-1"):
        recrl.make("rivergrid-1")
    with pytest.raises(recrl.RecrlError, match="rivergrid-1a: horizon: must be at least 1, got 0"):
        recrl.make("rivergrid-1a", horizon=0)
    with pytest.raises(recrl.RecrlError, match=r"no single environment; use recrl.make\('two-state'\)"):
        recrl.make_env("two-state")


def test_a_task_may_have_an_option_called_task(folder: Path) -> None:
    (folder / "named.py").write_text(
        OWN_TASK.replace(
            "def make(render_mode=None):", "def make(task=1, render_mode=None):\n    assert task == 2"
        )
    )
    for made in (recrl.make("named:make", task=2), recrl.make_env("named:make", task=2)):
        made.close()


def test_costs_of_a_single_environment_are_a_vector(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "column_room.py").write_text(OWN_TASK.replace('"cost": 1.0', '"cost": np.ones((1, 1))'))
    monkeypatch.syspath_prepend(str(folder))
    env = recrl.make_env("column_room:make")
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[4]["cost"].tolist() == [1.0]


@pytest.mark.parametrize("task", ["rivergrid-1a", "PointGoal0", "pickled_room:make"])
def test_a_single_environment_can_be_pickled(
    task: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "pickled_room.py").write_text(OWN_TASK)
    monkeypatch.syspath_prepend(str(folder))
    env = recrl.make_env(task)
    env.reset(seed=0)
    again, action = pickle.loads(pickle.dumps(env)), env.action_space.sample()  # noqa: S301
    assert np.array_equal(again.step(action)[0], env.step(action)[0])


@pytest.mark.parametrize("make", [recrl.make, recrl.make_env])
def test_a_module_that_cannot_be_used_is_named(
    make: Callable[[str], Any], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "half_written.py").write_text("Walk = undefined\n")
    monkeypatch.syspath_prepend(str(folder))
    with pytest.raises(recrl.RecrlError, match=r"^the task half_written:Walk cannot be used: NameError: "):
        make("half_written:Walk")
    with pytest.raises(recrl.RecrlError, match=r"^the task math:pi cannot be used: .* got float$"):
        make("math:pi")
    with pytest.raises(recrl.RecrlError, match=r"^the task os:getpid cannot be made: .* got int "):
        make("os:getpid")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"executor": "local"}, "executor: must be 'ray' or 'inline', got 'local'"),
        (
            {"executor": "inline", "address": "auto"},
            "the inline executor uses no cluster; leave out the address auto",
        ),
        ({"max_concurrent": 0}, "max_concurrent: must be at least 1, got 0"),
    ],
)
def test_a_launch_refuses_what_it_would_ignore(folder: Path, options: Any, sentence: str) -> None:
    with pytest.raises(recrl.RecrlError) as error:
        recrl.launch(GRID, **options)
    assert str(error.value) == sentence
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        ("a.txt", "a.txt: File exists; saved results are kept"),
        ("a.txt/below", "a.txt/below: Not a directory; saved results are kept"),
        ("/proc/x/y", "/proc/x: No such file or directory; saved results are kept"),
        ("x" * 300 + "/y", ": File name too long; saved results are kept"),
    ],
)
def test_a_place_that_cannot_be_used_is_a_sentence(folder: Path, place: str, sentence: str) -> None:
    (folder / "a.txt").touch()
    with pytest.raises(recrl.RecrlError) as error:
        train(folder=place)
    assert str(error.value).endswith(sentence)
    with pytest.raises(recrl.RecrlError, match=r"; saved results are kept$"):
        recrl.launch(GRID, root=place, **QUIETLY)


def test_only_an_address_takes_the_name_of_a_sweep(finished_sweep: SweepStore) -> None:
    with pytest.raises(recrl.RecrlError, match=r"^name: only an MLflow address takes one; .* got 'other'$"):
        recrl.load_sweep(finished_sweep.folder, "other")


def test_a_launch_without_options_is_that_of_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On Ray, with MLflow and figures."""
    asked: list[LaunchOptions] = []

    def launched(grid: GridSpec, options: LaunchOptions, *_: object, **__: object) -> ExitCode:
        asked.append(options)
        return ExitCode.STOPPED

    monkeypatch.setattr(launch, "launch_and_print", launched)
    with pytest.raises(KeyboardInterrupt):
        recrl.launch(GRID)
    (folder / "grid.yaml").write_text(json.dumps(GRID))
    assert main(["launch", "grid.yaml"]) == ExitCode.STOPPED
    assert asked[0] == asked[1]
    assert (asked[0].executor, asked[0].mlflow, asked[0].figures) == ("ray", True, True)


def test_validate_takes_a_file_or_a_dictionary(folder: Path) -> None:
    (folder / "grid.json.yaml").write_text(json.dumps(GRID))
    assert recrl.validate("grid.json.yaml").trials() == recrl.validate(GRID).trials()
    with pytest.raises(recrl.GridError) as error:
        recrl.validate({**GRID, "agents": ["cpx"], "seeds": 0})
    assert len(error.value.problems) == 2


def test_what_the_command_prints_as_warnings_are_warnings_of_the_calling_line(folder: Path) -> None:
    with pytest.warns(UserWarning, match="the deployment phase is shorter than an update") as found:
        recrl.validate({**GRID, "run": {**RUN, "deploy_fraction": 0.1}})
    assert {it.filename for it in found} == {__file__}
    (folder / "endless.py").write_text(OWN_TASK.replace("    horizon = 5\n", ""))
    with pytest.warns(UserWarning, match="unknown horizon") as found:
        train(task="endless:make", deploy_limits=3)
    assert {it.filename for it in found} == {__file__}
    with pytest.warns(UserWarning, match="hard landing"):
        train(method="linear", folder="one")
    with pytest.warns(
        UserWarning, match="no longer in the grid: 1 trial, kept on disk and left out"
    ) as found:
        train(folder="one", seed=1)
    assert {it.filename for it in found} == {__file__}
    with pytest.warns(UserWarning, match="the measured d_t is not above d_d"):
        train(method="linear", deploy_limits=1000)


def test_a_launch_prints_what_the_command_prints(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recrl.launch(GRID, executor="inline", mlflow=False, figures=False)
    out = capsys.readouterr().out
    assert "small: 2 trials: 2 new" in out
    assert "task       agent    curriculum  n  return" in out
    assert "\nwarning: hard landing, " in out
    assert main(["status", "--brief", "runs/small"]) == ExitCode.OK
    assert len(recrl.load_sweep("small").trials) == len(recrl.load_sweep("runs/small").trials) == 2
    with pytest.raises(recrl.RecrlError, match="holds no sweep 'smal'; did you mean 'small'"):
        recrl.load_sweep("smal")
    with pytest.raises(recrl.RecrlError, match="executor: must be 'ray' or 'inline', got 'slurm'"):
        recrl.launch(GRID, executor="slurm")
