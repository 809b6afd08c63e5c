"""Work on many simulations, shared out to threads so that none waits long for another.

MuJoCo's own pool loses some hundredths to a tenth of the time with 16 simulations on two threads: threads
that sleep begin late, and at the end one thread waits for the other's last simulation. Here a thread without
work stays awake for a moment before it sleeps, and each begins with its own share of the simulations, the
same each time. The last of each share are left to the end: who is done with all others first does them in
parts, in turns, until everybody is there. Then there is one for each thread, of each about as much is left,
and each is done to its end. (With fewer simulations than threads some have none.)

All that is compiled, and runs without Python's lock; only a thread that has to be woken needs it. MuJoCo
itself runs the functions, one simulation a call (``mjb_apply``), and so keeps states, counts warnings and
catches errors as it always does.

The calling thread works, too, and is done when all simulations are: a thread that has not woken up by then is
not waited for. So work is also done, if slower, where threads are gone, as after a fork.

What one thread has written another's core has to fetch, which takes it as long as hundreds of its own
operations. So threads share few lines of the cache: each takes simulations of its share without a word to the
others, says how many it has done when it comes to the last ones, and writes its results where others seldom
look. Single lines are shared where the shares meet.
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
    add,
    array_at,
    compiled,
    compiled_for_python,
    load,
    mjb_apply,
    pause,
    replace,
    step_aside,
    swap,
)

AWAKE_SECONDS = 5e-3
"""How long a thread without work stays awake: longer than most policies take to choose the next actions."""
APART = 1
"""The last simulations of a share, this many, are done in parts."""
PARTS = 2
"""So many parts at a time, until all threads are there."""
MOMENTS = 20
"""Between two looks for something to do; one takes some hundredths of a microsecond."""
ALONE_FOR = 400
"""Moments for which a thread without work keeps its processor, where there is one for each."""

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
        ("room", np.int64, (8,)),
        ("arrived", np.int64),  # threads that have only parts left to do, or that had and gave up waiting
        ("failures", np.int64),  # whether MuJoCo raised an error in this job
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
        ("failed", np.int64),  # whether MuJoCo raised an error when it was last worked on
        ("room", np.int64, (7,)),  # two lines of the cache
    ],
    align=True,
)
_WORKER = np.dtype(
    [
        ("asleep", np.int64),
        ("seen", np.int64),
        ("room", np.int64, (6,)),
        # The job, _PLACES times, plus how many of its share are to be begun that are not done in parts.
        ("whole", np.int64, (8,)),
    ],
    align=True,
)
_LOCK, _JOBS = int(POOL.fields["lock"][1]), int(POOL.fields["jobs"][1])  # type: ignore[index]
_UNFINISHED = int(POOL.fields["unfinished"][1])  # type: ignore[index]
_STOPPING = int(POOL.fields["stopping"][1])  # type: ignore[index]
_CALL = int(SIMULATION.fields["call"][1])  # type: ignore[index]
_WHOLE = int(_WORKER.fields["whole"][1])  # type: ignore[index]
_SIZE, _WORKER_SIZE = SIMULATION.itemsize, _WORKER.itemsize

_pools = array_at(POOL)
_jobs = array_at(JOB)
_simulations = array_at(SIMULATION)
_workers = array_at(_WORKER)
_doubles = array_at(np.float64)
_ids = array_at(np.int32)
_MANY = 1 << 31
_PLACES = 1 << 24
_ARRIVES = -2
_NOTHING = (0, 0, 0)
_LINE = 64


@compiled
def acquire(address: int) -> None:
    """Wait until nobody else has the pool's lock, and take it."""
    while swap(address + _LOCK, 1) != 0:
        for _ in range(MOMENTS):
            pause()
        step_aside()


@compiled
def release(address: int) -> None:
    """Give the pool's lock back."""
    swap(address + _LOCK, 0)


@compiled
def share(pool: Any, rank: int) -> tuple[int, int, int]:
    """Of a thread's share of the job's ids the first place, the first that is done in parts, and the end."""
    begins: int = rank * pool.job.number // pool.threads
    ends: int = (rank + 1) * pool.job.number // pool.threads
    return begins, max(begins, ends - APART), ends


@compiled
def claim(pool: Any, job: int, rank: int) -> int:
    """Take the next of a thread's share that is not done in parts: its place, -1 if there is none.

    While it is not done, the job is not, and what the pool says of it remains.

    Args:
        pool: the ``POOL``.
        job: its number; nothing is taken of another.
        rank: whose share it is.
    """
    whole = pool.workers + _WORKER_SIZE * rank + _WHOLE
    while True:
        found = load(whole)
        left = found % _PLACES
        if left == 0 or found // _PLACES != job:
            return -1
        if replace(whole, found, found - 1):
            place: int = share(pool, rank)[1] - left
            return place


@compiled
def choose(pool: Any, one_at: Any, rank: int) -> int:
    """Of what is done in parts the place of what this thread does next, -1 for nothing; the lock is held.

    The one with the most parts left, of equals the first from the thread's own share onwards.

    Args:
        pool: the ``POOL``.
        one_at: all ``SIMULATION``s.
        rank: the thread's, 0 to threads - 1.
    """
    ids, parts, threads = _ids(pool.job.ids, pool.job.number), pool.job.parts, pool.threads
    best: int = -1
    most: int = 0
    for step in range(threads):
        _, begins, ends = share(pool, (rank + step) % threads)
        for place in range(begins, ends):
            one = one_at[ids[place]]
            rest = parts - one.call.last
            if one.busy == 0 and rest > most:
                best, most = place, rest
    return best


@compiled
def take(address: int, job: int, rank: int, mine: int) -> int:
    """Hand in the parts that this thread has done, and take others to do: the place, or -1 for nothing.

    Args:
        address: of the ``POOL``.
        job: its number; nothing is taken of another.
        rank: the thread's.
        mine: the place of what it has done parts of, -1 for nothing, or ``_ARRIVES``.
    """
    pool = _pools(address, 1)[0]
    acquire(address)
    one_at, ids = _simulations(pool.simulations, _MANY), _ids(pool.job.ids, pool.job.number)
    if mine >= 0:
        done = one_at[ids[mine]]
        done.busy = 0
        if done.call.last == pool.job.parts:
            add(address + _UNFINISHED, -1)
    place = -1
    if load(address + _UNFINISHED) > 0 and load(address + _JOBS) == job:
        if mine == _ARRIVES:
            pool.arrived += 1
        place = choose(pool, one_at, rank)
        if place >= 0:
            one = one_at[ids[place]]
            one.call.first = one.call.last
            alone = pool.arrived < pool.threads
            one.call.last = min(pool.job.parts, one.call.first + PARTS) if alone else pool.job.parts
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
        one.failed = 0
    if mjb_apply(one.batch, 0, 1, pool.job.function, at + _CALL, 1) != 0:
        one.failed = pool.failures = 1
        one.call.last = pool.job.parts  # the row stays as it was
    elif one.call.last == pool.job.parts:
        for place in range(pool.row):
            row[place] = state[place]


@compiled
def run_whole(pool: Any, index: int) -> None:
    """Do the job on one simulation."""
    one = _simulations(pool.simulations, _MANY)[index]
    one.call.index, one.call.argument = index, pool.job.argument
    one.call.first, one.call.last = 0, pool.job.parts
    run(pool, index)


@compiled
def work(address: int, job: int, rank: int, patience: int) -> None:
    """Work until all simulations of a job are done, or for so many moments nobody needed help."""
    pool = _pools(address, 1)[0]
    done = 0
    for step in range(pool.threads):
        whose = (rank + step) % pool.threads
        place = claim(pool, job, whose)
        while place >= 0:
            run_whole(pool, _ids(pool.job.ids, pool.job.number)[place])
            done += 1
            place = claim(pool, job, whose)
    if done > 0:
        add(address + _UNFINISHED, -done)
    place, waited = _ARRIVES, 0
    while True:
        place = take(address, job, rank, place)
        if place >= 0:
            run(pool, _ids(pool.job.ids, pool.job.number)[place])
            waited = 0
            continue
        if waited > patience:
            return
        for _ in range(MOMENTS):
            if load(address + _UNFINISHED) == 0 or load(address + _JOBS) != job:
                return
            pause()
        waited += MOMENTS
        if waited > min(ALONE_FOR, pool.patience):
            step_aside()


@compiled
def complete(address: int) -> None:
    """Work until the job is done, if there is one."""
    while load(address + _UNFINISHED) > 0:
        work(address, load(address + _JOBS), 0, _MANY)


@compiled
def set_job(pool: Any, wanted: Any) -> None:
    """Write down what is to be done; nobody works."""
    pool.job.function, pool.job.argument = wanted.function, wanted.argument
    pool.job.ids, pool.job.number, pool.job.parts = wanted.ids, wanted.number, wanted.parts
    pool.failures = 0


@compiled_for_python
def do_alone(address: int, job: int) -> None:
    """Do a ``JOB`` on the calling thread."""
    complete(address)
    pool = _pools(address, 1)[0]
    set_job(pool, _jobs(job, 1)[0])
    for index in _ids(pool.job.ids, pool.job.number):
        run_whole(pool, index)


@compiled_for_python
def begin(address: int, job: int) -> bool:
    """Let all threads that are awake begin a ``JOB``; True if some sleep."""
    complete(address)
    acquire(address)
    pool = _pools(address, 1)[0]
    set_job(pool, _jobs(job, 1)[0])
    one_at, ids = _simulations(pool.simulations, _MANY), _ids(pool.job.ids, pool.job.number)
    number = load(address + _JOBS) + 1
    for rank in range(pool.threads):
        begins, apart, ends = share(pool, rank)
        for place in range(apart, ends):
            one = one_at[ids[place]]
            one.call.index, one.call.argument = ids[place], pool.job.argument
            one.busy = one.call.first = one.call.last = 0
        swap(pool.workers + _WORKER_SIZE * rank + _WHOLE, number * _PLACES + apart - begins)
    pool.arrived = 0
    swap(address + _UNFINISHED, pool.job.number)
    swap(address + _JOBS, number)
    release(address)
    for rank in range(1, pool.threads):  # noqa: SIM110  # not for Numba
        if load(pool.workers + _WORKER_SIZE * rank) != 0:
            return True
    return False


@compiled_for_python
def finish(address: int) -> None:
    """Work until the job is done."""
    complete(address)


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
        work(address, worker.seen, rank, pool.patience)
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

    Attributes:
        failures: [1]; not 0 if MuJoCo raised an error in the last job, the record of a simulation says where.
    """

    def __init__(self, simulations: npt.NDArray[Any], row: int, num_threads: int) -> None:
        self._simulations = simulations
        self._pool, self._workers = in_cache_lines(1, POOL), in_cache_lines(num_threads, _WORKER)
        self._address = int(self._pool.ctypes.data)
        self._pool["simulations"], self._pool["row"] = simulations.ctypes.data, row
        self._pool["threads"], self._pool["workers"] = num_threads, self._workers.ctypes.data
        self._job = np.zeros(1, JOB)
        self._job_address = int(self._job.ctypes.data)
        self._ids, self._asked = np.zeros(0, np.int32), _NOTHING
        self.failures: npt.NDArray[np.int64] = self._pool["failures"]
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

    def run(self, function: int, argument: int, ids: npt.NDArray[np.int32], parts: int) -> None:
        """Run a compiled function on simulations.

        Args:
            function: its address (``machine_code.compiled_for_batch``).
            argument: an address, which it is given.
            ids: which simulations, each once.
            parts: of which the function's work consists, at least 1. It may be called for some of them at a
                time, in their order. Work of one part is not worth a thread.
        """
        if self._process != os.getpid():
            self._forget_threads()
        # NumPy takes as long to find an address as all else here together.
        if ids is not self._ids or (function, argument, parts) != self._asked:
            self._asked = _NOTHING  # until it is all written down: a signal may come in between
            self._job[0] = function, argument, ids.ctypes.data, len(ids), parts
            self._ids, self._asked = ids, (function, argument, parts)
        if not self._wakes or parts == 1 or len(ids) == 1:
            do_alone(self._address, self._job_address)
            return
        try:
            if begin(self._address, self._job_address):
                for wake, worker in zip(self._wakes, self._workers[1:], strict=True):
                    if worker["asleep"]:
                        _wake(wake)
        finally:  # an interrupted job is done nevertheless: nobody is left in the middle of a step
            finish(self._address)

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


def in_cache_lines(number: int, kind: npt.DTypeLike) -> npt.NDArray[Any]:
    """Records of zeros, one after the other from the beginning of a line of the cache that is only theirs."""
    kind = np.dtype(kind)
    memory = np.zeros(number * kind.itemsize + 2 * _LINE, np.uint8)
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
