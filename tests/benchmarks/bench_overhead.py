"""What everything around learning costs: files, MLflow, the teacher and Ray, beside a trial's own CPU time.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_overhead.py [--updates 30] [--trials 2000]

First one trial of CarGoal2 (``ppo-lag``, 256x256, 16 environments). Its files: the CPU time of its thread
inside the writer, heartbeats included. Its row in MLflow: the mirror's process over the finished trial, less
that over an empty sweep. Ray and the teacher service: what the cluster's processes use beside the trial, as
the growth from a short trial to a long one, because starting is paid once a sweep. CPU seconds throughout, so
a busy machine matters little. The aim: files and MLflow at most 2% of the trial, Ray and the teacher 2%.

Then the whole command over many trials of some milliseconds: wall seconds, on a quiet machine only.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.ray_executor import RayExecutor, local_cluster
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.store import SweepStore
from recrl.orchestrator.tracking import tracking_uri
from recrl.orchestrator.tracking_mirror import start_mirror
from recrl.orchestrator.trial import run_trial
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


def mirror_cpu(store: SweepStore) -> float:
    """CPU seconds of the mirror's process over a sweep as it is."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    if not start_mirror(store, tracking_uri(store, None), interval_seconds=3600.0).stop(timeout=600.0):
        sys.exit("the mirror did not come to its end")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


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


def family_cpu() -> dict[int, float]:
    """CPU seconds of this process and of each one below it, by process."""
    ticks = os.sysconf("SC_CLK_TCK")
    return {pid: sum(map(int, values[11:13])) / ticks for pid, values in family().items()}


class FamilyWatch(threading.Thread):
    """Looks often, as Ray lets its processes end without anybody asking what they used."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._over = threading.Event()
        self._before = family_cpu()
        self._seen: dict[int, float] = {}
        self._own = 0.0

    def run(self) -> None:
        """Look until told to end."""
        while not self._over.wait(0.2):
            self._seen |= family_cpu()
        self._own = time.thread_time()

    def end(self) -> float:
        """CPU seconds of all processes since the beginning, less those of the looking."""
        self._over.set()
        self.join()
        self._seen |= family_cpu()
        used = sum(seconds - self._before.get(pid, 0.0) for pid, seconds in self._seen.items())
        return used - self._own


def around_on_ray(root: Path, updates: int) -> tuple[float, float]:
    """CPU seconds of a trial on Ray, and of everything else meanwhile."""
    spec = car_trial(updates)
    store = SweepStore(root, f"ray-{updates}")
    watch = FamilyWatch()
    watch.start()
    RayExecutor(num_cpus=1).run([spec], store, threading.Event())
    everything = watch.end()
    trial = store.trial(spec).record().cpu_seconds
    return trial, everything - trial


def bench_trial(root: Path, updates: int) -> None:
    torch.set_num_threads(1)
    store, empty = SweepStore(root, "inline"), SweepStore(root, "empty")
    trial, files, teacher = inline_trial(store, car_trial(updates))
    mirrored = mirror_cpu(store) - mirror_cpu(empty)
    print(f"CarGoal2, {updates * STEPS_PER_UPDATE:,} steps: {trial:.1f} CPU s")
    show("its files, checkpoints and heartbeats", files / trial)
    show("its points in MLflow", mirrored / trial)
    show("its teacher, inline", teacher / trial)
    with local_cluster(num_cpus=1):
        around_on_ray(root, 2)  # the first one also starts what all of them use
        short, around_short = around_on_ray(root, max(3, updates // 10))
        long, around_long = around_on_ray(root, updates)
    show("Ray and the teacher service", (around_long - around_short) / (long - short))


def show(label: str, share: float) -> None:
    print(f"  {label:40} {share:7.2%}", flush=True)


def wall(work: Callable[[], object]) -> float:
    before = time.monotonic()
    work()
    return time.monotonic() - before


def bench_many(root: Path, trials: int) -> None:
    (root / "many.yaml").write_text(GRID.format(trials=trials))

    def command(*arguments: str) -> float:
        line = [sys.executable, "-m", "recrl.orchestrator.cli", *arguments]
        return wall(lambda: subprocess.run(line, cwd=root, check=True, stdout=subprocess.DEVNULL))

    planned = command("plan", "many.yaml")
    launched = command("launch", "many.yaml", "--no-figures")
    store = SweepStore(root / "runs", "many")
    trial_cpu = sum(trial.record().cpu_seconds for trial in store.trials())
    print(f"{trials} trials of {1e3 * trial_cpu / trials:.0f} CPU ms, on {os.cpu_count()} cores")
    for label, seconds in (
        ("plan", planned),
        ("launch, with Ray's start and MLflow", launched),
        ("status", command("status", "many")),
        ("launch again, nothing to do", command("launch", "many.yaml", "--no-figures")),
    ):
        print(f"  {label:40} {seconds:7.1f} s  {1e3 * seconds / trials:7.1f} ms a trial")


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
