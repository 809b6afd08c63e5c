"""The command line: quick to start, honest in its exit codes, and its errors are sentences."""

import errno
import itertools
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pandas as pd
import pytest

from recrl.analysis.data import export, sweep_data
from recrl.analysis.figures import learning_curves
from recrl.environments.plugins import load_attribute
from recrl.orchestrator.cli import display, status
from recrl.orchestrator.cli.argument_fields import Request
from recrl.orchestrator.cli.arguments import COMMANDS, parse
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.cli.sweeps import command_line
from recrl.orchestrator.errors import DamagedError, RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.find_sweep import find_sweep
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.spec import Choice, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import last_report
from recrl.orchestrator.trial import speed
from recrl.orchestrator.trial.saved_policy import SavedTrial
from recrl.orchestrator.trial.speed import measured_speed
from recrl.orchestrator.trial.trial import Trial
from tests.orchestrator.launches import INLINE

GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none, linear]
seeds: 1
run: {total_steps: 160, deploy_fraction: 0.5, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
"""
UNLUCKY_AGENT = """\
from recrl.agents.algorithms.own_options import PPOLagConfig
from recrl.agents.registry import AgentEntry

def make(cmdp, config, seed):
    raise ArithmeticError("no luck")

ENTRY = AgentEntry("An unlucky agent.", PPOLagConfig, make)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that holds ``grid.yaml``."""
    (tmp_path / "grid.yaml").write_text(GRID)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _python(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("arguments", [["--help"], ["launch", "--help"], ["validate", "grid.yaml"]])
def test_help_and_validate_import_nothing_heavy(folder: Path, arguments: list[str]) -> None:
    code = f"""
import sys
from recrl.orchestrator.cli.main import main
try:
    code = main({arguments!r})
except SystemExit as end:
    code = end.code
heavy = {{"torch", "ray", "mlflow", "matplotlib"}} & set(sys.modules)
assert not heavy, heavy
sys.exit(code)
"""
    done = _python(code, folder)
    assert (done.returncode, done.stderr) == (0, "")


def test_help_imports_nothing_but_the_parser(folder: Path) -> None:
    code = """
import sys
from recrl.orchestrator.cli.arguments import parser
parser().format_help()
assert not {"numpy", "pandas", "pydantic", "gymnasium", "rich", "yaml"} & set(sys.modules)
"""
    done = _python(code, folder)
    assert (done.returncode, done.stderr) == (0, "")


def test_help_names_every_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    epilog = capsys.readouterr().out.partition("Exit codes:")[2]
    assert [int(line.split()[0]) for line in epilog.splitlines() if line.strip()] == [*ExitCode]


@pytest.mark.parametrize("place", COMMANDS.values())
def test_every_command_has_its_function(place: str) -> None:
    assert callable(load_attribute(f"recrl.orchestrator.cli.{place}"))


@pytest.mark.parametrize("request_type", COMMANDS)
def test_the_example_of_every_command_is_accepted(request_type: type[Request]) -> None:
    words = shlex.split(request_type.example.partition(" > ")[0])
    assert words[0] == "recrl-sweep"
    assert type(parse(words[1:])) is request_type


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "the following arguments are required: COMMAND; see recrl-sweep --help"),
        (["launch"], "the following arguments are required: GRID.yaml; see recrl-sweep launch --help"),
        (["list"], "the following arguments are required: KIND; see recrl-sweep list --help"),
        (["list", "task"], "'agents', 'curricula', 'methods'); did you mean 'tasks'?"),
        (["statsu"], "'ui', 'sync'); did you mean 'status'?"),
        (["status", "small", "--breif"], "unrecognized arguments: --breif; did you mean '--brief'?"),
        (["status", "small", "more"], "unrecognized arguments: more"),
    ],
)
def test_an_argument_that_is_misspelt_or_missing_has_a_hint(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == ExitCode.WRONG_INPUT
    usage, *_, error = capsys.readouterr().err.splitlines()
    assert error.endswith(sentence)
    known = arguments[:1] if arguments[:1] in (["launch"], ["list"], ["status"]) else []
    assert usage.startswith(" ".join(["usage: recrl-sweep", *known, "[-h]"]))


def test_a_right_grid_is_confirmed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    assert capsys.readouterr().out == (
        "grid.yaml: small is right: 2 trials, from tasks x agents x methods x seeds = 1 x 1 x 2 x 1\n"
        "a trial has 4 policy updates, 2 of them in the deployment phase under d_d\n"
    )


def test_tasks_with_unequal_rollouts_have_unequal_numbers_of_updates(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "grid.yaml").write_text(
        "name: two\ntasks: [two-state, rivergrid-1a, rivergrid-1b]\ndeploy_limits: 1\nagents: [ppo]\n"
        "methods: [none]\nseeds: 1\nrun: {total_steps: 100_000}\n"
    )
    for command in ("validate", "plan"):
        assert main([command, "grid.yaml"]) == ExitCode.OK
        # 100,000 steps, the last 5,000 under d_d, in updates of 640 and 4,096
        assert (
            "two-state: a trial has 157 policy updates, 8 of them in the deployment phase under d_d\n"
            "rivergrid-1a, rivergrid-1b: a trial has 25 policy updates, 1 of them in the deployment phase "
            "under d_d\n"
        ) in capsys.readouterr().out


@pytest.mark.parametrize("command", [["validate"], ["plan"], ["launch", *INLINE]])
def test_a_wrong_grid_starts_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("linear", "linea").replace("seeds: 1", "seeds: 0"))
    assert main([*command, "grid.yaml"]) == ExitCode.WRONG_INPUT
    shown = capsys.readouterr()
    assert shown.out == ""
    first, second, last = shown.err.splitlines()
    assert first.startswith("grid.yaml:4: methods.1: no curriculum is called 'linea'; did you mean 'linear'?")
    assert second == "grid.yaml:5: seeds: must be a number of seeds from 1 to 10000, or a list, got 0"
    assert last == "2 mistakes in grid.yaml; nothing was started"
    assert not (folder / "runs").exists()


def test_the_main_walk(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Plan, launch, plan again, status, figures: what a first user does."""
    assert main(["plan", "grid.yaml", "--check"]) == ExitCode.TRIALS_LEFT
    out = capsys.readouterr().out
    assert "small: 2 trials: 2 new" in out
    assert " at once on this machine, " in out
    assert main(["plan", "grid.yaml", "--cores", "64"]) == ExitCode.OK
    assert "; 2 trials at once on 64 cores, about " in capsys.readouterr().out
    assert not (folder / "runs").exists()

    assert main(["launch", "grid.yaml", "--executor", "inline", "--no-mlflow"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert "Results    runs/small\n" in out
    assert "Figures    runs/small/figures\n" in out
    assert "Starting Ray" not in out
    table = out.partition("\n\n")[2].splitlines()
    assert table[0].split() == ["task", "agent", "curriculum", "n", "return", "cost", "limit", "verdict"]
    assert [line.split()[:4] for line in table[1:3]] == [
        ["two-state", "ppo-lag", "none", "1"],
        ["two-state", "ppo-lag", "linear", "1"],
    ]
    assert re.search(r" 2\.00 +(solved|feasible|infeasible by [0-9.]+ \([0-9]+%\)) *$", table[1])
    assert table[3].startswith("Final policies (stochastic), without learning, computed exactly from the")
    assert table[3].endswith("; one seed (n = 1): no intervals.")
    assert table[4].endswith("Feasible: no mean cost exceeds its limit by more than 1%.")
    assert out.index("Drawing figures ...\n") < out.index("Figures    runs/small/figures\n")
    assert table[-2] == "Report     runs/small/figures/report.html"
    assert "small: 2 of 2 complete, 0 running, 0 waiting, 0 failed\n" in out
    assert any((folder / "runs/small/figures").glob("*.png"))

    assert main(["plan", "grid.yaml", "--check"]) == ExitCode.OK
    assert "small: 2 trials: 2 complete\nnothing to do\n" in capsys.readouterr().out

    for sweep in ([], ["small"], ["grid.yaml"], ["runs/small"], [f"{folder}/runs/small/"]):
        assert main(["status", "--brief", *sweep]) == ExitCode.OK
        first, warning = capsys.readouterr().out.splitlines()
        assert first == "small: 2 of 2 complete, 0 running, 0 waiting, 0 failed"
        assert warning.startswith("warning: hard landing, ")  # of linear, within two updates

    assert main(["figures", "small", "--sketch"]) == ExitCode.OK


@pytest.mark.usefixtures("unrendered")
def test_a_mistake_in_a_figure_keeps_nobody_from_the_results(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def mistaken(*_: object, **__: object) -> None:
        raise KeyError("river")

    monkeypatch.setattr(learning_curves, "curricula", mistaken)
    assert main(["launch", "grid.yaml", *INLINE[:-1], "--root", "elsewhere"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert (
        "Figures    not all are drawn (KeyError: 'river')\n"
        "           this is a bug in recrl; for its traceback: recrl-sweep figures small --root elsewhere\n"
        "Results    elsewhere/small\n"
    ) in out
    assert out.endswith("small: 2 of 2 complete, 0 running, 0 waiting, 0 failed\n")
    with pytest.raises(KeyError, match="river"):
        main(["figures", "small", "--root", "elsewhere"])


@pytest.mark.usefixtures("unrendered")
def test_a_full_disk_while_figures_are_drawn_ends_no_launch(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(learning_curves, "curricula", full)
    assert main(["launch", "grid.yaml", *INLINE[:-1], "--root", "elsewhere"]) == ExitCode.OK
    assert (
        "Figures    not all are drawn (OSError: [Errno 28] No space left on device)\n"
        "           to draw them later: recrl-sweep figures small --root elsewhere\n"
        "Results    elsewhere/small\n"
    ) in capsys.readouterr().out


@pytest.mark.usefixtures("unrendered")
def test_results_that_cannot_be_read_at_the_end_end_no_launch(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep_data, "load", Mock(side_effect=DamagedError("spec.json: is cut off")))
    monkeypatch.setattr("recrl.orchestrator.run_sweep.HASTY_SYNC_SECONDS", 0.0)  # after an error
    assert main(["launch", "grid.yaml", "--executor", "inline"]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err.endswith("recrl-sweep: spec.json: is cut off\n")
    store = SweepStore(folder / "runs", "small")
    report = last_report(store, tracking_uri(store, None))
    assert report is not None
    assert report.is_up_to_date


def test_only_some_trials(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=linear", "seed=0"]) == ExitCode.OK
    assert "small: 1 of 1 complete" in capsys.readouterr().out
    assert main(["status", "--brief"]) == ExitCode.OK
    assert "small: 1 of 2 complete, 0 running, 1 waiting" in capsys.readouterr().out


def test_failed_trials_are_named_with_their_log(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "my_unlucky_agent.py").write_text(UNLUCKY_AGENT)
    monkeypatch.syspath_prepend(folder)
    (folder / "grid.yaml").write_text(
        GRID.replace("[ppo-lag]", "[{name: 'my_unlucky_agent:ENTRY', label: unlucky}]")
    )
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.TRIALS_FAILED
    trial = SweepStore(Path("runs"), "small").trials()[0].folder.name
    assert capsys.readouterr().out.splitlines()[-4:] == [
        "small: 0 of 1 complete, 0 running, 0 waiting, 1 failed; 0%",
        "failed: two-state unlucky none seed 0: ArithmeticError: no luck "
        "(my_unlucky_agent.py, line 5, in make)",
        f"        log and traceback: runs/small/trials/{trial}",
        "Try what failed again with: recrl-sweep launch grid.yaml --executor inline --no-mlflow --no-figures "
        "--only method=none --retry-failed",
    ]


def test_an_error_without_a_text_fails_its_trial(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = "class Silent(Exception):\n    def __str__(self): return self.text\n\n"
    own = UNLUCKY_AGENT.replace("def make", f"{silent}def make").replace("ArithmeticError", "Silent")
    (folder / "my_silent_agent.py").write_text(own)
    monkeypatch.syspath_prepend(folder)
    (folder / "grid.yaml").write_text(GRID.replace("ppo-lag", "'my_silent_agent:ENTRY'"))
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.TRIALS_FAILED
    place = "(my_silent_agent.py, line 8, in make)"
    assert f"none seed 0: Silent: its text cannot be read {place}\n" in capsys.readouterr().out


def test_no_password_is_printed(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "my_unlucky_agent.py").write_text(UNLUCKY_AGENT)
    monkeypatch.syspath_prepend(folder)
    (folder / "grid.yaml").write_text(GRID.replace("ppo-lag", "'my_unlucky_agent:ENTRY'"))
    uri = "postgresql://me:hunter2@database/mlflow"
    assert main(["launch", "grid.yaml", *INLINE, "--tracking-uri", uri]) == ExitCode.TRIALS_FAILED
    out = capsys.readouterr().out
    assert "--tracking-uri postgresql://***@database/mlflow --retry-failed" in out
    assert "hunter2" not in out


def test_a_busy_sweep_has_its_own_code(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SweepStore(folder / "runs", "small").lock():
        assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.BUSY
    assert capsys.readouterr().err.startswith("recrl-sweep: ")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["status"], "runs: holds no sweep; launch one first, or give the folder of your sweeps with --root"),
        (
            ["status", "smal"],
            "runs: holds no sweep 'smal'; launch it first, or give the folder of your sweeps with --root",
        ),
        (
            ["plan", "grid.yaml", "--only", "linear"],
            "--only: must look like method=dynamic or seed=0,1, got 'linear'",
        ),
        (
            ["plan", "grid.yaml", "--only", "method=linaer"],
            "--only: no trial has method 'linaer'; did you mean 'linear'? (known: none, linear)",
        ),
    ],
)
def test_wrong_arguments_are_a_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(arguments) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}\n"


def test_a_sweep_above_the_working_directory_has_its_own_name(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(folder / "runs", "small")
    store.folder.mkdir(parents=True)
    store.write_info({"name": store.name})
    (store.folder / "trials").mkdir()
    monkeypatch.chdir(store.folder / "trials")
    assert main(["status", "..", "--brief"]) == ExitCode.OK
    assert capsys.readouterr().out.startswith("small: 0 of 0 complete")


def test_several_sweeps_must_be_told_apart(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("large", "small"):
        store = SweepStore(folder / "runs", name)
        store.folder.mkdir(parents=True)
        store.write_info({"name": store.name})
    assert main(["status"]) == ExitCode.WRONG_INPUT
    assert main(["status", "smal"]) == ExitCode.WRONG_INPUT
    assert main(["status", "runs/smal"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.splitlines() == [
        "recrl-sweep: runs: holds 2 sweeps; give one: large, small",
        "recrl-sweep: runs: holds no sweep 'smal'; did you mean 'small'? (there: large, small)",
        "recrl-sweep: runs: holds no sweep 'runs/smal'; did you mean 'small'? (there: large, small)",
    ]


def test_a_plan_for_a_cluster_that_is_not_there_is_a_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "grid.yaml", "--address", "127.0.0.1:1"]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err.startswith("recrl-sweep: cannot use the Ray cluster at 127.0.0.1:1: ")


def test_ctrl_c_stops_cleanly_and_says_how_to_go_on(folder: Path) -> None:
    long = GRID.replace("total_steps: 160", "total_steps: 1e9")
    (folder / "grid.yaml").write_text(long)
    command = [sys.executable, "-m", "recrl", "launch", "grid.yaml", *INLINE]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "small: 2 trials: 2 new\n"  # from here on signals are handled
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (ExitCode.STOPPED, "")
    assert out.splitlines()[-1] == (
        "Stopped; nothing is lost. Continue with: recrl-sweep launch grid.yaml "
        "--executor inline --no-mlflow --no-figures"
    )
    store = SweepStore(folder / "runs", "small")
    assert tuple(store.specs()) == parse_grid(long.encode(), source="grid.yaml").trials()
    assert not any(trial.record().status.is_finished for trial in store.trials())


def test_a_closed_pipe_ends_no_command_and_changes_no_exit_code(folder: Path) -> None:
    """``recrl-sweep launch grid.yaml | head -1``: the reader is gone before anything is written."""

    def without_reader(*arguments: str, closed: Sequence[int] = (1,)) -> tuple[int, str]:
        code = f"""
import os, sys
from recrl.orchestrator.cli.main import main
reader, writer = os.pipe()
for descriptor in {closed}:
    os.dup2(writer, descriptor)
os.close(reader)
sys.exit(main({list(arguments)}))
"""
        done = _python(code, folder)
        return done.returncode, done.stderr

    assert without_reader("list", "tasks") == (ExitCode.OK, "")
    _own_room(folder, "room_printing", "{'cost': print('x' * 1000) or 1.0}", "name: 'room_printing:Room'")
    assert without_reader("launch", "grid.yaml", *INLINE) == (ExitCode.OK, "")
    store = SweepStore(folder / "runs", "small")
    assert all(trial.record().status is TrialStatus.COMPLETE for trial in store.trials())
    assert without_reader("logs", "small", store.trials()[0].trial_id) == (ExitCode.OK, "")
    assert without_reader("validate", "nothing.yaml", closed=(1, 2)) == (ExitCode.WRONG_INPUT, "")
    store.trials()[0].episodes_path.write_text("cut")
    assert without_reader("check", "small") == (ExitCode.TRIALS_FAILED, "")


@pytest.mark.parametrize("arguments", ["list tasks", "status nothing", "logs nothing a"])
def test_closed_streams_are_no_traceback(folder: Path, arguments: str) -> None:
    for closed in (">&-", "2>&-"):
        command = f"{shlex.quote(sys.executable)} -m recrl {arguments} {closed}"
        done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == (ExitCode.OK if arguments == "list tasks" else ExitCode.WRONG_INPUT)
        assert "Traceback" not in done.stderr


def test_a_terminal_without_a_sign_shows_another(folder: Path) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    done = subprocess.run(
        [sys.executable, "-m", "recrl", "evaluate", "small", "--only", "method=none"],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"[0-9] \? [0-9]", done.stdout)


def test_the_module_runs_like_the_script(folder: Path) -> None:
    command = [sys.executable, "-m", "recrl", "--version"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("recrl ")


LONG = GRID.replace("total_steps: 160", "total_steps: 1e9")


def test_stop_ends_a_launch_from_another_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "grid.yaml").write_text(LONG)
    command = [sys.executable, "-m", "recrl", "launch", "grid.yaml", *INLINE]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "small: 2 trials: 2 new\n"
        assert main(["stop", "small"]) == ExitCode.OK
        first, last = capsys.readouterr().out.splitlines()
        assert first == "small: its trials save their state"
        assert last.startswith("small: 0 of 2 complete, 0 running, ")
        assert "Stopped; nothing is lost." in process.communicate(timeout=60)[0]
    assert process.returncode == ExitCode.STOPPED
    assert main(["stop", "small"]) == ExitCode.OK
    assert capsys.readouterr().out == "small: no launch runs this sweep\n"
    assert not SweepStore(folder / "runs", "small").stop_request_path.exists()


def test_a_stop_request_that_a_new_launch_deleted_is_repeated(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    requests: list[SweepPlace] = []

    def request_stop(place: SweepPlace) -> Callable[[], bool]:
        requests.append(place)
        return lambda: len(requests) < 2

    monkeypatch.setattr(SweepPlace, "request_stop", request_stop)
    monkeypatch.setattr("recrl.orchestrator.cli.status.REPEAT_SECONDS", 0.0)
    assert main(["stop", "small"]) == ExitCode.OK
    assert len(requests) == 2
    assert "small: its trials save their state\n" in capsys.readouterr().out


def test_logs_are_found_by_id_title_or_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    capsys.readouterr()
    trial = SweepStore(Path("runs"), "small").trials()[1]
    assert trial.spec.title == "two-state ppo-lag none seed 0"
    for words in (
        [trial.spec.trial_id],
        [trial.spec.trial_id[:5]],
        ["two-state", "ppo-lag", "none"],
        [trial.folder.name],
    ):
        assert main(["logs", "small", *words, "--follow"]) == ExitCode.OK
        assert capsys.readouterr().out == trial.log_path.read_text()
    assert main(["logs", "small", trial.spec.trial_id, "--folder"]) == ExitCode.OK
    assert capsys.readouterr().out == f"runs/small/trials/{trial.folder.name}\n"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["nobody"],
            "small: no trials on disk begin with 'nobody'; see recrl-sweep status small",
        ),
        ([], "small: no trials are running; see recrl-sweep status small"),
        (
            ["two-state"],
            "small: 2 trials on disk begin with 'two-state'; give one, by its id or title: ",
        ),
    ],
)
def test_logs_of_nobody_and_of_several(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    store = SweepStore(folder / "runs", "small")
    for spec in grid.trials():
        store.trial(spec).begin(spec).close(TrialStatus.WAITING)
    store.write_info({"name": store.name})
    assert main(["logs", "small", *words]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith(f"recrl-sweep: {sentence}")


def test_status_says_why_a_trial_was_stopped(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    store = SweepStore(folder / "runs", "small")
    spec = grid.trials()[0]
    store.trial(spec).begin(spec).close(TrialStatus.WAITING, error="the disk was full")
    store.write_info({"name": store.name})
    assert main(["status", "--brief"]) == ExitCode.OK  # nothing was launched: no trials are known
    store.write_specs([spec])
    assert main(["status", "--brief"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert (
        "0 waiting, 0 failed, 1 stopped; 0%\nstopped: two-state ppo-lag none seed 0: the disk was full\n"
        in out
    )


def test_a_disk_that_takes_nothing_is_a_sentence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        code = main(["launch", "grid.yaml", *INLINE])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err.endswith("File too large; saved results are kept\n")


@pytest.mark.parametrize(
    "sweep_command", ["status", "stop", "logs", "evaluate", "figures", "export", "bound", "ui"]
)
def test_a_wrong_grid_file_is_a_sentence_for_every_command(
    folder: Path, capsys: pytest.CaptureFixture[str], sweep_command: str
) -> None:
    (folder / "bad.yaml").write_text(GRID.replace("name: small", "name: ../small"))
    assert main([sweep_command, "bad.yaml"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "bad.yaml:1: name: must be a name for a folder: letters, digits and . _ - only, at most 64, got "
        "'../small'\n1 mistake in bad.yaml; nothing was started\n"
    )
    assert main([sweep_command, "gird.yaml"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        f"gird.yaml: there is no such file in {folder}; did you mean 'grid.yaml'?\n"
        "1 mistake in gird.yaml; nothing was started\n"
    )


def test_lists_and_films_do_not_swallow_what_follows(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "--only", "method=none", "seed=0", "grid.yaml"]) == ExitCode.OK
    assert "small: 1 trial: 1 new" in capsys.readouterr().out
    assert main(["plan", "--only", "method=none,linear", "--only", "seed=0", "grid.yaml"]) == ExitCode.OK
    assert "small: 2 trials: 2 new" in capsys.readouterr().out
    assert main(["evaluate", "--video", "nope"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith("recrl-sweep: runs: holds no sweep 'nope'")


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("--cores=1e9", "argument --cores: must be a whole number, written with digits only, got '1e9'"),
        ("--cores=0", "argument --cores: must be at least 1, got 0"),
        ("--root=grid.yaml", "argument --root: must be a folder, got the file 'grid.yaml'"),
        (
            "--root=" + "x" * 999,
            "argument --root: cannot be used (File name too long), got '" + "x" * 60 + "'...",
        ),
    ],
)
def test_a_wrong_option_is_a_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str], option: str, sentence: str
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["plan", "grid.yaml", option])
    assert end.value.code == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.splitlines()[-1] == f"recrl-sweep plan: error: {sentence}"


EMPTY = "must not be empty; leave it out, or check the shell's variable"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["launch", "grid.yaml", "--storage", ""], f"argument --storage: {EMPTY}"),
        (["launch", "grid.yaml", "--address="], f"argument --address: {EMPTY}"),
        (["launch", "grid.yaml", "--root", ""], f"argument --root: {EMPTY}"),
        (["figures", "small", "--to", " "], f"argument --to: {EMPTY}"),
        (["logs", "--follow", "--folder"], "argument --folder: not allowed with argument --follow"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert capsys.readouterr().err.splitlines()[-1] == f"recrl-sweep {arguments[0]}: error: {sentence}"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["launch", "grid.yaml", *INLINE, "--address", "auto"],
            "the inline executor uses no cluster; leave out the address auto",
        ),
        (
            ["launch", "grid.yaml", *INLINE, "--max-concurrent", "2"],
            "the inline executor runs one trial after the other, and not 2 at once",
        ),
        (
            ["export", "small", "--tracking-uri", "sqlite:///x.db", "--storage", "memory://x"],
            "--tracking-uri, --storage: give one of them, the place to read the sweep from",
        ),
        (
            ["figures", "small.zip", "--storage", "memory://x"],
            "small.zip, --storage: give one of them, the place to read the sweep from",
        ),
    ],
)
def test_options_that_exclude_each_other_start_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(arguments) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}\n"
    assert not (folder / "runs").exists()


def test_a_hint_is_a_command_that_finds_the_sweep_and_the_server(folder: Path) -> None:
    assert command_line("status", SweepStore(Path("runs"), "small")) == "recrl-sweep status small"
    assert command_line("status", SweepStore(folder / "runs", "small")) == "recrl-sweep status small"
    elsewhere = SweepStore(Path("/data/all runs"), "small")
    assert command_line("sync", elsewhere, "http://m:5000") == (
        "recrl-sweep sync small --root '/data/all runs' --tracking-uri http://m:5000"
    )


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE, errno.EPERM])
def test_a_disk_that_is_lost_is_a_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def lost(*_: object) -> None:
        raise OSError(number, os.strerror(number), "runs/small")

    monkeypatch.setattr(status, "run_status", lost)
    assert main(["status", "small"]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err == (
        f"recrl-sweep: runs/small: {os.strerror(number)}; saved results are kept\n"
    )


@pytest.mark.parametrize("value", ["[" * 100_000, "1" * 5_000], ids=["deep", "long"])
def test_an_option_that_json_cannot_read_is_text(
    folder: Path, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    assert main(["replay", "small", "--teacher", "dynamic", f"--option=window={value}"]) == 2
    assert capsys.readouterr().err.startswith("recrl-sweep: --option: dynamic: window: ")


def test_an_option_that_is_no_json_number_is_a_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    assert main(["replay", "small", "--teacher", "dynamic", "--option=return_floor=Infinity"]) == 2
    assert capsys.readouterr().err.startswith("recrl-sweep: --option: ")


def test_a_folder_that_may_not_be_read_is_no_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "sweep.json").write_text("{}")
    (tmp_path / "private").mkdir()
    whole = Path.exists

    def refused(path: Path) -> bool:
        if path.parent.name == "private":
            raise PermissionError(13, "Permission denied", str(path))
        return whole(path)

    monkeypatch.setattr(Path, "exists", refused)
    assert find_sweep(tmp_path, None).name == "mine"


@pytest.mark.parametrize("label", ["[/b] up", "[bold] x.py:100: y"])
def test_a_label_is_shown_as_it_is(folder: Path, capsys: pytest.CaptureFixture[str], label: str) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("linear", f"{{name: linear, label: '{label}'}}"))
    assert main(["plan", "grid.yaml"]) == ExitCode.OK
    assert f"two-state ppo-lag {label} " in capsys.readouterr().out
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    assert main(["status", "small"]) == ExitCode.OK
    assert f"two-state ppo-lag {label} " in capsys.readouterr().out
    [trial] = SweepStore(folder / "runs", "small").trials()
    with trial.log_path.open("a") as log:
        log.write(f"warning of {label}\n")
    assert main(["logs", "small", "two-state"]) == ExitCode.OK
    assert f"\nwarning of {label}\n" in capsys.readouterr().out


@pytest.mark.usefixtures("folder")
def test_a_file_system_without_locks_is_a_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    no_locks = Mock(side_effect=OSError(errno.ENOLCK, "No locks available"))
    monkeypatch.setattr("recrl.orchestrator.files.locks.fcntl.flock", no_locks)
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err == (
        "recrl-sweep: the file system of the results has no locks (Lustre and NFS can be mounted with them); "
        "keep the sweep elsewhere, by --root or --storage\n"
    )


def test_a_root_below_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "grid.yaml").write_text("name: x")
    with pytest.raises(SystemExit):
        main(["status", "x", "--root", str(tmp_path / "grid.yaml" / "below")])
    assert f"must be a folder, but '{tmp_path / 'grid.yaml'}' is a file" in capsys.readouterr().err


def test_plan_measures_what_has_not_run_yet(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "grid.yaml"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert "\ntime unknown until a first trial has run (two-state ppo-lag); " in out
    assert out.endswith("To measure about a second of each: recrl-sweep plan grid.yaml --measure\n")
    assert main(["plan", "grid.yaml", "--measure", "--cores", "1"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert re.search(r"\ntwo-state ppo-lag: [0-9,]+ steps/s on one core\n", out)
    assert re.search(r"\nabout \d+ s with 1 trial at once on 1 cores, ", out)
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    ("total_steps", "first", "expected"),
    [
        (20_000, 2.0, 160.0),  # 12 updates in 3 s after the first one
        (20_000, 4.0, 10.0),  # the first one takes the whole time
        (160, 2.0, 160.0),  # the trial ends before the time is over: 3 updates in 0.75 s
        (40, 2.0, 20.0),  # it ends with the first one
    ],
)
def test_a_measured_speed_is_steps_by_cpu_seconds_after_the_first_update(
    monkeypatch: pytest.MonkeyPatch, total_steps: int, first: float, expected: float
) -> None:
    """Updates of 40 steps; by the clock the first takes ``first`` seconds, each of the others 0.25."""
    clock = [100.0]
    takes = itertools.chain([first], itertools.repeat(0.25))
    advance = Trial.advance

    def advance_clock(trial: Trial) -> None:
        clock[0] += next(takes)
        advance(trial)

    monkeypatch.setattr(Trial, "advance", advance_clock)
    monkeypatch.setattr(speed, "time", SimpleNamespace(process_time=lambda: clock[0]))
    grid = GRID.replace("total_steps: 160", f"total_steps: {total_steps}")
    spec = parse_grid(grid.encode(), source="grid.yaml").trials()[0]
    assert measured_speed(spec, seconds=3.0) == expected


ROOM = """\
import gymnasium
import numpy as np

class Room(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}
    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, False, self.steps == 5, INFO

gymnasium.register("Room-v0", Room)
"""


def _own_room(folder: Path, module: str, info: str, task: str) -> None:
    (folder / f"{module}.py").write_text(ROOM.replace("INFO", info))
    (folder / "grid.yaml").write_text(GRID.replace("{name: two-state,", f"{{{task},"))


SCRIPT = "import sys; sys.path.remove(''); from recrl.orchestrator.cli.main import main; sys.exit(main({}))"


def test_modules_in_the_working_directory_are_found(folder: Path) -> None:
    """Python searches the folder of the installed command only. A tutorial shows it for Ray's workers."""
    other = "name: gymnasium, deploy_limits: 2, options: {id: 'room_a:Room-v0'}}, {name: 'room_a:Room'"
    _own_room(folder, "room_a", "{'cost': 1.0}", other)
    done = _python(SCRIPT.format(["validate", "grid.yaml", "--trust"]), folder)
    assert (done.returncode, done.stderr) == (0, "")
    done = _python(SCRIPT.format(["launch", "grid.yaml", *INLINE]), folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "small: 4 of 4 complete" in done.stdout


def test_a_module_that_is_nowhere_is_a_sentence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("two-state", "'my_nav:make'"))
    assert main(["validate", "grid.yaml", "--trust"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith(
        "grid.yaml:2: tasks.0.name: cannot import 'my_nav:make': there is no module my_nav; start the "
        "command in the folder that holds it, name that folder in PYTHONPATH, or install the module's "
        "package\n"
    )


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (
            "name: 'room_b:Room'",
            "grid.yaml:2: tasks.0: room_b:Room fails in its first steps: ValueError: room_b:Room: the "
            "environment must report info['cost'] at every step: info has no 'cost', only 'speed' (for",
        ),
        (
            "name: gymnasium, options: {id: Pendulum-v1}",
            "grid.yaml:2: tasks.0: gymnasium fails in its first steps: ValueError: gymnasium: the "
            "environment must report info['cost'] at every step: info has no 'cost' (for",
        ),
    ],
)
def test_an_environment_without_costs_is_refused_at_validate(
    folder: Path, capsys: pytest.CaptureFixture[str], task: str, sentence: str
) -> None:
    _own_room(folder, "room_b", "{'speed': 1.0}", task)
    assert main(["validate", "grid.yaml", "--trust"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith(sentence)


def test_an_export_has_no_policies(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "small.zip"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "recrl-sweep: small.zip: an export has tables but no policies, logs or trials; give the sweep's "
        "name or folder\n"
    )


def test_logs_show_return_and_cost(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    capsys.readouterr()
    assert main(["logs", "small", "two-state"]) == ExitCode.OK
    out = capsys.readouterr().out
    line = r"update 4 of 4, deployment: return -?[0-9.]+, [a-z]+ [0-9.]+ of limit 2\.00\n"
    assert len(re.findall(line, out)) == 1


def _log_of_a_trial_that_begins_later(
    monkeypatch: pytest.MonkeyPatch, store: SweepStore, grid: GridSpec, *words: str
) -> None:
    """Follow a log during a launch whose first trial begins in a third pause, and ends in a sixth."""
    spec = grid.trials()[0]

    def happens() -> Iterator[None]:
        yield from [None] * 2
        writer = store.trial(spec).begin(spec)
        store.trial(spec).log_path.write_text("it began\n")
        yield from [None] * 3
        writer.close(TrialStatus.WAITING)
        yield

    pauses = happens()
    clock = SimpleNamespace(sleep=lambda seconds: next(pauses), monotonic=time.monotonic, time=time.time)
    for module in (status, display):
        monkeypatch.setattr(module, "time", clock)
    with store.lock():
        store.write_info({"name": store.name})
        store.write_specs(grid.trials(), grid.text)
        assert main(["logs", "small", *words, "--follow"]) == ExitCode.OK
    assert list(pauses) == []


def test_following_a_log_waits_for_the_start(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(folder / "runs", "small")
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    _log_of_a_trial_that_begins_later(monkeypatch, store, grid)
    assert capsys.readouterr().out == "small: waiting for a trial to start\nit began\n"


def test_following_the_log_of_a_stopped_trial_waits_until_it_runs_again(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    store = SweepStore(folder / "runs", "small")
    spec = grid.trials()[0]
    store.trial(spec).begin(spec).close(TrialStatus.WAITING)
    _log_of_a_trial_that_begins_later(monkeypatch, store, grid, spec.trial_id)
    assert "it began\n" in capsys.readouterr().out


def test_a_grid_too_short_for_a_deployment_phase_is_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("deploy_fraction: 0.5", "deploy_fraction: 0.05"))
    for command in ("validate", "plan"):
        assert main([command, "grid.yaml"]) == ExitCode.OK
        assert (
            "warning: the deployment phase is shorter than an update, so that no update learns under d_d: "
            "two-state ppo-lag linear seed 0; take 6 times the total_steps or a larger deploy_fraction"
        ) in capsys.readouterr().out.splitlines()


def test_a_curriculum_without_a_deployment_phase_is_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("deploy_fraction: 0.5", "deploy_fraction: 0"))
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    assert (
        "warning: there is no deployment phase, so that perhaps no update learns under d_d: "
        "two-state ppo-lag linear seed 0; give a larger deploy_fraction"
    ) in capsys.readouterr().out.splitlines()


def test_a_control_without_limits_needs_a_deployment_phase_whatever_train_limits_are(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = GRID.replace("0.5", "0").replace("linear", "linear, unconstrained")
    (folder / "grid.yaml").write_text(text.replace("deploy_limits: 2", "deploy_limits: 2, train_limits: 2"))
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert warnings == [
        "warning: there is no deployment phase, so that perhaps no update learns under d_d: "
        "two-state ppo-lag unconstrained seed 0; give a larger deploy_fraction",
        "warning: train_limits equal deploy_limits, so that the limits are d_d from the start: "
        "two-state ppo-lag linear seed 0; give larger train_limits, or auto",
    ]


def test_a_training_shorter_than_an_episode_is_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "grid.yaml").write_text(
        GRID.replace("{name: two-state,", "{name: two-state, options: {horizon: 21},")
    )
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    assert (
        "warning: training gives each environment fewer steps than an episode may have, so maybe no episode "
        "ends: two-state; take more total_steps or fewer num_envs"
    ) in capsys.readouterr().out.splitlines()


def test_a_curriculum_that_relaxes_no_limit_is_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("deploy_limits: 2", "deploy_limits: 2, train_limits: 2"))
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    [warning] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert warning == (
        "warning: train_limits equal deploy_limits, so that the limits are d_d from the start: "
        "two-state ppo-lag linear seed 0; give larger train_limits, or auto"
    )


def test_a_task_that_does_not_say_how_long_an_episode_may_be_is_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "endless.py").write_text(
        "import gymnasium\n"
        "class Room(gymnasium.Env):\n"
        "    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))\n"
        "    action_space = gymnasium.spaces.Discrete(2)\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        return self.observation_space.low, {}\n"
        "    def step(self, action):\n"
        "        return self.observation_space.low, 1.0, False, False, {'cost': 0.0}\n"
    )
    (folder / "grid.yaml").write_text(
        GRID.replace("{name: two-state,", "{name: 'endless:Room', label: room,")
    )
    for command in ("validate", "plan"):
        assert main([command, "grid.yaml", "--trust"]) == ExitCode.OK
        assert (
            "warning: unknown horizon, and an episode that never ends gives no result: room; let step return "
            "truncated=True, and give the environment an attribute horizon, or TimeLimit"
        ) in capsys.readouterr().out.splitlines()


def test_replay_draws_each_cost_of_the_tasks_that_have_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = "tasks: [{name: two-state, deploy_limits: 2}, {name: two-state-2, deploy_limits: [2, 2]}]"
    (folder / "grid.yaml").write_text(GRID.replace("tasks: [{name: two-state, deploy_limits: 2}]", both))
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    capsys.readouterr()
    assert main(["replay", "small", "--teacher", "linear", "--only", "method=none"]) == ExitCode.OK
    assert capsys.readouterr().out.count("Figure ") == 2


def test_replay_names_an_option_that_a_model_would_ignore(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "my_loose_curriculum.py").write_text(
        "from pydantic import BaseModel\n"
        "from recrl.teachers.registry import TeacherKind\n"
        "from recrl.teachers.static import none_teacher\n"
        "class Loose(BaseModel):\n    power: float = 1.0\n"
        "LOOSE = TeacherKind('Loose.', Loose, none_teacher)\n"
    )
    monkeypatch.syspath_prepend(folder)
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    replay = ["replay", "small", "--teacher", "my_loose_curriculum:LOOSE", "--trust", "--option"]
    assert main([*replay, "power=2"]) == ExitCode.OK
    capsys.readouterr()
    assert main([*replay, "pwer=2"]) == ExitCode.WRONG_INPUT
    sentence = "--option: my_loose_curriculum:LOOSE: pwer: unknown key; did you mean 'power'?"
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}\n"


def test_replay_names_recorded_options_that_this_version_does_not_have(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    store = SweepStore(folder / "runs", "small")
    old = [replace(spec, method=Choice("linear", {"slope": 2.0})) for spec in store.specs()]
    store.write_specs(old)
    capsys.readouterr()
    assert main(["replay", "small", "--teacher", "linear"]) == ExitCode.WRONG_INPUT
    error = capsys.readouterr().err
    assert error.startswith(
        "recrl-sweep: linear: recorded with options that this version does not have (slope: "
    )
    assert error.endswith("; replay it with the code of its commit\n")
    asked = ["replay", "small", "--teacher", "linear", "--option", "slope=2"]
    assert main(asked) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith("recrl-sweep: --option: linear: slope: ")


def test_replay_leaves_out_a_trial_that_has_saved_nothing_yet(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE, "--only", "method=none"]) == ExitCode.OK
    store = SweepStore(folder / "runs", "small")
    linear = store.specs()[1]
    store.trial(linear).begin(linear).heartbeat(update=1, env_steps=40, steps_per_second=1.0)
    capsys.readouterr()
    assert main(["replay", "small", "--teacher", "cosine"]) == ExitCode.OK
    assert main(["replay", "small", "--teacher", "cosine", "--only", "method=linear"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == ("recrl-sweep: small: no chosen trial has a saved policy update yet\n")


def test_evaluate_shows_what_it_could_evaluate(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    evaluate = SavedTrial.evaluate

    def half(self: SavedTrial, *arguments: Any, **options: Any) -> Any:
        if self.spec.method.name == "linear":
            raise RecrlError("no luck")
        return evaluate(self, *arguments, **options)

    monkeypatch.setattr(SavedTrial, "evaluate", half)
    capsys.readouterr()
    assert main(["evaluate", "small", "--episodes", "3"]) == ExitCode.TRIALS_FAILED
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("Episodes") for line in lines)
    assert "left out   no luck" in lines
    assert not any(line.startswith("Replaced") for line in lines)
    assert main(["evaluate", "small", "--only", "method=linear"]) == ExitCode.WRONG_INPUT
    assert main(["evaluate", "small", "--only", "method=none", "--episodes", "4"]) == ExitCode.OK
    [replaced] = [it for it in capsys.readouterr().out.splitlines() if it.startswith("Replaced")]
    assert replaced.startswith("Replaced   the earlier evaluation with this seed, now runs/small/trials/")
    assert replaced.endswith("/aside/001-update-00000004__seed-own.csv")
    assert main(["evaluate", "small", "nobody", "--only", "seed=0"]) == ExitCode.WRONG_INPUT
    assert "no trials on disk begin with 'nobody'" in capsys.readouterr().err  # not that seed 0 is missing


def test_evaluate_leaves_out_trials_that_the_grid_no_longer_has(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their task, agent, curriculum and seed may be those of a trial of the grid."""
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    (before, _) = SweepStore(folder / "runs", "small").specs()
    (folder / "grid.yaml").write_text(GRID.replace("total_steps: 160", "total_steps: 240"))
    capsys.readouterr()
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    assert (
        "no longer in the grid: 2 trials, kept on disk and left out of results\n" in capsys.readouterr().out
    )
    assert main(["evaluate", "small", "--only", "method=none"]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert shown.count("two-state ppo-lag none seed 0") == 2  # stochastic and deterministic
    assert "left out   1 trial no longer in the grid; to evaluate one of them, name it by its id\n" in shown
    assert main(["evaluate", "small", before.trial_id, "--policy", "stochastic"]) == ExitCode.OK
    assert before.folder_name in capsys.readouterr().out
    (folder / "grid.yaml").write_text(GRID.replace("methods: [none, linear]", "methods: [cosine]"))
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    assert main(["evaluate", "small", "--only", "method=none"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "recrl-sweep: small: 2 trials no longer in the grid; to evaluate one of them, name it by its id\n"
    )


@pytest.mark.parametrize("name", ["a.zip", "b.yaml", "c.YML"])
def test_a_sweep_is_not_called_like_a_file(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (folder / "grid.yaml").write_text(GRID.replace("name: small", f"name: {name}"))
    assert main(["validate", "grid.yaml"]) == ExitCode.WRONG_INPUT
    assert f"must not end like a file, with .zip, .yaml or .yml, got '{name}'" in capsys.readouterr().err


def test_an_environment_that_cannot_be_closed_is_no_traceback(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _own_room(folder, "room_closed", "{'cost': 1.0}", "name: 'room_closed:Room'")
    code = (folder / "room_closed.py").read_text().partition("gymnasium.register")[0]
    closing = "    def close(self):\n        raise RuntimeError('stuck')\n"
    (folder / "room_closed.py").write_text(code + closing)
    assert main(["validate", "grid.yaml", "--trust"]) == ExitCode.OK
    assert "room_closed:Room raised an error when it was closed: RuntimeError: stuck" in caplog.text


@pytest.mark.usefixtures("unrendered")
def test_a_part_of_a_sweep_is_drawn_and_exported_elsewhere(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    for command in ("figures", "export"):
        assert main([command, "small", "--only", "method=none"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.splitlines() == 2 * [
        "recrl-sweep: --only: give --to as well, so that a part does not replace what has all trials"
    ]
    assert main(["figures", "small", "--sketch", "--only", "method=none", "--to", "part"]) == ExitCode.OK
    assert not (folder / "runs" / "small" / "figures").exists()
    assert pd.read_csv(folder / "part" / "verdicts.csv")["method"].tolist() == ["none"]
    assert "only trials with method=none are here" in (folder / "part" / "report.md").read_text()
    assert main(["export", "small", "--only", "method=none", "--to", "part.zip"]) == ExitCode.OK
    assert export.load(Path("part.zip")).trials["method"].tolist() == ["none"]
    assert main(["bound", "small", "--only", "method=nine"]) == ExitCode.WRONG_INPUT
    assert "--only: no trial has method 'nine'" in capsys.readouterr().err


@pytest.mark.usefixtures("unrendered")
def test_figures_of_an_export_have_a_folder_of_their_own(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    (folder / "kept").mkdir()
    assert main(["export", "small", "--to", "kept/one.zip"]) == ExitCode.OK
    assert main(["figures", "kept/one.zip", "--sketch"]) == ExitCode.OK
    assert (folder / "one-figures").is_dir()
    assert not (folder / "kept" / "figures").exists()
