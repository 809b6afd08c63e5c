"""Threads do each part of the work on each simulation once and in order, whoever sleeps, fails or is gone."""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import time
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core import types

from recrl.environments import thread_pool
from recrl.environments.machine_code import CALL, array_at, compiled_for_batch, mj_step
from recrl.environments.safety_gym import SafetyGymVectorEnv
from recrl.environments.safety_tasks import SAFETY_TASKS
from recrl.environments.scene import make_scene
from recrl.environments.simulations import Simulations

NUMBER = 12
RECORD = np.dtype([("done", np.int64), ("disorder", np.int64), ("calls", np.int64)], align=True)
MESSAGE = np.frombuffer(b"no more of this\0", np.uint8)
records_at, calls_at = array_at(RECORD), array_at(CALL)
mju_error = types.ExternalFunction("mju_error", types.void(types.int64))
_MESSAGE, _FAILS = int(MESSAGE.ctypes.data), 5


@compiled_for_batch
def note(_model: int, _data: int, _: int, address: int) -> None:
    call = calls_at(address, 1)[0]
    record = records_at(call.argument, NUMBER)[call.index]
    if call.first != record.done or call.last <= call.first:
        record.disorder += 1
    record.done = call.last
    record.calls += 1


@compiled_for_batch
def linger(model: int, data: int, _: int, address: int) -> None:
    call = calls_at(address, 1)[0]
    record = records_at(call.argument, NUMBER)[call.index]
    if call.first != record.done:
        record.disorder += 1
    for _step in range(10 * (call.index + 1)):
        mj_step(model, data)
    record.done = call.last


@compiled_for_batch
def fail(_model: int, _data: int, _: int, address: int) -> None:
    call = calls_at(address, 1)[0]
    records = records_at(call.argument, NUMBER + 1)
    records[call.index].done = call.last
    if call.index == _FAILS and call.last > 2:
        mju_error(records[NUMBER].done)


@functools.cache
def simulations(num_threads: int) -> Simulations:
    return Simulations(make_scene(SAFETY_TASKS["PointGoal0"]).model, NUMBER, num_threads=num_threads)


def noted(num_threads: int, parts: int, ids: list[int] | None = None) -> npt.NDArray[np.void]:
    records = np.zeros(NUMBER, RECORD)
    simulations(num_threads).apply(note, records.ctypes.data, ids, parts=parts)
    return records


@given(
    num_threads=st.integers(1, 5),
    parts=st.integers(1, 30),
    ids=st.lists(st.integers(0, NUMBER - 1), min_size=1, unique=True),
)
@settings(deadline=None, max_examples=200)
def test_every_part_is_done_once_and_in_order(num_threads: int, parts: int, ids: list[int]) -> None:
    records = noted(num_threads, parts, ids)
    assert not records["disorder"].any()
    assert np.array_equal(records["done"], np.where(np.isin(np.arange(NUMBER), ids), parts, 0))
    assert records["calls"].sum() >= len(ids)


def test_only_the_last_simulations_are_done_in_parts() -> None:
    calls = noted(2, 11)["calls"]
    apart = thread_pool.APART * 2
    assert (calls == 1).sum() >= NUMBER - apart
    assert calls.sum() <= NUMBER - apart + apart * -(-11 // thread_pool.PARTS)
    assert simulations(2)._threads._pool["arrived"][0] <= 2, "it is counted anew for each job"
    assert noted(1, 11)["calls"].tolist() == [1] * NUMBER


@pytest.fixture
def idle() -> tuple[thread_pool.ThreadPool, int]:
    """A pool whose thread has ended, in the middle of its second job of 11 parts, and the job's number."""
    pool = Simulations(make_scene(SAFETY_TASKS["PointGoal0"]).model, NUMBER, num_threads=2)._threads
    pool.close()
    ids = np.arange(NUMBER, dtype=np.int32)
    pool._job[0] = note.address, 0, ids.ctypes.data, NUMBER, 11
    pool._ids, pool._pool["job"] = ids, pool._job
    pool._pool["jobs"][0, 0] = job = 2
    pool._pool["unfinished"][0, 0] = NUMBER
    pool._workers["whole"][:, 0] = job * thread_pool._PLACES + 2
    return pool, job


def test_nothing_is_taken_of_another_job(idle: tuple[thread_pool.ThreadPool, int]) -> None:
    """A thread that was held up between two looks finds that there is a new job, and leaves it alone."""
    pool, job = idle
    record = pool._pool[0]
    for other in (job - 1, job + 1):
        assert thread_pool.claim(record, other, 1) == -1
        assert thread_pool.take(pool._address, other, 1, thread_pool._ARRIVES) == -1
    assert record["arrived"] == 0
    assert thread_pool.share(record, 1) == (6, 12 - thread_pool.APART, 12)
    assert [thread_pool.claim(record, job, 1) for _ in range(3)] == [9, 10, -1]


def test_threads_take_turns_until_all_are_there(idle: tuple[thread_pool.ThreadPool, int]) -> None:
    """The first does parts of both last simulations in turns; with the second, each does one to its end."""
    pool, job = idle
    parts, calls = thread_pool.PARTS, pool._simulations["call"]
    first, second = 0, 1

    def take(rank: int, mine: int) -> tuple[int, int, int]:
        place = thread_pool.take(pool._address, job, rank, mine)
        return place, calls["first"][place], calls["last"][place]

    assert take(first, thread_pool._ARRIVES) == (5, 0, parts)
    assert take(first, 5) == (11, 0, parts)
    assert take(first, 11) == (5, parts, 2 * parts)
    assert take(second, thread_pool._ARRIVES) == (11, parts, 11)
    assert take(first, 5) == (5, 2 * parts, 11)
    assert thread_pool.take(pool._address, job, second, 11) == -1
    assert thread_pool.take(pool._address, job, first, 5) == -1
    assert pool._pool["unfinished"][0, 0] == NUMBER - 2


def test_threads_that_sleep_are_woken() -> None:
    busy = simulations(2)._threads
    for _ in range(3):
        deadline = time.monotonic() + 60.0
        while not busy._workers["asleep"][1] and time.monotonic() < deadline:
            time.sleep(thread_pool.AWAKE_SECONDS)
        assert busy._workers["asleep"][1]
        before = busy._workers["seen"][1]
        assert noted(2, 11)["done"].tolist() == [11] * NUMBER
        while busy._workers["seen"][1] == before and time.monotonic() < deadline:
            time.sleep(0.001)
        assert busy._workers["seen"][1] > before


def test_an_error_of_mujoco_stops_one_simulation_alone(
    tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its errors to a file where it runs
    model = make_scene(SAFETY_TASKS["PointGoal0"]).model
    for num_threads in (1, 2):
        broken, records = Simulations(model, NUMBER, num_threads=num_threads), np.zeros(NUMBER + 1, RECORD)
        records["done"][NUMBER] = _MESSAGE
        broken.apply(fail, records.ctypes.data, parts=8)
        others = np.arange(NUMBER) != _FAILS
        assert (records["done"][:NUMBER][others] == 8).all()
        assert broken.any_stopped
        assert np.array_equal(broken.stopped, ~others)
        broken.reset([_FAILS])
        assert not broken.any_stopped


def test_a_failure_is_of_the_simulations_of_its_job(
    tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model = make_scene(SAFETY_TASKS["PointGoal0"]).model
    broken, records = Simulations(model, NUMBER, num_threads=2), np.zeros(NUMBER + 1, RECORD)
    records["done"][NUMBER] = _MESSAGE
    before = broken.rows.copy()
    broken.apply(fail, records.ctypes.data, [_FAILS, 6], parts=8)
    assert np.array_equal(broken.rows, before)
    broken.reset([_FAILS])
    broken.apply(note, records.ctypes.data, [2, 3], parts=8)
    assert not broken.stopped.any()


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_failure_in_an_interrupted_job_is_told(
    num_threads: int, tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model = make_scene(SAFETY_TASKS["PointGoal0"]).model
    broken, records = Simulations(model, NUMBER, num_threads=num_threads), np.zeros(NUMBER + 1, RECORD)
    records["done"][NUMBER] = _MESSAGE
    run = broken._threads.run

    def interrupted(*arguments: Any) -> None:
        run(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(broken._threads, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        broken.apply(fail, records.ctypes.data, parts=8)
    assert np.flatnonzero(broken.broken()).tolist() == [_FAILS]
    assert broken.any_stopped


@pytest.mark.parametrize("ids", [[3, 3, 4], [-1], [NUMBER], [True] * NUMBER, [0.5]])
def test_simulations_that_are_not_there_or_named_twice_are_refused(ids: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"must be different whole numbers from 0 to 11, got \["):
        noted(2, 4, ids)


def test_work_without_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one part, got 0"):
        noted(2, 0)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there is no timer")
def test_no_signal_leaves_a_job_undone() -> None:
    """Signals come while the caller works and waits, with more threads than there are processors, too."""
    interrupts = 0

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        for num_threads in (2, 6):
            busy = Simulations(make_scene(SAFETY_TASKS["PointGoal0"]).model, NUMBER, num_threads=num_threads)
            for _ in range(40):
                records = np.zeros(NUMBER, RECORD)
                try:
                    signal.setitimer(signal.ITIMER_REAL, 0.002)
                    while True:
                        records[...] = 0
                        busy.apply(linger, records.ctypes.data, parts=6)
                except KeyboardInterrupt:
                    interrupts += 1
                assert busy._threads._pool["unfinished"][0, 0] == 0
                assert set(records["done"]) <= {0, 6}
                assert not records["disorder"].any()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
    assert interrupts == 80


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there is no timer")
def test_after_a_signal_comes_the_next_job_not_the_last() -> None:
    """Two jobs in turns, interrupted anywhere, also where the second is being written down."""
    alone = Simulations(mujoco.MjModel.from_xml_string("<mujoco/>"), 2)
    ids = [np.arange(number, dtype=np.int32) for number in (1, 2)]
    records = [np.zeros(NUMBER, RECORD) for _ in range(2)]
    addresses = [int(record.ctypes.data) for record in records]

    def done(which: int) -> bool:
        records[which]["done"] = 0
        alone._threads.run(note.address, addresses[which], ids[which], 1)
        return bool((records[which]["done"][: 1 + which] == 1).all())

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        for attempt in range(400):
            try:
                signal.setitimer(signal.ITIMER_REAL, 0.0002)
                while True:
                    done(0)
                    done(1)
            except KeyboardInterrupt:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            assert done(attempt % 2)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


def test_an_interrupted_job_is_done_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = thread_pool.begin

    def interrupted(address: int, job: int) -> bool:
        begin(address, job)
        raise KeyboardInterrupt

    records = np.zeros(NUMBER, RECORD)
    monkeypatch.setattr(thread_pool, "begin", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulations(3).apply(note, records.ctypes.data, parts=11)
    assert records["done"].tolist() == [11] * NUMBER


def _states(num_threads: int) -> bytes:
    environment = SafetyGymVectorEnv("CarPush2", 6, num_threads=num_threads)
    environment.reset(seed=3)
    for actions in np.random.default_rng(0).uniform(-1.0, 1.0, (40, 6, 2)):
        environment.step(actions)
    return environment.worlds.simulations.rows.tobytes()


@pytest.mark.parametrize("num_threads", [2, 3, 8])
def test_threads_change_no_bit(num_threads: int) -> None:
    assert _states(num_threads) == _states(1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_goes_on_without_its_threads() -> None:
    noted(2, 11)
    context = multiprocessing.get_context("fork")
    child = context.Process(target=_exit_with_done)
    child.start()
    child.join(60.0)
    assert child.exitcode == 11


def _exit_with_done() -> None:
    os._exit(int(noted(2, 11)["done"].min()))


def test_threads_end_with_their_simulations() -> None:
    pool = Simulations(make_scene(SAFETY_TASKS["PointGoal0"]).model, 4, num_threads=3)._threads
    threads = pool._threads
    assert all(thread.is_alive() for thread in threads)
    pool.close()
    assert not any(thread.is_alive() for thread in threads)


def test_threads_that_lack_processors_do_not_wait_awake() -> None:
    processors = thread_pool.num_processors()
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    for num_threads, waits in ((processors, True), (processors + 1, False)):
        pool = Simulations(model, 2, num_threads=num_threads)._threads
        assert bool(pool._pool["patience"][0] > 0) == (waits and num_threads > 1)
        pool.close()
