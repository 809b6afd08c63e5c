"""What code a trial ran is known for each attempt, and results of other code are not mixed without a word."""

import errno
import importlib
import json
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.sweep_warnings import curriculum_flags
from recrl.analysis.report import pages
from recrl.environments.plugins import import_module
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import ClusterError
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import HARD_LANDING
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.launch_plan import PlannedAction, TrialSelection, make_plan
from recrl.orchestrator.provenance import code_changes, project_files, versions
from recrl.orchestrator.provenance.code_changes import (
    CHANGED,
    CodeComparison,
    InstalledCode,
    code_of,
    compare,
    compare_files,
)
from recrl.orchestrator.ray.tune_callbacks import DriverWatch
from recrl.orchestrator.run_sweep import SweepResult, SweepRunSettings, run_sweep
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.sweep_progress import DisplayStatus, progress
from recrl.orchestrator.trial_warnings import (
    landed_hard,
    missing_modules_sentence,
    no_curriculum_sentence,
    other_code_sentence,
    other_versions_sentence,
)
from tests.orchestrator.launches import INLINE

TASK = """\
from recrl.environments.registry import Task
from recrl.environments.finite.two_state import TwoStateOptions, make_two_state

FACTOR = 1.0

def make(name, num_envs, options):
    environments = make_two_state("two-state", num_envs, options)
    step = environments.step
    def scaled(actions):
        observations, rewards, *rest = step(actions)
        return observations, FACTOR * rewards, *rest
    environments.step = scaled
    return environments

TASK = Task("Scaled.", TwoStateOptions, make)
"""
GRID = """\
name: small
tasks: [{name: "my_scaled_task:TASK", label: scaled, deploy_limits: 2, options: {horizon: 5}}]
agents: [{name: ppo-lag, options: {hidden_sizes: [4], policy_steps: 2, critic_steps: 2}}]
methods: [none]
seeds: [SEEDS]
train_limits: 9
run: {total_steps: 80, deploy_fraction: 0.5, num_envs: 2, rollout_steps: 10, evaluation_episodes: 2}
"""
SENTENCE = (
    "warning: 1 complete trial comes from other code than is installed now (changed: my_scaled_task); launch "
    "--rerun-changed runs it again"
)
INSTALLED = "These evaluations use the code and the libraries that are installed now."


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working directory with a task of the user's own and a grid."""
    (tmp_path / "my_scaled_task.py").write_text(TASK)
    (tmp_path / "grid.yaml").write_text(GRID.replace("SEEDS", "0"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("my_scaled_task", None)


def change(folder: Path) -> None:
    """Multiply the task's rewards by ten, as an editor would between two launches."""
    (folder / "my_scaled_task.py").write_text(TASK.replace("FACTOR = 1.0", "FACTOR = 10.00"))
    sys.modules.pop("my_scaled_task", None)
    importlib.invalidate_caches()


def test_a_changed_task_is_said_everywhere_and_run_again_when_asked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store = SweepStore(folder / "runs", "small")
    trial = store.trials()[0]
    assert not compare_files(trial, trial.spec).differs
    before = trial.episodes_path.read_bytes()
    change(folder)
    capsys.readouterr()
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK  # nothing to do, but not without a word
    assert SENTENCE in capsys.readouterr().out.splitlines()
    assert main(["plan", "grid.yaml", "--trust", "--check"]) == ExitCode.TRIALS_LEFT
    (folder / "grid.yaml").write_text(GRID.replace("SEEDS", "0, 1"))
    capsys.readouterr()
    assert main(["plan", "grid.yaml", "--trust"]) == ExitCode.OK
    assert SENTENCE in capsys.readouterr().out.splitlines()
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    capsys.readouterr()
    assert main(["status", "--brief"]) == ExitCode.OK
    assert SENTENCE in capsys.readouterr().out.splitlines()
    assert main(["evaluate", "small", "--policy", "stochastic", "--trust"]) == ExitCode.OK
    printed = capsys.readouterr().out.splitlines()
    assert {SENTENCE, INSTALLED} <= set(printed)
    assert SENTENCE.removeprefix("warning: ") in pages.remarks(sweep_data.load(store))

    assert main(["launch", "grid.yaml", *INLINE, "--rerun-changed"]) == ExitCode.OK
    assert "small: 2 trials: 1 to run again on the present code, 1 complete\n" in capsys.readouterr().out
    assert main(["status", "--brief"]) == ExitCode.OK
    assert capsys.readouterr().out == "small: 2 of 2 complete, 0 running, 0 waiting, 0 failed\n"
    assert (trial.aside_folder / "run-001" / "episodes.csv").read_bytes() == before
    assert trial.episodes_path.read_bytes() != before
    assert main(["check"]) == ExitCode.OK


def _rerun(grid: GridSpec, store: SweepStore, executor: Executor) -> SweepResult:
    selection = TrialSelection(rerun_changed=True)
    return run_sweep(
        SweepRunSettings(grid, SweepPlace(store), executor, selection=selection), stop=threading.Event()
    )


def test_a_launch_that_cannot_run_leaves_the_results_that_it_was_to_replace(folder: Path) -> None:
    class Broken:
        def run(self, specs: object, place: SweepPlace, stop: threading.Event) -> None:
            statuses = {trial.status for trial in progress(grid.trials(), store).trials}
            assert statuses == {DisplayStatus.WAITING}  # requested
            raise ClusterError("no cluster")

    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    change(folder)
    with pytest.raises(ClusterError):
        _rerun(grid, store, Broken())
    assert _is_complete(grid, store)


def _is_complete(grid: GridSpec, store: SweepStore) -> bool:
    """Whether the only trial has its results, and a plain launch would do nothing."""
    (trial,) = progress(grid.trials(), store).trials
    is_whole = trial.status is DisplayStatus.COMPLETE and not store.trial(trial.spec).damages()
    return is_whole and not make_plan(grid.trials(), store).to_do


def test_a_launch_that_is_stopped_before_a_rerun_says_that_the_old_results_stay(folder: Path) -> None:
    class Idle:
        def run(self, specs: object, place: SweepPlace, stop: threading.Event) -> None:
            stop.set()

    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    change(folder)
    result = _rerun(grid, store, Idle())
    assert [it.status for it in result.progress.trials] == [DisplayStatus.COMPLETE]
    assert _is_complete(grid, store)


def test_a_request_of_a_killed_launch_is_void_unless_its_attempt_began(folder: Path) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    trial = store.trial(grid.trials()[0])
    before = trial.episodes_path.read_bytes()
    trial.request_rerun()
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    assert not trial.rerun_path.exists()
    assert trial.episodes_path.read_bytes() == before
    assert not trial.aside_folder.exists()


def test_a_disk_without_room_for_an_attempt_leaves_the_results_that_it_was_to_replace(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    change(folder)
    write = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.name == ".reserve":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    _rerun(grid, store, InlineExecutor())
    assert _is_complete(grid, store)


@pytest.mark.parametrize("content", [b"", b"/tmp/elsewhere\n", b"../..\n", b"\xff\xfe"])
def test_a_damaged_request_leads_nowhere_else(folder: Path, content: bytes) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    trial = store.trial(grid.trials()[0])
    before = trial.episodes_path.read_bytes()
    trial.rerun_path.write_bytes(content)
    trial.begin(trial.spec)
    assert (trial.aside_folder / "run-unnamed" / "episodes.csv").read_bytes() == before
    assert not trial.rerun_path.exists()


def test_a_rerun_whose_process_dies_before_it_begins_has_failed(folder: Path) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    change(folder)

    class Dying:
        def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
            lost = SimpleNamespace(any_is_gone=lambda: False)
            watch = DriverWatch(place, None, stop=stop, stop_signal=None, watchdog=None, lost=lost)  # type: ignore[arg-type]
            config = {"spec": json.dumps(specs[0].to_json())}
            watch.on_trial_error(
                0, [], SimpleNamespace(config=config, num_failures=4, pickled_error_file=None)
            )

    result = _rerun(grid, store, Dying())
    assert [it.status for it in result.failed] == [DisplayStatus.FAILED]
    assert "its process failed" in result.failed[0].record.error
    assert len(list(store.trial(grid.trials()[0]).aside_folder.glob("run-001/episodes.csv"))) == 1


@pytest.mark.parametrize("done", range(9))
def test_a_rerun_that_is_killed_while_it_moves_old_files_goes_on(
    folder: Path, done: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    (spec,) = grid.trials()
    trial = store.trial(spec)
    for added in (trial.videos_folder, trial.evaluations_folder):
        added.mkdir()
        (added / "update-4.gif").write_text("of the old policy")
    old = {path.relative_to(trial.folder): path.read_bytes() for path in _files(trial.folder)}
    change(folder)
    trial.request_rerun()
    moves, rename = iter(range(done)), Path.rename

    def killed(path: Path, target: Path) -> Path:
        if next(moves, None) is None:
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt):
        trial.begin(spec)
    monkeypatch.setattr(Path, "rename", rename)
    (planned,) = make_plan(grid.trials(), store).trials
    assert planned.action is PlannedAction.RERUN
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    assert trial.record().status is TrialStatus.COMPLETE
    assert trial.record().attempt == 1
    assert not trial.damages()
    assert not trial.rerun_path.exists()
    kept = trial.aside_folder / "run-001"
    assert {path.relative_to(kept): path.read_bytes() for path in _files(kept)} == old
    assert not trial.videos_folder.exists()


def _files(folder: Path) -> list[Path]:
    ours = (".lock", ".reserve", "rerun.request")
    return [path for path in folder.rglob("*") if path.is_file() and path.name not in ours]


def test_a_failed_trial_of_other_code_is_run_again_too(folder: Path) -> None:
    text = TASK.replace("    step = environments.step", "    step = None  # fails")
    (folder / "my_scaled_task.py").write_text(text)
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml", build=False)
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    (spec,) = grid.trials()
    assert store.trial(spec).record().status is TrialStatus.FAILED
    change(folder)
    result = _rerun(grid, store, InlineExecutor())
    assert not result.plan.code_warnings
    assert store.trial(spec).record().status is TrialStatus.COMPLETE
    assert not store.trial(spec).error_path.exists()


def test_every_attempt_keeps_where_it_comes_from(folder: Path) -> None:
    store, grid = SweepStore(folder / "runs", "small"), read_grid(folder / "grid.yaml")
    (spec,) = grid.trials()

    class Stopping(InlineExecutor):
        def run(self, specs: object, place: SweepPlace, stop: threading.Event) -> None:
            from recrl.orchestrator.trial.attempt import run_recorded  # noqa: PLC0415

            answers = iter([False])
            run_recorded(spec, place.store.trial(spec), should_stop=lambda: next(answers, True))

    run_sweep(SweepRunSettings(grid, SweepPlace(store), Stopping()), stop=threading.Event())
    first = code_of(spec)
    change(folder)
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    attempts = store.trial(spec).provenance()
    assert [attempt["attempt"] for attempt in attempts] == [1, 2]
    assert [attempt["code"] for attempt in attempts] == [first, code_of(spec)]
    assert first["recrl"] == code_of(spec)["recrl"]
    assert first["my_scaled_task"] != code_of(spec)["my_scaled_task"]
    assert all({"recrl", "python", "packages", "source"} <= set(attempt) for attempt in attempts)
    assert compare_files(store.trial(spec), spec).differs  # its first attempt ran other code


def test_a_plan_reads_the_users_code_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("SEEDS", "0, 1, 2"))
    specs = read_grid(folder / "grid.yaml").trials()
    read: list[str] = []
    digests = code_changes._digests_of

    def count(package: str) -> dict[str, str]:
        read.append(package)
        return digests(package)

    monkeypatch.setattr(code_changes, "_digests_of", count)
    assert len(make_plan(specs, SweepStore(folder / "runs", "small")).trials) == 3
    assert read == ["my_scaled_task"]


def test_the_code_of_a_task_is_found_without_running_it(folder: Path) -> None:
    (spec,) = read_grid(folder / "grid.yaml").trials()
    (folder / "my_scaled_task.py").write_text("raise SystemExit\n")
    sys.modules.pop("my_scaled_task", None)
    assert set(code_of(spec)) == {"recrl", "my_scaled_task"}
    assert "my_scaled_task" not in sys.modules


def test_a_process_that_goes_on_with_the_code_of_before_says_so(folder: Path) -> None:
    (spec,) = read_grid(folder / "grid.yaml").trials()
    sys.modules.pop("my_scaled_task", None)
    before = code_of(spec)
    module = import_module("my_scaled_task")
    assert code_of(spec) == before
    (folder / "my_scaled_task.py").write_text(TASK + "LATER = 1\n")
    with pytest.warns(
        UserWarning, match="the code of my_scaled_task has changed since this process imported"
    ):
        changed = code_of(spec)
    assert changed == {**before, "my_scaled_task": CHANGED}
    assert compare([{"code": changed}], spec).differs, "a later launch says that the code is another one"
    importlib.reload(module)
    assert code_of(spec) == InstalledCode().of(spec) != before


def test_an_edit_between_an_import_and_the_first_trial_is_seen(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    (spec,) = read_grid(folder / "grid.yaml").trials()
    (folder / "my_helper.py").write_text("REWARD = 1\n")
    (folder / "my_scaled_task.py").write_text(f"import my_helper\n{TASK}")
    for name in ("my_scaled_task", "my_helper"):
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    module = importlib.import_module("my_scaled_task")
    (folder / "my_helper.py").write_text("# a comment\n\nREWARD = 1\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = code_of(spec)
    assert CHANGED not in before.values()
    code_changes._ran.clear()
    (folder / "my_helper.py").write_text("REWARD = 1000\n")
    for _ in range(2):
        with pytest.warns(
            UserWarning, match="the code of my_helper has changed since this process imported it"
        ):
            assert code_of(spec) == {**InstalledCode().of(spec), "my_helper": CHANGED}
        compiled = Path(sys.modules["my_helper"].__spec__.cached)  # type: ignore[union-attr, arg-type]
        compiled.unlink(missing_ok=True)  # what is known stays known
    with pytest.warns(
        UserWarning, match="has changed since this process imported it; the code of before runs"
    ):
        (folder / "my_scaled_task.py").write_text(f"import my_helper\nLATER = 1\n{TASK}")
        import_module("my_scaled_task")
    for name in ("my_helper", "my_scaled_task"):
        importlib.reload(sys.modules[name])
    assert code_of(spec) == InstalledCode().of(spec)
    assert module.my_helper.REWARD == 1000


def test_modules_that_a_plug_in_imports_are_among_its_code(folder: Path) -> None:
    (spec,) = read_grid(folder / "grid.yaml").trials()
    own = "import json\nimport numpy as np\nfrom my_physics import GRAVITY\n" + TASK
    (folder / "my_scaled_task.py").write_text(own)
    (folder / "my_physics.py").write_text("def late():\n    import my_units.lengths\n")
    (folder / "my_units").mkdir()
    (folder / "my_units" / "lengths.py").write_text("import my_scaled_task  # a circle\n")
    (folder / "my_other.py").write_text("")  # nobody imports it
    importlib.invalidate_caches()
    before = InstalledCode().of(spec)
    assert list(before) == ["recrl", "my_scaled_task", "my_physics", "my_units"]
    (folder / "my_units" / "lengths.py").write_text("METRE = 2\n")
    after = InstalledCode().of(spec)
    assert {name for name in before if before[name] != after[name]} == {"my_units"}
    assert compare([{"code": before}], spec).differs
    old = {name: before[name] for name in ("recrl", "my_scaled_task")}  # what earlier versions wrote
    assert not compare([{"code": old}], spec).differs
    assert not {"my_physics", "my_units"} & set(sys.modules)


def test_the_imports_of_a_plug_in_are_followed_within_its_project_and_bounds(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    (spec,) = read_grid(folder / "grid.yaml").trials()
    (folder / "my_scaled_task.py").write_text(f"import my_a, my_b, my_elsewhere\n{TASK}")
    for name in ("my_a", "my_b"):
        (folder / f"{name}.py").write_text("")
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "my_elsewhere.py").write_text("")
    monkeypatch.syspath_prepend(elsewhere)
    assert list(InstalledCode().of(spec)) == ["recrl", "my_scaled_task", "my_a", "my_b"]
    monkeypatch.setattr(project_files, "MOST_FILES", 2)
    assert list(InstalledCode().of(spec)) == ["recrl", "my_scaled_task", "my_a"]


@pytest.mark.usefixtures("unrendered")
def test_of_a_package_that_is_not_here_it_is_said_that_it_was_not_compared(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store = SweepStore(folder / "runs", "small")
    trial = store.trials()[0]
    (folder / "my_scaled_task.py").unlink()
    importlib.invalidate_caches()
    sys.modules.pop("my_scaled_task", None)
    assert set(code_of(trial.spec)) == {"recrl"}
    assert compare_files(trial, trial.spec) == CodeComparison(missing=frozenset({"my_scaled_task"}))
    sentence = (
        "the code of 1 trial was not checked for changes, because the module my_scaled_task was not found; "
        "start the command in the folder that holds it"
    )
    capsys.readouterr()
    for command in (["status", "--brief"], ["figures"]):
        assert main(command) == ExitCode.OK
        assert f"warning: {sentence}" in capsys.readouterr().out.splitlines()
    assert sentence in pages.remarks(sweep_data.load(store))


@pytest.mark.usefixtures("unrendered")
def test_a_changed_module_of_the_working_directory_is_found_without_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command that may not import the module is not told of its folder by Python."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "my_scaled_task.py").write_text(TASK)
    (tmp_path / "grid.yaml").write_text(GRID.replace("SEEDS", "0"))
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    change(tmp_path)
    assert str(tmp_path) not in sys.path
    capsys.readouterr()
    for command in (["status", "--brief"], ["figures"]):
        assert main(command) == ExitCode.OK
        assert SENTENCE in capsys.readouterr().out.splitlines()
    assert "my_scaled_task" not in sys.modules


def test_other_versions_of_libraries_are_said_where_a_launch_would_mix_them(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    then = {"torch": "2.12.0+cu128", "mujoco": "3.9.0", "numpy": "2.4.6", "ray": "2.50.0"}
    now = {"torch": "2.13.0+cpu", "mujoco": "4.0.0", "numpy": "2.4.6+local", "ray": "2.60.0"}
    monkeypatch.setattr(versions, "package_versions", lambda _: then)
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    monkeypatch.setattr(code_changes, "package_versions", lambda _: now)
    capsys.readouterr()
    assert main(["plan", "grid.yaml", "--trust"]) == ExitCode.OK
    assert "versions" not in capsys.readouterr().out  # nothing is to do, so nothing is mixed
    sentence = (
        "warning: 1 trial ran with other versions of libraries than are installed now (mujoco 3.9.0, now "
        "4.0.0; torch 2.12.0, now 2.13.0); the same settings may give other results"
    )
    (folder / "grid.yaml").write_text(GRID.replace("SEEDS", "0, 1"))
    assert main(["plan", "grid.yaml", "--trust", "--rerun-changed"]) == ExitCode.OK
    assert "1 complete" in capsys.readouterr().out  # it is no other code
    assert main(["plan", "grid.yaml", "--trust"]) == ExitCode.OK
    assert sentence in capsys.readouterr().out.splitlines()
    assert main(["evaluate", "small", "--trust"]) == ExitCode.OK
    assert {sentence, INSTALLED} <= set(capsys.readouterr().out.splitlines())
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    assert sentence in capsys.readouterr().out.splitlines()


def test_a_damaged_provenance_never_counts_as_unchanged_code(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One byte differs, so the file's length does not show it."""
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    trial = SweepStore(folder / "runs", "small").trials()[0]
    change(folder)
    written = trial.provenance_path.read_bytes()
    trial.provenance_path.write_bytes(written.replace(b'"code"', b'"c0de"'))
    for command in (["plan", "grid.yaml", "--trust"], ["launch", "grid.yaml", *INLINE]):
        capsys.readouterr()
        assert main(command) == ExitCode.OK
        (sentence,) = [line for line in capsys.readouterr().out.splitlines() if "not checked" in line]
        assert sentence.startswith("warning: the code of 1 trial was not checked for changes, because ")
        assert "provenance.json is not what was committed" in sentence
        assert "launch --rerun-damaged" in sentence
    assert main(["launch", "grid.yaml", *INLINE, "--rerun-damaged"]) == ExitCode.OK
    assert "not checked" not in capsys.readouterr().out
    trial.provenance_path.unlink()  # a trial that is damaged anyway is said to be so, once
    capsys.readouterr()
    assert main(["plan", "grid.yaml", "--trust"]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "1 damaged" in shown
    assert "not checked" not in shown


def test_the_sentences_count() -> None:
    assert other_versions_sentence([(), ()]) == ""
    unchanged = TrialStatus.COMPLETE, CodeComparison()
    complete = TrialStatus.COMPLETE, CodeComparison(changed=frozenset({"recrl"}))
    begun = TrialStatus.WAITING, CodeComparison(changed=frozenset({"mynav", "recrl"}))
    own = TrialStatus.COMPLETE, begun[1]
    assert other_code_sentence([unchanged]) == ""
    assert other_code_sentence([unchanged, *[complete] * 11, own]) == (
        "12 complete trials come from other code than is installed now (changed: mynav, recrl); launch "
        "--rerun-changed runs them again"
    )
    assert other_code_sentence([complete, begun, begun]).startswith(
        "1 complete trial and 2 begun ones come from other code than"
    )
    assert other_code_sentence([begun, unchanged]).startswith("1 begun trial comes from other code than")
    assert missing_modules_sentence([(), ()]) == ""
    assert missing_modules_sentence([{"b", "c"}, (), {"a", "b"}]).startswith(
        "the code of 2 trials was not checked for changes, because the module a and 2 others were not found; "
    )
    assert no_curriculum_sentence([]) == ""
    assert no_curriculum_sentence([f"t{i}" for i in range(7)]) == (
        "the measured d_t is not above d_d, so the limit is d_d after the measurement: t0, t1, t2, t3, t4 "
        "and 2 more; give a finite train_limits above d_d"
    )


def test_a_curriculum_that_is_none_is_an_event_and_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An agent that costs less than d_d from the start leaves the curriculum no room."""
    (folder / "grid.yaml").write_text(
        GRID.replace("SEEDS", "0")
        .replace('"my_scaled_task:TASK", label: scaled', "two-state")
        .replace("deploy_limits: 2", "deploy_limits: 50")
        .replace("methods: [none]", "methods: [none, linear, dynamic]")
        .replace("train_limits: 9\n", "")
    )
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    store = SweepStore(folder / "runs", "small")
    for trial in store.trials():
        events = [event["event"] for event in trial.events()]
        none = trial.spec.method.label != "none"
        assert ("the curriculum is none" in events) == none
    capsys.readouterr()
    assert main(["status", "--brief"]) == ExitCode.OK
    sentence = (
        "the measured d_t is not above d_d, so the limit is d_d after the measurement: two-state ppo-lag "
        "linear seed 0, two-state ppo-lag dynamic seed 0; give a finite train_limits above d_d"
    )
    assert capsys.readouterr().out.splitlines()[-1] == f"warning: {sentence}"
    assert sentence in pages.remarks(sweep_data.load(store))
    assert json.loads(store.trials()[0].provenance_path.read_text())["attempts"][0]["attempt"] == 1


def test_a_hard_landing_is_a_warning_unless_the_curriculum_is_a_control(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A window longer than training leaves the limit of dynamic where it was; step keeps it on purpose."""
    (folder / "grid.yaml").write_text(
        GRID.replace("SEEDS", "0")
        .replace('"my_scaled_task:TASK", label: scaled', "two-state")
        .replace("methods: [none]", "methods: [none, step, {name: dynamic, options: {window: 50}}]")
    )
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    launched = capsys.readouterr().out.splitlines()
    assert main(["status", "--brief"]) == ExitCode.OK
    sentence = (
        "hard landing, the limit was still far above d_d when deployment began: two-state ppo-lag dynamic "
        "seed 0; give the curriculum more steps or a smaller d_t, dynamic a smaller window, or let a decay "
        "of your own end at d_d"
    )
    assert capsys.readouterr().out.splitlines()[-1] == f"warning: {sentence}"
    assert f"warning: {sentence}" in launched
    sweep = sweep_data.load(SweepStore(folder / "runs", "small"))
    assert sentence in pages.remarks(sweep)
    flags = curriculum_flags(sweep)
    assert flags["hard_landing"].tolist() == [method == "dynamic" for method in flags["method"]]
    assert not flags["no_curriculum"].any()
    step = next(it.spec for it in sweep.facts if it.spec.method.name == "step")
    assert not landed_hard(step, [HARD_LANDING])  # as earlier trials of step have it
