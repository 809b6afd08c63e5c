"""What Ray, the driver and the teacher service use beside trials of CarGoal2.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_ray_processes [--seconds 30] [--trials 2]

CPU time from the kernel's schedule statistics, in per cent of one core. First the cluster has one idle actor,
the teacher service; then trials run on it, a core each, with their teacher in that service.

A worker's main thread is its trial; its other threads are Ray's, but for the heartbeat, and count as such.
What is around a trial is there once on a machine, however many trials run beside each other. It goes by the
clock: where others take the cores from the trials, its share of their CPU time looks larger than it is, so
the share is also given for trials that have a core each.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.ray.clusters import local_cluster
from recrl.orchestrator.ray.process_state import environment
from recrl.orchestrator.ray.ray_executor import RayExecutor
from recrl.orchestrator.ray.teacher_service import start_teacher_service
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace
from tests.benchmarks.bench_memory import name_of
from tests.benchmarks.bench_overhead import car_trial, family

SETTLING_SECONDS = 8.0
OTHERS = "Ray: others"
TRIALS = "trials"
NICENESS = {"RAY_worker_niceness": "0"}  # of trials: on a busy machine they would get no core at Ray's 15


def used() -> dict[tuple[int, int], tuple[str, float]]:
    """What each thread of each process of ours belongs to, and its CPU seconds."""
    found = {}
    for pid in family():
        name = name_of(pid) or OTHERS
        for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            thread = int(path.parent.name)
            try:
                seconds = int(path.read_text().split()[0]) / 1e9
            except OSError:
                continue
            trial = TRIALS if thread == pid else "workers' other threads"
            found[pid, thread] = (trial if name == "worker" else name, seconds)
    return found


def show_shares(title: str, seconds: float, cores: int = 0) -> None:
    """Watch for a while, and say what was used; in relation to so many trials with a core each."""
    before, began = used(), time.monotonic()
    time.sleep(seconds)
    after, took = used(), time.monotonic() - began
    shares: dict[str, float] = {}
    for key, (name, total) in after.items():
        shares[name] = shares.get(name, 0.0) + (total - before.get(key, ("", 0.0))[1]) / took
    trials = shares.pop(TRIALS, 0.0)
    around = sum(shares.values())
    parts = ", ".join(f"{name} {share:.2%}" for name, share in sorted(shares.items(), key=lambda it: -it[1]))
    print(f"{title}, {took:.0f} s: around {around:.2%} of a core ({parts})", flush=True)
    if cores:
        print(
            f"    {around / cores:.2%} of trials with a core each; these had {trials / cores:.0%} of one: "
            f"{around / trials:.2%} of that",
            flush=True,
        )


def watch_trials(specs: Sequence[TrialSpec], root: Path, title: str, seconds: float) -> None:
    """Run trials until they were watched."""
    store, stop = SweepStore(root, "beside"), threading.Event()

    def watch(over: threading.Event) -> None:
        while any(store.trial(spec).record().update < 1 for spec in specs) and not over.wait(1.0):
            pass
        time.sleep(SETTLING_SECONDS)
        show_shares(title, seconds, len(specs))
        stop.set()

    with background_thread(watch, name="watch"):
        RayExecutor().run(specs, SweepPlace(store), stop)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="to watch, each time")
    parser.add_argument(
        "--trials", type=int, default=2, help="beside each other; 0 for the idle clusters only"
    )
    arguments = parser.parse_args(argv)
    specs = [replace(car_trial(10_000), seed=seed) for seed in range(arguments.trials)]
    began = time.monotonic()
    with environment(NICENESS), local_cluster(num_cpus=max(1, len(specs))):
        print(f"started in {time.monotonic() - began:.1f} s", flush=True)
        service = start_teacher_service("idle")
        time.sleep(SETTLING_SECONDS)
        show_shares("an idle actor", arguments.seconds)
        del service
        if specs:
            with tempfile.TemporaryDirectory() as folder:
                title = f"beside {len(specs)} trials"
                watch_trials(specs, Path(folder), title, arguments.seconds)


if __name__ == "__main__":
    main()
