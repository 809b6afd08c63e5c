"""What running trials on Ray costs: a question to the teacher service, and a whole sweep's time by part.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_orchestration.py [--cores 2] [--trials 24] [--updates 150]

Wall times mean something on a quiet machine only. The aim for a sweep: the trials' own CPU time is at least
0.8 of wall time x cores, Ray's start counted.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import ray

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.ray.clusters import local_cluster
from recrl.orchestrator.ray.ray_executor import RayExecutor
from recrl.orchestrator.ray.teacher_service import RayTeacher, find_teacher_service, start_teacher_service
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, Teacher, TeacherSpec

QUESTIONS = 1000
EPISODES = 30  # finished in an update, as in safety-starter-agents
SERVICE = "bench"


def teacher_spec() -> TeacherSpec:
    return TeacherSpec("dynamic", {}, CostLimits((65.0,)), CostLimits((5.0,)), train_steps=30_000 * QUESTIONS)


def question_seconds(teacher: Teacher) -> list[float]:
    """Wall seconds of each of the questions of a long trial."""
    generator = np.random.default_rng(0)
    seconds = []
    _, state = teacher.start()
    for update in range(1, QUESTIONS + 1):
        episodes = tuple(
            EpisodeStats(
                index=EPISODES * (update - 1) + episode,
                phase=Phase.TRAINING,
                end_step=30_000 * update,
                length=1000,
                episode_return=float(generator.normal(10.0)),
                costs=(float(generator.gamma(5.0)),),
                limits=CostLimits((65.0,)),
                noise=0.0,
            )
            for episode in range(EPISODES)
        )
        report = ProgressReport(update=update, env_steps=30_000 * update, episodes=episodes)
        before = time.perf_counter()
        _, state = teacher.step(state, report)
        seconds.append(time.perf_counter() - before)
    return seconds


@ray.remote
def question_seconds_of_a_worker() -> list[float]:
    return question_seconds(RayTeacher(teacher_spec(), find_teacher_service(SERVICE)))


def show_questions(label: str, seconds: Sequence[float]) -> None:
    p50, p99, worst = np.quantile(seconds, [0.5, 0.99, 1.0]) * 1e3
    print(f"{label:44} {p50:9.2f} {p99:9.2f} {worst:9.2f}")


def bench_questions() -> None:
    print(f"{'a question with ' + str(EPISODES) + ' episodes, ms':44} {'p50':>9} {'p99':>9} {'max':>9}")
    show_questions("inline", question_seconds(make_teacher(teacher_spec())))
    with local_cluster(num_cpus=2):
        service = start_teacher_service(SERVICE)
        show_questions("driver to service", question_seconds(RayTeacher(teacher_spec(), service)))
        for workers in (1, 2):
            answers = ray.get([question_seconds_of_a_worker.remote() for _ in range(workers)])
            show_questions(
                f"{workers} worker(s) to service, without pause", list(chain.from_iterable(answers))
            )


def bench_sweep(*, cores: int, trials: int, updates: int) -> None:
    spec = TrialSpec(
        task=Choice("two-state", {"horizon": 10}),
        agent=Choice("ppo-lag", {}),
        method=Choice("linear"),
        train_limits=CostLimits((9.0,)),
        deploy_limits=CostLimits((3.0,)),
        train_steps=updates * 480,
        deploy_steps=480,
        num_envs=16,
        rollout_steps=30,
        evaluation_episodes=100,
        seed=0,
    )
    specs = [replace(spec, seed=seed) for seed in range(trials)]
    with tempfile.TemporaryDirectory() as folder:
        store = SweepStore(Path(folder), "bench")
        started = time.time()
        with local_cluster(num_cpus=cores):
            RayExecutor().run(specs, SweepPlace(store), threading.Event())
        ended = time.time()
        records = [store.trial(spec).record() for spec in specs]
    wall = ended - started
    cpu = [record.cpu_seconds for record in records]
    lanes: dict[int, list[tuple[float, float]]] = {}
    for record in records:
        lanes.setdefault(record.pid, []).append((record.started_at, record.heartbeat))
    gaps = [after[0] - before[1] for lane in lanes.values() for before, after in pairwise(sorted(lane))]
    first = min(record.started_at for record in records)
    last = max(record.heartbeat for record in records)
    idle_at_end = sum(last - max(end for _, end in lane) for lane in lanes.values())
    print(f"\n{trials} trials of {updates + 1} updates on {cores} cores, in {len(lanes)} worker processes")
    for label, seconds in (
        ("wall", wall),
        ("until the first trial begins (Ray, torch)", first - started),
        ("between two trials of a worker, median", statistics.median(gaps)),
        ("workers without a trial at the end, together", idle_at_end),
        ("after the last trial (Ray's end)", ended - last),
        ("CPU of a trial, mean", statistics.mean(cpu)),
        ("wall of a trial, mean", statistics.mean(r.heartbeat - r.started_at for r in records)),
    ):
        print(f"{label:44} {seconds:9.2f} s")
    print(f"{'CPU of all trials / (wall x cores)':44} {sum(cpu) / (wall * cores):9.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--trials", type=int, default=24, help="more than cores")
    parser.add_argument("--updates", type=int, default=150)
    arguments = parser.parse_args()
    bench_questions()
    bench_sweep(cores=arguments.cores, trials=arguments.trials, updates=arguments.updates)


if __name__ == "__main__":
    main()
