"""What everything around learning costs: files and MLflow beside a trial's own CPU time, and small trials.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_overhead.py [--updates 30] [--trials 2000]

First one trial of CarGoal2 (``ppo-lag``, 256x256, 16 environments) in this process. Its files: the CPU time
of its thread inside the writer, heartbeats included, with a commit every 20 seconds. MLflow: the sync
process beside the trial, as a launch has it, less that over an empty sweep. Both go by the clock. Where
others take the core from the trial, they look larger beside its CPU time than they are beside a core: the
second share is that of a trial with a core of its own. The aim is at most 2% of it. Ray, the driver and the
teacher service are in ``bench_ray_processes``.

Then the whole command over many trials of some milliseconds: wall seconds, on a quiet machine only. The
sync may take 120 s after a launch; ``sync`` shows what it could not.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.launch_grid import SYNC_INTERVAL_SECONDS
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.tracking.background_sync import start_sync
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.trial.attempt import run_trial
from recrl.teachers.registry import make_teacher

STEPS_PER_UPDATE = 16_000
GRID = """\
name: many
tasks: [{{name: two-state, deploy_limits: 3}}]
agents: [{{name: ppo-lag, options: {{hidden_sizes: [16], policy_steps: 2, critic_steps: 2}}}}]
methods: [linear]
seeds: {trials}
run: {{num_envs: 4, rollout_steps: 10, total_steps: 40, evaluation_episodes: 4}}
"""


def car_trial(updates: int) -> TrialSpec:
    """A trial of CarGoal2 as long as so many updates."""
    return TrialSpec(
        task=Choice("CarGoal2"),
        agent=Choice("ppo-lag", {"hidden_sizes": [256, 256]}),
        method=Choice("dynamic"),
        train_limits=CostLimits((60.0,)),
        deploy_limits=CostLimits((25.0,)),
        train_steps=(updates - 1) * STEPS_PER_UPDATE,
        deploy_steps=STEPS_PER_UPDATE,
        num_envs=16,
        rollout_steps=1000,
        evaluation_episodes=0,
        seed=0,
    )


class Timed:
    """Whatever it stands for, with the CPU time of the calling threads inside its methods."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner
        self.seconds = 0.0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._inner, name)
        if not callable(found):
            return found

        def call(*arguments: Any, **keywords: Any) -> Any:
            before = time.thread_time()
            try:
                return found(*arguments, **keywords)
            finally:
                self.seconds += time.thread_time() - before

        return call


def inline_trial(store: SweepStore, spec: TrialSpec) -> tuple[float, float, float]:
    """CPU seconds of a whole trial, of its writer, and of its teacher."""
    writer, teacher = Timed(store.trial(spec).begin(spec)), Timed(make_teacher(spec.teacher))
    before = time.process_time()
    run_trial(spec, writer, teacher, should_stop=lambda: False)  # type: ignore[arg-type]
    return time.process_time() - before, writer.seconds, teacher.seconds


@contextmanager
def syncing(store: SweepStore) -> Iterator[list[float]]:
    """Sync to MLflow meanwhile, as a launch does; the list then holds the CPU seconds of its process."""
    before, used = children_cpu(), list[float]()
    sync = start_sync(store, tracking_uri(store, None), interval_seconds=SYNC_INTERVAL_SECONDS)
    yield used
    if not sync.stop(timeout=600.0):
        sys.exit("the MLflow sync did not end")
    used.append(children_cpu() - before)


def children_cpu() -> float:
    """CPU seconds of the processes that this one started and waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def family() -> dict[int, list[str]]:
    """This process and each one below it, with the fields of ``/proc/<pid>/stat`` behind its name."""
    fields: dict[int, list[str]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields[int(path.parent.name)] = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
    found = {}
    for pid, values in fields.items():
        above = pid
        while above in fields and above != os.getpid():
            above = int(fields[above][1])
        if above == os.getpid():
            found[pid] = values
    return found


def bench_trial(root: Path, updates: int) -> None:
    torch.set_num_threads(1)
    with syncing(SweepStore(root, "empty")) as of_nothing:
        pass
    store = SweepStore(root, "inline")
    with syncing(store) as of_trial:
        began = time.monotonic()
        trial, files, teacher = inline_trial(store, car_trial(updates))
        clock = time.monotonic() - began
    print(f"CarGoal2, {updates * STEPS_PER_UPDATE:,} steps: {trial:.1f} CPU s in {clock:.1f} s")
    for label, seconds in (
        ("its files, checkpoints and heartbeats", files),
        ("MLflow", of_trial[0] - of_nothing[0]),
        ("its teacher, inline", teacher),
    ):
        print(
            f"  {label:40} {seconds:6.2f} CPU s: {seconds / trial:6.2%} of the trial's, "
            f"{seconds / clock:6.2%} of a core by the clock",
            flush=True,
        )


def bench_many(root: Path, trials: int) -> None:
    (root / "many.yaml").write_text(GRID.format(trials=trials))

    def command(*arguments: str) -> list[tuple[float, str]]:
        """Run it; the seconds after which each of its lines came, and its end as the last."""
        line = [sys.executable, "-u", "-m", "recrl", *arguments]
        began = time.monotonic()
        with subprocess.Popen(line, cwd=root, stdout=subprocess.PIPE, text=True) as process:
            said = [(time.monotonic() - began, text.rstrip()) for text in process.stdout or ()]
        if process.returncode:
            sys.exit(f"{arguments[0]} ended with {process.returncode}")
        return [*said, (time.monotonic() - began, "")]

    def show_wall(label: str, seconds: float) -> None:
        print(f"  {label:40} {seconds:7.1f} s  {1e3 * seconds / trials:7.1f} ms a trial", flush=True)

    show_wall("plan", command("plan", "many.yaml")[-1][0])
    show_wall("launch, with Ray's start and MLflow", command("launch", "many.yaml", "--no-figures")[-1][0])
    store = SweepStore(root / "runs", "many")
    trial_cpu = sum(trial.record().cpu_seconds for trial in store.trials())
    print(f"  ({1e3 * trial_cpu / trials:.0f} CPU ms a trial, {os.cpu_count()} cores)", flush=True)
    show_behind(store)
    show_wall("sync what was left", command("sync", "many")[-1][0])
    show_wall("status", command("status", "many")[-1][0])
    said = command("launch", "many.yaml", "--no-figures")
    show_wall("launch again, nothing to do", said[-1][0])
    for seconds, text in said[:-1]:
        print(f"    {seconds:6.1f} s  {text[:80]}", flush=True)


def show_behind(store: SweepStore) -> None:
    """How many trials MLflow does not show yet."""
    shown = len(list(store.sync_folder.glob("*/trial-*.json")))
    print(f"  ({len(store.trials()) - shown} trials not in MLflow yet)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--updates", type=int, default=30, help="of the trial of CarGoal2; 0 to leave it out")
    parser.add_argument("--trials", type=int, default=2000, help="of some milliseconds; 0 to leave them out")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.updates:
            bench_trial(Path(folder), arguments.updates)
        if arguments.trials:
            bench_many(Path(folder), arguments.trials)


if __name__ == "__main__":
    main()
