"""Work on many simulations, shared out to threads so that none waits long for another.

MuJoCo's own pool loses some hundredths to a tenth of the time with 16 simulations on two threads: threads
that sleep begin late, and at the end one thread waits for the other's last simulation. Here a thread without
work stays awake for a moment before it sleeps, each begins with its own share of the simulations, the same
each time, and the last few are done in parts, by whoever is free.

All that is compiled, and runs without Python's lock; only a thread that has to be woken needs it. MuJoCo
itself runs the functions, one simulation a call (``mjb_apply``), and so keeps states, counts warnings and
catches errors as it always does.

The calling thread works, too, and is done when all simulations are: a thread that has not woken up by then is
not waited for. So work is also done, if slower, where threads are gone, as after a fork.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.machine_code import (
    CALL,
    array_at,
    compiled,
    compiled_for_python,
    load,
    mjb_apply,
    pause,
    relax,
    swap,
)

AWAKE_SECONDS = 5e-3
"""How long a thread without work stays awake: longer than most policies take to choose the next actions."""
APART = 2
"""The last simulations, this many a thread, are done in parts."""
PARTS = 2
"""So many parts at a time."""

JOB = np.dtype(
    [
        ("function", np.int64),  # its address (``machine_code.compiled_for_batch``)
        ("argument", np.int64),  # an address, which it is given
        ("ids", np.int64),  # address of [number], 32 bits each: which simulations
        ("number", np.int64),
        ("parts", np.int64),  # of which the function's work consists
    ],
    align=True,
)
POOL = np.dtype(
    [
        # Each of these three fills a line of the cache by itself, since threads look at it all the time.
        ("lock", np.int64, (8,)),
        ("jobs", np.int64, (8,)),  # begun so far
        ("unfinished", np.int64, (8,)),  # simulations of this job
        ("simulations", np.int64),  # address of the records
        ("row", np.int64),  # numbers in a state
        ("threads", np.int64),
        ("workers", np.int64),  # address of [threads] WORKERs
        ("patience", np.int64),  # looks at ``jobs`` before a thread sleeps
        ("stopping", np.int64),
        ("job", JOB),
        ("untouched", np.int64),  # simulations of this job that nobody has begun
    ],
    align=True,
)
SIMULATION = np.dtype(
    [
        ("batch", np.int64),  # mjBatch of one simulation
        ("state", np.int64),  # address of its row
        ("row", np.int64),  # address of that which Python sees
        ("call", CALL),
        ("busy", np.int64),
        ("failed", np.int64),  # whether MuJoCo raised an error in this job
        ("room", np.int64, (7,)),  # two lines of the cache
    ],
    align=True,
)
_WORKER = np.dtype([("asleep", np.int64), ("seen", np.int64), ("room", np.int64, (6,))], align=True)
_LOCK, _JOBS = int(POOL.fields["lock"][1]), int(POOL.fields["jobs"][1])  # type: ignore[index]
_UNFINISHED = int(POOL.fields["unfinished"][1])  # type: ignore[index]
_STOPPING = int(POOL.fields["stopping"][1])  # type: ignore[index]
_CALL = int(SIMULATION.fields["call"][1])  # type: ignore[index]
_SIZE, _WORKER_SIZE = SIMULATION.itemsize, _WORKER.itemsize

_pools = array_at(POOL)
_jobs = array_at(JOB)
_simulations = array_at(SIMULATION)
_workers = array_at(_WORKER)
_doubles = array_at(np.float64)
_ids = array_at(np.int32)
_MANY = 1 << 31
_LINE = 64


@compiled
def acquire(address: int) -> None:
    """Wait until nobody else has the pool's lock, and take it."""
    while swap(address + _LOCK, 1) != 0:
        relax(50)


@compiled
def release(address: int) -> None:
    """Give the pool's lock back."""
    swap(address + _LOCK, 0)


@compiled
def choose(pool: Any, one_at: Any, rank: int, mine: int) -> int:
    """The place among the job's ids of what this thread does next, -1 for nothing; the lock is held.

    While there are many that nobody has touched: the next of the thread's own share, else the last of the
    share before it. Then: the one with the most parts left, but rather the one the thread has just worked on,
    and of equals the first from the thread's own share onwards.

    Args:
        pool: the ``POOL``.
        one_at: all ``SIMULATION``s.
        rank: the thread's, 0 to threads - 1.
        mine: the place of what it has just worked on, or -1.
    """
    number: int = pool.job.number
    ids, parts, threads = _ids(pool.job.ids, number), pool.job.parts, pool.threads
    begins: int = rank * number // threads
    ends: int = (rank + 1) * number // threads
    if pool.untouched > APART * threads:
        for place in range(begins, ends):
            if one_at[ids[place]].call.last == 0:
                return place
        for step in range(1, number + 1):
            place = (begins - step) % number
            if one_at[ids[place]].call.last == 0:
                return place
    best: int = -1
    most: int = 0
    for step in range(number):
        place = (begins + step) % number
        one = one_at[ids[place]]
        left = parts - one.call.last
        if one.busy == 0 and left > most:
            best, most = place, left
    if mine >= 0 and parts - one_at[ids[mine]].call.last > max(0, most - PARTS - 1):
        return mine
    return best


@compiled
def take(address: int, rank: int, mine: int) -> int:
    """Hand in what this thread has done, and take something to do: its place, or -1 for nothing."""
    pool = _pools(address, 1)[0]
    acquire(address)
    one_at, ids = _simulations(pool.simulations, _MANY), _ids(pool.job.ids, pool.job.number)
    if mine >= 0:
        done = one_at[ids[mine]]
        done.busy = 0
        if done.call.last == pool.job.parts:
            swap(address + _UNFINISHED, load(address + _UNFINISHED) - 1)
    place = -1
    if load(address + _UNFINISHED) > 0:
        whole = pool.untouched > APART * pool.threads
        place = choose(pool, one_at, rank, mine)
        if place >= 0:
            one = one_at[ids[place]]
            if one.call.last == 0:
                pool.untouched -= 1
            one.call.first = one.call.last
            one.call.last = pool.job.parts if whole else min(pool.job.parts, one.call.first + PARTS)
            one.busy = 1
    release(address)
    return place


@compiled
def run(pool: Any, index: int) -> None:
    """Do the parts of the job on one simulation that its ``CALL`` says."""
    at = pool.simulations + _SIZE * index
    one = _simulations(at, 1)[0]
    row, state = _doubles(one.row, pool.row), _doubles(one.state, pool.row)
    if one.call.first == 0:
        for place in range(pool.row):
            state[place] = row[place]
    if mjb_apply(one.batch, 0, 1, pool.job.function, at + _CALL, 1) != 0:
        one.failed = 1
        one.call.last = pool.job.parts  # the row stays as it was
    elif one.call.last == pool.job.parts:
        for place in range(pool.row):
            row[place] = state[place]


@compiled
def work(address: int, rank: int, patience: int) -> None:
    """Work until all simulations of the job are done, or for so many moments nobody needed help."""
    pool = _pools(address, 1)[0]
    place, waited, moments = -1, 0, 10
    while True:
        place = take(address, rank, place)
        if place >= 0:
            run(pool, _ids(pool.job.ids, pool.job.number)[place])
            waited, moments = 0, 10
            continue
        if load(address + _UNFINISHED) == 0 or waited > patience:
            return
        relax(moments)
        waited += moments
        moments = min(2 * moments, 200)


@compiled
def complete(address: int) -> None:
    """Work until the job is done, if there is one."""
    while load(address + _UNFINISHED) > 0:
        work(address, 0, _MANY)


@compiled
def set_job(address: int, job: int) -> None:
    """Write down what is to be done; the lock is held or nobody else is there."""
    pool, wanted = _pools(address, 1)[0], _jobs(job, 1)[0]
    pool.job.function, pool.job.argument = wanted.function, wanted.argument
    pool.job.ids, pool.job.number, pool.job.parts = wanted.ids, wanted.number, wanted.parts
    pool.untouched = wanted.number
    one_at = _simulations(pool.simulations, _MANY)
    for index in _ids(wanted.ids, wanted.number):
        one = one_at[index]
        one.busy = one.failed = 0
        one.call.index, one.call.argument = index, wanted.argument
        one.call.first = one.call.last = 0


@compiled_for_python
def do_alone(address: int, job: int) -> bool:
    """Do a ``JOB`` on the calling thread; False if MuJoCo raised an error."""
    complete(address)
    set_job(address, job)
    pool = _pools(address, 1)[0]
    one_at = _simulations(pool.simulations, _MANY)
    well = True
    for index in _ids(pool.job.ids, pool.job.number):
        one_at[index].call.last = pool.job.parts
        run(pool, index)
        well = well and one_at[index].failed == 0
    return well


@compiled_for_python
def begin(address: int, job: int) -> bool:
    """Let all threads that are awake begin a ``JOB``; True if some sleep."""
    complete(address)
    acquire(address)
    set_job(address, job)
    pool = _pools(address, 1)[0]
    swap(address + _UNFINISHED, pool.job.number)
    release(address)
    swap(address + _JOBS, load(address + _JOBS) + 1)
    for rank in range(1, pool.threads):  # noqa: SIM110  # not for Numba
        if load(pool.workers + _WORKER_SIZE * rank) != 0:
            return True
    return False


@compiled_for_python
def finish(address: int) -> bool:
    """Work until the job is done; False if MuJoCo raised an error."""
    complete(address)
    pool = _pools(address, 1)[0]
    one_at = _simulations(pool.simulations, _MANY)
    for index in _ids(pool.job.ids, pool.job.number):  # noqa: SIM110  # not for Numba
        if one_at[index].failed != 0:
            return False
    return True


@compiled_for_python
def serve(address: int, rank: int) -> bool:
    """Work on all jobs that come while this thread is awake; False to end it, True to let it sleep."""
    pool = _pools(address, 1)[0]
    asleep = pool.workers + _WORKER_SIZE * rank
    worker = _workers(asleep, 1)[0]
    swap(asleep, 0)
    while load(address + _STOPPING) == 0:
        looked = 0
        while load(address + _JOBS) == worker.seen:
            if looked >= pool.patience:
                swap(asleep, 1)
                # A job may have begun before its caller could know of this.
                if load(address + _JOBS) == worker.seen:
                    return True
                swap(asleep, 0)
            looked += 1
            pause()
        worker.seen = load(address + _JOBS)
        work(address, rank, pool.patience)
    return False


@compiled_for_python
def look_around(address: int, times: int) -> bool:
    """Look for a job so many times, as a thread without work does."""
    for _ in range(times):
        if load(address + _JOBS) < 0:
            return False
        pause()
    return True


class ThreadPool:
    """Threads that work on simulations together, for one caller at a time.

    Args:
        simulations: records ``SIMULATION`` of all, [B], filled but for their calls; kept.
        row: numbers in a state.
        num_threads: how many, the caller's included.
    """

    def __init__(self, simulations: npt.NDArray[Any], row: int, num_threads: int) -> None:
        self._simulations = simulations
        self._pool, self._workers = in_cache_lines(1, POOL), in_cache_lines(num_threads, _WORKER)
        self._address = int(self._pool.ctypes.data)
        self._pool["simulations"], self._pool["row"] = simulations.ctypes.data, row
        self._pool["threads"], self._pool["workers"] = num_threads, self._workers.ctypes.data
        self._job = np.zeros(1, JOB)
        self._job_address = int(self._job.ctypes.data)
        self._ids: object = None
        self._process = os.getpid()
        self._wakes = [_asleep() for _ in range(1, num_threads)]
        self._stop = weakref.finalize(self, _stop, self._pool, self._wakes)
        if num_threads > 1:
            self._pool["patience"] = _patience(self._address, num_threads)
        memory = (self._pool, self._workers, self._simulations)
        self._threads = [
            threading.Thread(target=_serve, args=(self._address, rank, wake, memory), daemon=True)
            for rank, wake in enumerate(self._wakes, start=1)
        ]
        for thread in self._threads:
            thread.start()

    def run(self, function: int, argument: int, ids: npt.NDArray[np.int32], parts: int) -> bool:
        """Run a compiled function on simulations.

        Args:
            function: its address (``machine_code.compiled_for_batch``).
            argument: an address, which it is given.
            ids: which simulations, each once.
            parts: of which the function's work consists, at least 1. It may be called for some of them at a
                time, in their order. Work of one part is not worth a thread.

        Returns:
            False if MuJoCo raised an error in one of them.
        """
        if self._process != os.getpid():
            self._forget_threads()
        self._ids = ids
        self._job[0] = function, argument, ids.ctypes.data, len(ids), parts
        if not self._wakes or parts == 1 or len(ids) == 1:
            return do_alone(self._address, self._job_address)
        try:
            if begin(self._address, self._job_address):
                for wake, worker in zip(self._wakes, self._workers[1:], strict=True):
                    if worker["asleep"]:
                        _wake(wake)
        finally:  # an interrupted job is done nevertheless: nobody is left in the middle of a step
            went_well = finish(self._address)
        return went_well

    def close(self) -> None:
        """End the threads; what is to be done later, the caller does alone."""
        self._stop()
        for thread in self._threads:
            thread.join()
        self._threads, self._wakes = [], []

    def _forget_threads(self) -> None:
        """In a forked process there are none, and what they held at that moment is held for ever."""
        self._stop.detach()
        self._threads, self._wakes = [], []
        self._pool["lock"], self._pool["unfinished"] = 0, 0
        self._process = os.getpid()


def in_cache_lines(number: int, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """Records of zeros, the first at the beginning of a line of the cache."""
    memory = np.zeros(number * kind.itemsize + _LINE, np.uint8)
    start = -int(memory.ctypes.data) % _LINE
    return memory[start : start + number * kind.itemsize].view(kind)


def num_processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _serve(address: int, rank: int, wake: threading.Lock, _memory: object) -> None:
    while serve(address, rank):
        wake.acquire()


def _stop(pool: npt.NDArray[Any], wakes: list[threading.Lock]) -> None:
    """Let the threads end; they own the memory that they look at, so nobody need wait for them."""
    pool["stopping"] = 1
    pool["jobs"][:, 0] += 1
    for wake in wakes:
        _wake(wake)


def _asleep() -> threading.Lock:
    """A lock that a thread without work waits for: unlike Python's semaphores no signal can break it."""
    lock = threading.Lock()
    lock.acquire()
    return lock


def _wake(wake: threading.Lock) -> None:
    with contextlib.suppress(RuntimeError):  # it is awake already
        wake.release()


def _patience(address: int, num_threads: int) -> int:
    """How many times a thread looks for a job before it sleeps; not at all where threads lack processors."""
    if num_threads > num_processors():
        return 0
    times, shortest = 2_000, np.inf
    for _ in range(5):
        start = time.perf_counter()
        look_around(address, times)
        shortest = min(shortest, time.perf_counter() - start)
    return int(times * AWAKE_SECONDS / shortest)
