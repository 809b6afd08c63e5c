"""What is committed is held against its length and digest: damage is named, and nothing is made of it."""

import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.report import pages
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import CheckpointError, DamagedError, RowError
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.atomic_files import read_sealed, write_sealed
from recrl.orchestrator.files.row_files import Extent, RowFile
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.launch_plan import PlannedAction, make_plan
from recrl.orchestrator.run_sweep import SweepResult, SweepRunSettings, run_sweep
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.trial.attempt import run_recorded
from tests.orchestrator.launches import INLINE

GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 0.5, options: {horizon: 5}}]
agents: [{name: ppo-lag, options: {hidden_sizes: [4], policy_steps: 2, critic_steps: 2}}]
methods: [none, linear]
seeds: 1
run: {total_steps: 120, deploy_fraction: 0.5, num_envs: 2, rollout_steps: 10, evaluation_episodes: 2}
"""
RERUN = "launch --rerun-damaged runs the trial again and moves the damaged files aside"
GOES_ON = "the next launch continues from the intact files and moves the damaged ones aside"
SPECS = parse_grid(GRID.encode(), source="grid.yaml").trials()


def run(store: SweepStore, *, updates: int | None = None, **options: Any) -> SweepResult:
    """Launch the grid; its trials are stopped after so many updates."""

    class Stopping:
        def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
            for spec in specs:
                run_recorded(
                    spec,
                    place.store.trial(spec),
                    should_stop=partial(next, iter([False] * (updates or 0)), True),
                    commit_seconds=0.0,
                )

    executor: Executor = InlineExecutor() if updates is None else Stopping()
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    settings = SweepRunSettings(grid, SweepPlace(store), executor, **options)
    return run_sweep(settings, stop=threading.Event())


def results(store: SweepStore) -> dict[str, bytes]:
    return {
        f"{trial.folder.name}/{path.name}": path.read_bytes()
        for trial in store.trials()
        for path in (trial.episodes_path, trial.events_path, trial.evaluation_path, trial.policy_path)
        if path.exists()
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a complete sweep and with one that was stopped after four updates of six."""
    folder = tmp_path_factory.mktemp("made")
    run(SweepStore(folder / "complete", "small"))
    run(SweepStore(folder / "stopped", "small"), updates=4)
    return folder


@pytest.fixture
def undisturbed(made: Path) -> dict[str, bytes]:
    return results(SweepStore(made / "complete", "small"))


@pytest.fixture
def store(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A complete sweep, in the working directory's ``runs``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    shutil.copytree(made / "complete", tmp_path / "runs")
    return SweepStore(tmp_path / "runs", "small")


@pytest.fixture
def stopped(made: Path, tmp_path: Path) -> SweepStore:
    """A sweep that was stopped after four updates of six."""
    shutil.copytree(made / "stopped", tmp_path / "stopped-runs")
    return SweepStore(tmp_path / "stopped-runs", "small")


def cut(path: Path, share: float = 0.5) -> tuple[int, int]:
    """Cut a file; its lengths after and before."""
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return int(share * len(data)), len(data)


def flip(path: Path, share: float = 0.5) -> None:
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 1
    path.write_bytes(bytes(data))


def aside(trial: TrialStore) -> list[str]:
    return sorted(path.name.partition("-")[2] for path in trial.aside_folder.glob("*"))


# Complete trials.


def test_a_complete_trial_that_was_cut_is_damaged_and_its_numbers_are_not_used(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = store.trials()[0]
    after, before = cut(trial.episodes_path)
    sentence = f"episodes.csv has {after:,} of its {before:,} committed bytes; {RERUN}"
    record = trial.record()
    assert (record.status, record.error) == (TrialStatus.DAMAGED, sentence)
    assert record.is_left_alone
    sweep = sweep_data.load(store)
    assert sweep.trials["status"].tolist() == ["complete", "damaged"]
    assert set(sweep.phases["method"]) == set(sweep.updates["method"]) == {"none"}
    title = trial.spec.title
    assert f"{title}: damaged, 0% of its steps done: {sentence}" in pages.remarks(sweep)
    for command in (["status", "--brief"], ["plan", "grid.yaml"], ["export", "small"]):
        assert main(command) == ExitCode.OK
        assert f"damaged: {title}: {sentence}\n" in capsys.readouterr().out


def test_a_sweep_without_an_undamaged_trial_has_no_results(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    for trial in store.trials():
        cut(trial.episodes_path)
    for command in ("bound", "figures"):
        assert main([command, "small"]) == ExitCode.CANNOT_RUN
        assert capsys.readouterr().err == "recrl-sweep: small: all trials are damaged\n"
    assert main(["replay", "small", "--teacher", "cosine"]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err == "recrl-sweep: small: all chosen trials are damaged\n"


def test_a_flipped_byte_in_a_complete_trial_is_found_by_its_digest(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = store.trials()[0]
    flip(trial.episodes_path)
    with pytest.raises(DamagedError) as found:
        trial.episodes()
    assert str(found.value) == (
        f"{trial.folder.name}: episodes.csv is not what was committed: its checksum differs; {RERUN}"
    )
    assert sweep_data.load(store).trials["status"].tolist() == ["complete", "damaged"]
    assert main(["check"]) == ExitCode.TRIALS_FAILED
    assert capsys.readouterr().out.splitlines() == [
        f"{trial.spec.title}: episodes.csv is not what was committed: its checksum differs",
        "small: 2 trials checked, 1 wrong file",
        "launch continues damaged trials from their intact files; complete ones: --rerun-damaged",
    ]


def test_an_undamaged_sweep_is_checked_and_right(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "small"]) == ExitCode.OK
    assert capsys.readouterr().out == "small: 2 trials checked, no wrong files\n"


def test_every_committed_file_has_its_length_and_digest_in_the_record(store: SweepStore) -> None:
    for trial in store.trials():
        names = {path.name for path in trial.folder.iterdir() if path.is_file() and path.name[0] != "."}
        record = trial.record()
        assert set(record.committed) == set(record.digests) == names - {"state.json", "log.txt"}
        for name, extent in record.extents.items():
            assert extent == Extent.of((trial.folder / name).read_bytes())


def test_a_damaged_complete_trial_is_run_again_only_when_asked(
    store: SweepStore, undisturbed: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    trial = store.trials()[0]
    cut(trial.episodes_path)
    damaged = trial.episodes_path.read_bytes()
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.TRIALS_FAILED
    out = capsys.readouterr().out
    assert "small: 2 trials: 1 complete, 1 damaged\nnothing to do\n" in out
    assert out.splitlines()[-1] == (
        "1 damaged trial left alone; to move the damaged files aside and run again: recrl-sweep launch "
        "grid.yaml --executor inline --no-mlflow --no-figures --rerun-damaged"
    )
    assert trial.episodes_path.read_bytes() == damaged
    assert main(["launch", "grid.yaml", *INLINE, "--rerun-damaged"]) == ExitCode.OK
    assert results(store) == undisturbed
    assert "episodes.csv" in aside(trial)
    assert damaged in [path.read_bytes() for path in trial.aside_folder.iterdir()]


# Interrupted trials.


@pytest.mark.parametrize("name", ["episodes.csv", "updates.csv", "events.jsonl"])
@pytest.mark.parametrize("do", [cut, flip, Path.unlink])
def test_an_interrupted_trial_goes_on_from_what_is_whole_and_nothing_is_filled_with_nothing(
    stopped: SweepStore, undisturbed: dict[str, bytes], name: str, do: Callable[[Path], object]
) -> None:
    store = stopped
    trial = store.trial(SPECS[1])
    do(trial.folder / name)
    if do is not flip:
        assert trial.record().status is TrialStatus.DAMAGED
        assert trial.record().error.endswith(GOES_ON)
        assert [it.action for it in make_plan(SPECS, store).trials] == [
            PlannedAction.RESUME,
            PlannedAction.REPAIR,
        ]
    result = run(store)
    assert result.progress.is_complete
    assert results(store) == undisturbed
    assert all(b"\0" not in (each.folder / name).read_bytes() for each in store.trials())
    assert (name in aside(trial)) == (do is not Path.unlink)


def test_what_is_cut_behind_the_checkpoint_before_is_taken_up_there(stopped: SweepStore) -> None:
    trial = stopped.trial(SPECS[1])
    newest, before = trial.checkpoints()
    cut(trial.episodes_path, 0.95)
    writer = trial.begin(SPECS[1])
    tree = writer.restore()
    assert tree is not None and tree["update"] == 3
    assert newest.with_suffix(".damaged").exists() and before.exists()
    assert trial.record().status is TrialStatus.RUNNING
    assert len(trial.episodes()) == 3 * 4


def test_a_file_that_is_cut_while_the_trial_runs_is_not_filled_up(stopped: SweepStore) -> None:
    trial = stopped.trial(SPECS[0])
    writer = trial.begin(SPECS[0])
    tree = writer.restore()
    assert tree is not None
    after, before = cut(trial.updates_path)
    writer.append_event({"update": 5, "end_step": 100, "event": "x"})
    with pytest.raises(DamagedError) as found:
        writer.commit(tree, update=5, env_steps=100)
    assert str(found.value) == (
        f"updates.csv has {after:,} of its {before:,} committed bytes; it was cut while the trial ran"
    )
    assert trial.updates_path.stat().st_size == after


def test_committed_rows_whose_checkpoints_are_gone_are_kept_aside(
    stopped: SweepStore, undisturbed: dict[str, bytes]
) -> None:
    store = stopped
    trial = store.trial(SPECS[1])
    for path in trial.checkpoints():
        path.unlink()
    assert trial.damages() == [
        f"checkpoints/{trial.record().checkpoint}: cannot be read: No such file or directory"
    ]
    assert run(store).progress.is_complete
    assert results(store) == undisturbed
    assert {"episodes.csv", "updates.csv", "events.jsonl"} <= set(aside(trial))


# Checkpoints.


def test_a_checkpoint_of_another_trial_is_refused(store: SweepStore) -> None:
    one, other = store.trials()
    path = one.checkpoints()[0]
    path.write_bytes(other.checkpoints()[0].read_bytes())
    with pytest.raises(CheckpointError) as found:
        one.load_checkpoint(path)
    assert str(found.value) == f"{path}: the checkpoint is that of another trial, {other.trial_id}"
    assert one.damages() == [
        f"checkpoints/{path.name}: the checkpoint is that of another trial, {other.trial_id}"
    ]


def test_a_checkpoint_of_another_format_is_named(store: SweepStore) -> None:
    path = store.trials()[0].checkpoints()[0]
    path.write_bytes(path.read_bytes().replace(b"recrl checkpoint 2\n", b"recrl checkpoint 1\n"))
    with pytest.raises(
        CheckpointError, match="the checkpoint has format 1, of another version of recrl, and this"
    ):
        store.trials()[0].load_checkpoint(path)


def test_evaluate_leaves_out_a_trial_whose_last_checkpoint_is_gone(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checkpoint before it would give other numbers without a word."""
    trial = store.trials()[0]
    trial.checkpoints()[0].unlink()
    assert main(["evaluate", "small", "--policy", "stochastic"]) == ExitCode.TRIALS_FAILED
    out = capsys.readouterr().out
    assert "two-state ppo-lag none seed 0" in out and "linear seed 0  " not in out
    assert (
        f"left out   {trial.spec.title}: checkpoints/checkpoint-00000006.recrl: cannot be read: No such"
        in out
    )


# Small files.


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("state.json", "", "state.json is empty"),
        ("state.json", "{", "state.json is not JSON"),
        ("state.json", "[1]", "state.json must hold a JSON object, it holds a list"),
        ("state.json", None, "state.json is missing"),
        ("spec.json", None, "spec.json is missing, "),
    ],
)
def test_a_bad_small_file_of_one_trial_is_a_sentence_and_the_others_go_on(
    store: SweepStore, capsys: pytest.CaptureFixture[str], name: str, text: str | None, sentence: str
) -> None:
    trial = store.trials()[0]
    (trial.folder / name).unlink()
    if text is not None:
        (trial.folder / name).write_text(text)
    assert main(["status", "--brief"]) == ExitCode.OK
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first == "small: 1 of 2 complete, 0 running, 0 waiting, 0 failed, 1 damaged; 50%"
    assert second.startswith("damaged: two-state ppo-lag linear seed 0: " + sentence)


def test_another_trials_state_is_no_state_of_this_one(store: SweepStore) -> None:
    one, other = store.trials()
    one.state_path.write_bytes(other.state_path.read_bytes())
    assert one.record().error == f"state.json is that of another trial, {other.trial_id}; {GOES_ON}"


def test_a_state_that_is_lost_costs_a_trial_nothing(store: SweepStore, undisturbed: dict[str, bytes]) -> None:
    """The checkpoint knows how far it was."""
    trial = store.trial(SPECS[1])
    trial.state_path.write_text("garbage")
    assert run(store).progress.is_complete
    assert results(store) == undisturbed
    assert trial.record().attempt == 2
    assert "state.json" in aside(trial)


def test_a_file_where_a_trials_folder_should_be_is_moved_aside(
    store: SweepStore, undisturbed: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    trial = store.trial(SPECS[1])
    trial.folder.rename(store.folder / "elsewhere")
    trial.folder.write_text("not a folder")
    assert main(["status", "--brief"]) == ExitCode.OK
    assert f"{trial.folder.name} is a file, it must be a folder; {GOES_ON}\n" in capsys.readouterr().out
    assert run(store).progress.is_complete
    assert results(store) == undisturbed
    assert [path.read_text() for path in (store.folder / "aside").iterdir()] == ["not a folder"]


def test_a_sweep_whose_folder_was_renamed_is_read_under_its_new_name(store: SweepStore) -> None:
    run(store)
    renamed = SweepStore(store.folder.parent, "renamed")
    store.folder.rename(renamed.folder)
    assert renamed.damages() == []
    assert [spec.trial_id for spec in renamed.specs()] == [spec.trial_id for spec in SPECS]
    assert main(["check", "renamed"]) == ExitCode.OK


@pytest.mark.parametrize("name", ["other", "small"])
@pytest.mark.parametrize("file", ["info_path", "specs_path"])
def test_one_file_of_another_sweep_is_damage_whatever_the_sweeps_are_called(
    store: SweepStore, tmp_path: Path, file: str, name: str
) -> None:
    run(store)
    other = SweepStore(tmp_path / "elsewhere", name)
    shutil.copytree(store.folder, other.folder)
    other.write_info({**other.info(), "name": name, "created": 1.0})
    other.write_specs(SPECS, store.grid_path.read_bytes())
    assert other.damages() == []
    shutil.copy(getattr(other, file), getattr(store, file))
    assert store.damages()
    with pytest.raises(DamagedError, match=r"not of this sweep|that of another sweep"):
        (store.info(), store.specs())


def test_a_copy_that_is_launched_is_another_sweep(store: SweepStore) -> None:
    run(store)
    copied = SweepStore(store.folder.parent, "copied")
    shutil.copytree(store.folder, copied.folder)
    grid = parse_grid(GRID.replace("name: small", "name: copied").encode(), source="grid.yaml")
    settings = SweepRunSettings(grid, SweepPlace(copied), InlineExecutor())
    run_sweep(settings, stop=threading.Event())
    assert copied.info()["created"] != store.info()["created"]
    shutil.copy(store.specs_path, copied.specs_path)
    assert any("not of this sweep" in problem for problem in copied.damages())


@pytest.mark.parametrize("file", ["info_path", "specs_path"])
def test_a_renamed_sweep_that_lacks_a_file_says_which(store: SweepStore, file: str) -> None:
    run(store)
    renamed = SweepStore(store.folder.parent, "renamed")
    store.folder.rename(renamed.folder)
    missing: Path = getattr(renamed, file)
    missing.unlink()
    assert any(missing.name in problem for problem in renamed.damages())
    assert not any("that of another sweep" in problem for problem in renamed.damages())


@pytest.mark.parametrize(
    ("name", "code", "sentence"),
    [
        ("trials.jsonl", ExitCode.CANNOT_RUN, "trials.jsonl is not what was written: its checksum differs; "),
        ("sweep.json", ExitCode.OK, "damaged: sweep.json is not what was written: its checksum differs; "),
        ("grid.yaml", ExitCode.OK, "damaged: grid.yaml is not what was written; "),
    ],
)
def test_a_bad_file_of_the_sweep_is_a_sentence_and_a_launch_writes_it_anew(
    store: SweepStore, capsys: pytest.CaptureFixture[str], name: str, code: ExitCode, sentence: str
) -> None:
    path = store.folder / name
    path.write_bytes(path.read_bytes().replace(b"two-state", b"two-stage").replace(b'"small"', b'"smell"'))
    assert main(["status", "--brief"]) == code
    shown = capsys.readouterr()
    assert sentence in shown.out + shown.err
    assert main(["check"]) == ExitCode.TRIALS_FAILED
    capsys.readouterr()
    assert run(store).progress.is_complete
    assert main(["check"]) == ExitCode.OK


def test_a_local_copys_address_that_is_damaged_is_a_sentence(
    store: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    store.storage_path.write_text("{}")
    assert main(["status"]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err == (
        "recrl-sweep: small: storage.json has format None, of another version of recrl, and this one reads "
        "format 2, so that the sweep's address is unknown; delete it and give --storage URI again\n"
    )


def test_a_record_of_another_version_is_left_alone(store: SweepStore) -> None:
    trial = store.trial(SPECS[0])
    write_sealed(trial.state_path, {"trial_id": trial.trial_id, "status": "complete"}, version=1)
    assert trial.record().error.startswith(
        "state.json has format 1, of another version of recrl, and this one reads format 2; "
    )
    assert make_plan(SPECS, store).trials[0].action is PlannedAction.DAMAGED


def test_a_sealed_file_says_when_a_byte_of_it_changed(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    write_sealed(path, {"number": 1234}, version=3)
    assert read_sealed(path, version=3) == {"number": 1234}
    path.write_text(path.read_text().replace("1234", "1235"))
    with pytest.raises(DamagedError, match=r"^file\.json is not what was written: its checksum differs$"):
        read_sealed(path, version=3)


# Columns.


def test_a_row_is_written_by_the_names_of_its_columns(tmp_path: Path) -> None:
    file = RowFile(tmp_path / "updates.csv")
    file.add_row({"a": 1, "b": 2}, of="agent mine")
    file.add_row({"b": 4, "a": 3}, of="agent mine")
    file.mark_committed(file.write())
    assert file.path.read_text() == "a,b\n1,2\n3,4\n"
    again = RowFile(file.path)
    assert again.resume_after(file.extent)
    again.add_row({"b": 6, "a": 5}, of="agent mine")
    again.mark_committed(again.write())
    assert file.path.read_text() == "a,b\n1,2\n3,4\n5,6\n"
    assert again.extent == Extent.of(file.path.read_bytes())


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ({"a": 1}, "agent mine: b missing in a row of updates.csv; "),
        ({"a": 1, "b": 2, "c": 3}, "agent mine: c new in a row of updates.csv; "),
        ({"a": 1, "c": 2}, "agent mine: b missing; c new in a row of updates.csv; "),
        ({"a": 1, "b": "x,y"}, "a cell must be a number or a plain word, got 'x,y'"),
    ],
)
def test_a_row_with_other_columns_names_the_agent(
    tmp_path: Path, row: dict[str, object], sentence: str
) -> None:
    file = RowFile(tmp_path / "updates.csv")
    file.add_row({"a": 1, "b": 2}, of="agent mine")
    with pytest.raises(RowError) as found:
        file.add_row(row, of="agent mine")
    assert str(found.value).startswith(sentence)


FICKLE = """\
from recrl.agents.algorithms.own_options import PPOLagConfig
from recrl.agents.algorithms.ppo_lag import make_ppo_lag
from recrl.agents.registry import AgentEntry

def make(cmdp, config, seed):
    agent = make_ppo_lag(cmdp, config, seed)
    learn, updates = agent.update, iter(range(1, 10**9))
    def update(rollout, costs, limits):
        metrics = learn(rollout, costs, limits)
        number = next(updates)
        return {CHANGE}
    agent.update = update
    return agent

ENTRY = AgentEntry("Fickle.", PPOLagConfig, make)
"""


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ("dict(reversed(metrics.items())) if number % 2 else metrics", ""),
        (
            "metrics if number < 3 else {**metrics, 'mood': 1.0}",
            "RowError: agent fickle: mood new in a row of ",
        ),
        (
            "{**metrics, 'cost_0': 0.0}",
            "RowError: agent fickle: its metrics must have other names than columns "
            "of a trial or of a sweep's tables, got cost_0 (in update 1; no checkpoint before it)",
        ),
    ],
)
def test_an_agent_whose_metrics_change_is_named_and_one_that_reorders_them_is_not_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, bytes], change: str, error: str
) -> None:
    (tmp_path / "my_fickle_agent.py").write_text(FICKLE.replace("{CHANGE}", change))
    monkeypatch.syspath_prepend(tmp_path)
    spec = replace(SPECS[0], agent=replace(SPECS[0].agent, name="my_fickle_agent:ENTRY", label="fickle"))
    trial = SweepStore(tmp_path, "sweep").trial(spec)
    run_recorded(spec, trial, should_stop=lambda: False)
    assert trial.record().error.startswith(error)
    assert trial.record().status is (TrialStatus.FAILED if error else TrialStatus.COMPLETE)
    if not error:
        plain = SweepStore(tmp_path, "plain").trial(SPECS[0])
        run_recorded(SPECS[0], plain, should_stop=lambda: False)
        one, other = trial.updates(), plain.updates()
        names = [str(name) for name in one if name not in ("time", "collect_seconds", "update_seconds")]
        assert sorted(map(str, one)) == sorted(map(str, other))
        assert one[names].equals(other[names])


def test_episodes_must_all_have_the_same_costs(tmp_path: Path) -> None:
    from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase  # noqa: PLC0415

    def episode(*costs: float) -> EpisodeStats:
        return EpisodeStats(0, Phase.TRAINING, 1, 1, 0.0, costs, CostLimits.unlimited(len(costs)), 0.0)

    writer = SweepStore(tmp_path, "sweep").trial(SPECS[0]).begin(SPECS[0])
    writer.append_episode(episode(1.0))
    with pytest.raises(
        RowError, match=r"^task two-state: an episode has 2 costs and 2 limits, earlier ones had"
    ):
        writer.append_episode(episode(1.0, 2.0))


# Speed.


def test_a_commit_hashes_only_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = RowFile(tmp_path / "updates.csv")
    file.add_text("x" * 10_000_000 + "\n")
    file.mark_committed(file.write())
    monkeypatch.setattr(Path, "open", _only_for_writing(Path.open))
    for _ in range(100):
        file.add_text("y\n")
        file.mark_committed(file.write())
    monkeypatch.undo()
    assert file.extent == Extent.of(file.path.read_bytes())


def _only_for_writing(open_path: Callable[..., object]) -> Callable[..., object]:
    def opened(self: Path, mode: str = "r", *arguments: object) -> object:
        file = open_path(self, mode, *arguments)
        file.read = _refuse  # type: ignore[attr-defined]
        return file

    return opened


def _refuse(*_: object) -> bytes:
    raise AssertionError("a commit reads nothing")
