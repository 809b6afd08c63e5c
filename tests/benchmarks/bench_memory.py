"""Memory over a long trial: of the worker, the driver, the teacher service and the MLflow sync.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_memory [--task river-grid] [--updates 3000]

One trial on Ray with the teacher service and the MLflow sync, as a launch has them. The resident memory of
every process is read once a second. Its median in the tenth of the time behind the warm-up (the first
fifth) is held against that in the last tenth. On a machine that others use the trial takes longer; its memory
is the same.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.ray.clusters import local_cluster
from recrl.orchestrator.ray.ray_executor import RayExecutor
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.tracking.background_sync import start_sync
from recrl.orchestrator.tracking.client import tracking_uri
from tests.benchmarks.bench_overhead import car_trial, family

LOOK_SECONDS = 1.0
NAMES = {  # by what the command line has in it, the first that fits
    "ray::TeacherService": "teacher service",
    "ray::IDLE": "",
    "ray::DashboardAgent": "",
    "ray::RuntimeEnvAgent": "",
    "ray::": "worker",
    "background_sync": "MLflow sync",
    "gcs_server": "Ray: gcs_server",
    "raylet/raylet": "Ray: raylet",
    "log_monitor.py": "Ray: log monitor",
}


def river_trial(updates: int) -> TrialSpec:
    """A trial of RiverGrid as long as so many updates of 1,000 steps; light ones, as they are many."""
    steps = 1000
    return TrialSpec(
        task=Choice("rivergrid-1a"),
        agent=Choice("ppo-lag", {"hidden_sizes": [16], "policy_steps": 2, "critic_steps": 2}),
        method=Choice("dynamic"),
        train_limits=CostLimits((65.0,)),
        deploy_limits=CostLimits((5.0,)),
        train_steps=updates * steps * 19 // 20,
        deploy_steps=updates * steps // 20,
        num_envs=20,
        rollout_steps=steps // 20,
        evaluation_episodes=0,
        seed=0,
    )


TRIALS = {"river-grid": river_trial, "CarGoal2": car_trial}


def name_of(pid: int) -> str:
    """What a process does, or nothing if it is none of those that are looked at."""
    if pid == os.getpid():
        return "driver"
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""
    return next((name for sign, name in NAMES.items() if sign in command), "")


def resident_megabytes(pid: int) -> float:
    """The memory that a process holds of its own and shares, in MB; 0 if it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass
class MemoryWatch:
    """Reads the memory of this process and all below it, once a second, until the end of the context.

    Attributes:
        seen: seconds since the beginning and MB, for each process by what it does.
    """

    seen: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    def __enter__(self) -> MemoryWatch:
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        began = time.monotonic()
        while not self._over.wait(LOOK_SECONDS):
            for pid in family():
                if name := name_of(pid):
                    self.seen.setdefault(name, []).append((time.monotonic() - began, resident_megabytes(pid)))


def medians(looks: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """MB behind the warm-up, in the middle and at the end."""
    begin, end = looks[0][0], looks[-1][0]

    def median(share: float) -> float:
        of = [size for when, size in looks if share <= (when - begin) / (end - begin) <= share + 0.1]
        return statistics.median(of)

    return median(0.2), median(0.5), median(0.9)


def bench(spec: TrialSpec, root: Path) -> None:
    """Run a trial and say what its processes held."""
    store = SweepStore(root, "memory")
    sync = start_sync(store, tracking_uri(store, None), interval_seconds=5.0)
    with local_cluster(num_cpus=1), MemoryWatch() as watch:
        RayExecutor().run([spec], SweepPlace(store), threading.Event())
    synced = sync.stop(timeout=600.0)
    record = store.trial(spec).record()
    episodes = len(store.trial(spec).episodes())
    seconds = max(looks[-1][0] for looks in watch.seen.values())
    print(
        f"{spec.title}: {record.status}, {record.env_steps:,} steps, {record.update:,} updates, "
        f"{episodes:,} episodes, {record.cpu_seconds:.0f} CPU s in {seconds:.0f} s; "
        f"MLflow up to date: {synced}"
    )
    print(f"  {'MB':20} {'at 20-30%':>10} {'at 50-60%':>10} {'at 90-100%':>10} {'growth':>8}")
    for name, looks in sorted(watch.seen.items()):
        if len(looks) >= 30:
            first, middle, last = medians(looks)
            print(f"  {name:20} {first:10.1f} {middle:10.1f} {last:10.1f} {last / first - 1.0:8.1%}")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--task", choices=sorted(TRIALS), default="river-grid")
    parser.add_argument("--updates", type=int, default=3000)
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        bench(TRIALS[arguments.task](arguments.updates), Path(folder))


if __name__ == "__main__":
    main()
