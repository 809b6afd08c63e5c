"""What each of Ray's processes uses: with nothing to do but one idle actor, and beside a trial.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_ray_processes [--seconds 30]

CPU time by process, in per cent of one core, from the kernel's schedule statistics; a trial of CarGoal2 runs
in the second part. What is there without a trial is the floor: no documented setting of Ray 2.60 takes it
away. It is there once on a machine, however many trials run beside it.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from recrl.orchestrator.ray_executor import RayExecutor, local_cluster
from recrl.orchestrator.store import SweepStore
from recrl.orchestrator.teacher_service import start_teacher_service
from tests.benchmarks.bench_memory import name_of
from tests.benchmarks.bench_overhead import car_trial, family

SETTLING_SECONDS = 10.0


def used() -> dict[int, tuple[str, float]]:
    """What each process of ours is, and its CPU seconds, over all of its threads."""
    found = {}
    for pid in family():
        seconds = 0.0
        for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            try:
                seconds += int(path.read_text().split()[0]) / 1e9
            except OSError:
                continue
        found[pid] = (name_of(pid) or "Ray: others", seconds)
    return found


def show_shares(title: str, seconds: float) -> None:
    """Watch for a while, and say what was used."""
    before, began = used(), time.monotonic()
    time.sleep(seconds)
    after, took = used(), time.monotonic() - began
    shares: dict[str, float] = {}
    for pid, (name, total) in after.items():
        shares[name] = shares.get(name, 0.0) + (total - before.get(pid, ("", 0.0))[1]) / took
    around = sum(share for name, share in shares.items() if name != "worker")
    print(f"{title}, {took:.0f} s: all but the worker {around:.2%} of a core", flush=True)
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        print(f"  {name:24} {share:7.2%}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="to watch, in each part")
    seconds = parser.parse_args(argv).seconds
    with local_cluster(num_cpus=1):
        service = start_teacher_service("idle")
        time.sleep(SETTLING_SECONDS)
        show_shares("Ray and an idle actor", seconds)
        del service
        with tempfile.TemporaryDirectory() as folder:
            store, spec, stop = SweepStore(Path(folder), "beside"), car_trial(10_000), threading.Event()

            def watch() -> None:
                while store.trial(spec).record().update < 1:
                    time.sleep(1.0)
                time.sleep(SETTLING_SECONDS)
                show_shares("beside a trial", seconds)
                stop.set()

            watching = threading.Thread(target=watch)
            watching.start()
            RayExecutor(num_cpus=1).run([spec], store, stop)
            watching.join()


if __name__ == "__main__":
    main()
