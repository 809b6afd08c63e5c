"""A sweep among killers: whatever dies at whatever time, every episode is there once, as if nothing had been.

    python tests/faults/chaos.py [--seconds 600] [--seed 0] [--log results/chaos/seed-0.txt]

A sweep of real trials on Ray, synced to an MLflow server on this machine's own address, is launched again
and again with the same command, while at random times (drawn from the seed) one of these happens:

    worker    kill -9 of a process that runs a trial
    hang      SIGSTOP of such a process, which nobody lets go on: its silence must be noticed
    teacher   kill -9 of the teacher service
    raylet    kill -9 of Ray's node service: the launch must end with exit code 4
    gcs       kill -9 of Ray's head service: likewise
    driver    kill -9 of the launch
    group     SIGTERM to the launch's whole process group, as ``timeout`` or a terminal sends it
    stop      ``recrl-sweep stop``
    mlflow    kill -9 of the MLflow server, which is started anew

Then one launch is left in peace to finish, and everything is compared with a sweep that was never disturbed,
trial after trial in one process: the episodes, events and evaluations byte for byte, the final parameters and
optimisers number for number, and MLflow's points with those that the files give. Ends with 0 if all of it
agrees.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.tracking.run_content import final_points, points, rows_after, thinned

GRID = """\
name: chaos
tasks: [{{name: rivergrid-1a, deploy_limits: 5}}]
agents: [ppo-lag, cpo]
methods: [linear, {{name: dynamic, options: {{window: 5}}}}]
seeds: 2
run: {{total_steps: {steps}, evaluation_episodes: 10}}
resources: {{silence_seconds: 15}}
"""
WEIGHTS = {"worker": 8, "hang": 1, "teacher": 3, "raylet": 2, "gcs": 2}
WEIGHTS |= {"driver": 2, "group": 1, "stop": 1, "mlflow": 2}
SERVICES = {"raylet": "raylet", "gcs": "gcs_server"}
MEAN_PAUSE_SECONDS = 8.0
SILENT = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}


@dataclass
class Chaos:
    """The launch, the server, and who kills them.

    Attributes:
        folder: holds the grid and everything that is written.
        log: where it is told.
        port: of the MLflow server.
    """

    folder: Path
    log: TextIO
    port: int
    began: float = field(default_factory=time.monotonic)
    driver: subprocess.Popen[bytes] | None = None
    server: subprocess.Popen[bytes] | None = None
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def store(self) -> SweepStore:
        return SweepStore(self.folder / "disturbed", "chaos")

    def say(self, sentence: str) -> None:
        line = f"{time.monotonic() - self.began:7.1f} s  {sentence}"
        print(line, flush=True)
        print(line, file=self.log, flush=True)

    def command(self, name: str, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "recrl", name, *arguments]

    def start_driver(self) -> subprocess.Popen[bytes]:
        command = self.command("launch", "grid.yaml", "--root", "disturbed", "--retry-failed", "--no-figures")
        with (self.folder / "launches.txt").open("ab") as out:
            return subprocess.Popen(
                [*command, "--tracking-uri", self.uri],
                cwd=self.folder,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    def start_server(self) -> None:
        stores = ["--backend-store-uri", f"sqlite:///{self.folder}/mlflow.db"]
        stores += ["--artifacts-destination", str(self.folder / "artifacts")]
        address = ["--host", "127.0.0.1", "--port", str(self.port), "--workers", "1"]
        with (self.folder / "server.txt").open("ab") as out:
            self.server = subprocess.Popen(
                [sys.executable, "-m", "mlflow", "server", *stores, *address],
                env={**os.environ, **SILENT},
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    def end_server(self) -> None:
        if self.server is not None:
            os.killpg(self.server.pid, signal.SIGKILL)
            self.server.wait()

    def disturb(self, seconds: float, generator: random.Random) -> None:
        """Do harm until the time is over or the sweep complete."""
        end = time.monotonic() + seconds
        while True:
            pause = generator.expovariate(1.0 / MEAN_PAUSE_SECONDS)
            kind = generator.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
            until = time.monotonic() + pause
            # half of the harm may come while a launch begins; the rest waits until there are trials to harm
            patient = generator.random() < 0.5 or kind in ("worker", "hang", "teacher", *SERVICES)
            while time.monotonic() < end and (time.monotonic() < until or (patient and not self.trials())):
                if self.driver is None or self.driver.poll() is not None:
                    if self.driver is not None:
                        self.say(f"the launch ended with {self.driver.returncode}")
                    if self.driver is not None and self.driver.returncode == 0:
                        return
                    self.driver = self.start_driver()
                    self.say(f"launch {self.count('launch')} is process {self.driver.pid}")
                time.sleep(0.1)
            if time.monotonic() >= end:
                return
            self.harm(kind, generator)

    def harm(self, kind: str, generator: random.Random) -> None:
        assert self.driver is not None
        victims = [self.driver.pid]
        if kind in ("worker", "hang"):
            victims = self.trials()
        elif kind == "teacher":
            victims = self.processes("TeacherService")
        elif kind in SERVICES:
            victims = [pid for pid in descendants(self.driver.pid, "") if comm(pid) == SERVICES[kind]]
        if not victims or self.driver.poll() is not None:
            return
        victim = generator.choice(victims)
        if kind == "mlflow":
            self.end_server()
            self.start_server()
        elif kind == "group":
            os.killpg(self.driver.pid, signal.SIGTERM)
        elif kind == "stop":
            subprocess.Popen(
                self.command("stop", "chaos", "--root", "disturbed"),
                cwd=self.folder,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        else:
            os.kill(victim, signal.SIGSTOP if kind == "hang" else signal.SIGKILL)
        self.say(f"{kind} {self.count(kind)}")

    def trials(self) -> list[int]:
        """The launch's processes that run a trial."""
        records = (trial.record() for trial in self.store.trials())
        running = {record.pid for record in records if record.status is TrialStatus.RUNNING}
        return [pid for pid in self.processes("") if pid in running]

    def processes(self, name: str) -> list[int]:
        """The launch's processes on Ray whose names begin so."""
        return sorted(descendants(self.driver.pid, f"ray::{name}")) if self.driver else []

    def count(self, kind: str) -> int:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        return self.counts[kind]

    def finish(self) -> bool:
        """Leave launches in peace until one is done."""
        for _ in range(4):
            if self.driver is None or self.driver.poll() is not None:
                self.driver = self.start_driver()
                self.say("a launch that is left in peace")
            code = self.driver.wait()
            self.say(f"the launch ended with {code}")
            if code == 0:
                return True
        return False

    def synchronise(self) -> bool:
        """Wait for the server, and send it what it missed."""
        end = time.monotonic() + 180.0
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    break
            time.sleep(0.5)
        command = self.command("sync", "chaos", "--root", "disturbed", "--tracking-uri", self.uri)
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)
        self.say(f"sync: {(done.stdout or done.stderr).strip()}")
        return done.returncode == 0

    def undisturbed(self) -> SweepStore:
        command = self.command("launch", "grid.yaml", "--root", "undisturbed", "--executor", "inline")
        command += ["--no-figures", "--no-mlflow"]
        with (self.folder / "undisturbed.txt").open("ab") as out:
            code = subprocess.run(command, cwd=self.folder, stdout=out, stderr=out, check=False).returncode
        self.say(f"the undisturbed sweep ended with {code}")
        return SweepStore(self.folder / "undisturbed", "chaos")


def descendants(root: int, title: str) -> Iterator[int]:
    """The processes below ``root`` whose command line begins with ``title``."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    for pid in parents:
        above = pid
        while above in parents and above != root:
            above = parents[above]
        try:
            if above == root and Path(f"/proc/{pid}/cmdline").read_bytes().startswith(title.encode()):
                yield pid
        except OSError:
            continue


def comm(pid: int) -> str:
    """The name of a process; empty if it is over."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return ""
    name, _, rest = status.partition("(")[2].rpartition(")")
    return "" if rest.split()[0] == "Z" else name


def differences(ours: TrialStore, theirs: TrialStore) -> Iterator[str]:
    """What of a trial is not as it is in the undisturbed sweep."""
    if ours.record().status is not TrialStatus.COMPLETE:
        yield f"it is {ours.record().status}"
        return
    indices = ours.episodes()["index"].tolist()
    if indices != list(range(len(indices))):
        yield "an episode is missing or there twice"
    for path in (ours.episodes_path, ours.events_path, ours.evaluation_path):
        if path.read_bytes() != (theirs.folder / path.name).read_bytes():
            yield f"{path.name} differs"
    one, other = ours.latest_checkpoint(), theirs.latest_checkpoint()
    assert one is not None and other is not None
    try:
        np.testing.assert_equal(one["trial"], other["trial"])
    except AssertionError:
        yield "the final parameters differ"


def shown(store: SweepStore, uri: str) -> Iterator[str]:
    """Where MLflow does not show what the files say."""
    os.environ.update(SILENT)
    from mlflow.tracking import MlflowClient  # noqa: PLC0415  (takes seconds)

    client = MlflowClient(uri)
    experiment = client.get_experiment_by_name(f"recrl/{store.name}")
    assert experiment is not None
    for trial in store.trials():
        wanted = f"tags.`recrl.trial_id` = '{trial.spec.trial_id}'"
        runs = client.search_runs([experiment.experiment_id], wanted)
        if [run.info.status for run in runs] != ["FINISHED"]:
            yield f"{trial.spec.title}: its runs are {[run.info.status for run in runs]}"
            continue
        rows = list(thinned(rows_after(trial.updates_path.read_bytes(), 0), trial.spec.num_updates))
        expected = [point for _, row in rows for point in points(row, trial.spec)]
        expected += final_points(trial.updates(), trial.evaluation(), rows[-1][1])
        for key in sorted({point.key for point in expected}):
            shown = sorted((m.step, m.value) for m in client.get_metric_history(runs[0].info.run_id, key))
            told = sorted((point.step, point.value) for point in expected if point.key == key)
            if shown != told:
                yield f"{trial.spec.title}: {key} has {len(shown)} points, the files give {len(told)}"


def compared(store: SweepStore, expected: SweepStore, say: Callable[[str], None]) -> int:
    """Compare all trials of two sweeps, and return how many things are wrong."""
    trials, wrong = store.trials(), 0
    for trial in trials:
        for difference in differences(trial, expected.trial(trial.spec)):
            say(f"WRONG {trial.spec.title}: {difference}")
            wrong += 1
    if [trial.spec for trial in trials] != [trial.spec for trial in expected.trials()] or not trials:
        say("WRONG the sweeps have different trials")
        wrong += 1
    episodes = sum(len(trial.episodes()) for trial in trials)
    attempts = sum(trial.record().attempt for trial in trials)
    say(f"{len(trials)} trials in {attempts} attempts, {episodes} episodes compared byte for byte")
    return wrong


def check(chaos: Chaos) -> bool:
    """Compare everything; whether it agrees."""
    wrong = compared(chaos.store, chaos.undisturbed(), chaos.say)
    for difference in shown(chaos.store, chaos.uri):
        chaos.say(f"WRONG in MLflow: {difference}")
        wrong += 1
    return not wrong


def main() -> int:
    parser = argparse.ArgumentParser(description="Kill everything of a sweep but its files.")
    parser.add_argument("--seconds", type=float, default=600.0, help="of harm")
    parser.add_argument("--seed", type=int, default=0, help="of the times and the victims")
    parser.add_argument("--steps", type=int, default=0, help="of a trial; by default 9,000 a second")
    parser.add_argument("--log", type=Path, help="write what happened there too")
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # also in the background
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    steps = given.steps or int(9_000 * given.seconds)
    log_path = given.log or Path(os.devnull)
    log_path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="chaos-") as name, log_path.open("w") as log:
        folder = Path(name)
        (folder / "grid.yaml").write_text(GRID.format(steps=steps))
        print(f"python tests/faults/chaos.py {' '.join(sys.argv[1:])}", file=log, flush=True)
        chaos = Chaos(folder, log, port)
        try:
            chaos.start_server()
            chaos.disturb(given.seconds, random.Random(given.seed))
            right = chaos.finish() and chaos.synchronise() and check(chaos)
        finally:
            chaos.end_server()
            if chaos.driver is not None and chaos.driver.poll() is None:
                chaos.driver.kill()
                chaos.driver.wait()
        chaos.say(", ".join(f"{count} x {kind}" for kind, count in sorted(chaos.counts.items())))
        chaos.say("everything agrees" if right else "NOT everything agrees")
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
