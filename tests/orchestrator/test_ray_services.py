"""A launch whose Ray dies around it: it ends with a sentence, and the same launch goes on."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.spec import TrialStatus
from tests.faults.chaos import comm, descendants

GRID = """\
name: bereft
tasks: [{name: gymnasium, label: waiting, deploy_limits: 3, options: {id: "waiting:Waiting-v0"}}]
agents:
  - name: ppo-lag
    options: {hidden_sizes: [8], critic_steps: 1, critic_passes: 1, policy_steps: 1, policy_passes: 1}
methods: [linear]
seeds: 1
run: {total_steps: 16_000, num_envs: 4, rollout_steps: 10, evaluation_episodes: 4}
"""
# A trial takes minutes while the file is there, and seconds without it.
TASK = """\
import pathlib, time
import gymnasium
import numpy as np

class Waiting(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {{}}
    def step(self, action):
        if pathlib.Path({wait!r}).exists():
            time.sleep(0.01)
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, False, self.steps == 10, {{"cost": float(action)}}

gymnasium.register("Waiting-v0", Waiting)
"""
COMMAND = [
    sys.executable,
    "-m",
    "recrl",
    "launch",
    "grid.yaml",
    "--no-figures",
    "--no-mlflow",
]


@pytest.fixture
def wait(tmp_path: Path) -> Path:
    """The file that makes trials wait, beside a grid of one trial and its task."""
    file = tmp_path / "wait"
    file.touch()
    (tmp_path / "waiting.py").write_text(TASK.format(wait=str(file)))
    (tmp_path / "grid.yaml").write_text(GRID)
    return file


def launch(folder: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, *options], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def running_trial(store: SweepStore, *, after: int = 0) -> int:
    """The process of the trial, once it has done some updates; another one than ``after``."""
    begun: dict[int, int] = {}
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        for trial in store.trials():
            record = trial.record()
            if record.status is not TrialStatus.RUNNING or record.pid == after:
                continue
            if record.update > begun.setdefault(record.pid, record.update):  # an attempt keeps the last one's
                return record.pid
        time.sleep(0.02)
    raise AssertionError("no trial began within two minutes")


@pytest.mark.parametrize(
    ("title", "said"),
    [
        ("raylet", "Ray's node service (raylet) at 127.0.0.1:"),
        ("gcs_server", "Ray's head service (GCS) at 127.0.0.1:"),
    ],
)
def test_a_dead_service_of_ray_ends_the_launch_with_a_sentence_and_leaves_no_process(
    title: str, said: str, wait: Path, tmp_path: Path
) -> None:
    store = SweepStore(tmp_path / "runs", "bereft")
    driver = launch(tmp_path)
    trial = running_trial(store)
    [victim] = [pid for pid in descendants(driver.pid, "") if comm(pid) == title]
    os.kill(victim, signal.SIGKILL)
    _, errors = driver.communicate(timeout=100.0)
    assert driver.returncode == ExitCode.CANNOT_RUN, errors
    expected = r"[0-9]+ has died; nothing that was saved is lost, and the same launch continues\n"
    assert re.fullmatch("(recrl-sweep: )?" + re.escape(said) + expected, errors)
    assert not store.is_locked()
    end = time.monotonic() + 30.0
    while comm(trial) and time.monotonic() < end:  # it is killed; the kernel takes its time
        time.sleep(0.1)
    assert comm(trial) == ""
    assert all(it.record().update < it.spec.num_updates for it in store.trials())  # it died in the middle
    wait.unlink()
    again = launch(tmp_path, "--executor", "inline")  # the files are what matters, and it starts sooner
    _, errors = again.communicate(timeout=300.0)
    assert again.returncode == ExitCode.OK, errors
    assert [(it.record().status, it.record().attempt) for it in store.trials()] == [(TrialStatus.COMPLETE, 2)]


def test_the_next_launch_ends_what_a_killed_one_left_and_sigterm_to_a_worker_is_no_failure(
    wait: Path, tmp_path: Path
) -> None:
    """A batch system that takes a node away sends SIGTERM to the workers."""
    store = SweepStore(tmp_path / "runs", "bereft")
    driver = launch(tmp_path)
    first = running_trial(store)
    processes = [pid for pid in descendants(driver.pid, "") if comm(pid).startswith(("ray::", "raylet"))]
    assert len(processes) >= 4
    driver.kill()
    driver.communicate()
    assert all(it.record().update < it.spec.num_updates for it in store.trials())  # it died in the middle
    again = launch(tmp_path)
    os.kill(running_trial(store, after=first), signal.SIGTERM)
    wait.unlink()
    _, errors = again.communicate(timeout=300.0)
    assert again.returncode == ExitCode.OK, errors
    end = time.monotonic() + 30.0  # a killed process of a busy machine needs a moment
    while any(comm(pid) for pid in processes) and time.monotonic() < end:
        time.sleep(0.2)
    assert [comm(pid) for pid in processes] == [""] * len(processes)
    [trial] = store.trials()
    record = trial.record()
    assert (record.status, record.attempt) == (TrialStatus.COMPLETE, 3)
    assert not trial.error_path.exists()
