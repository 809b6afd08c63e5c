"""A sweep on Ray leaves the bytes of an inline one, whoever is killed or stopped on the way."""

import errno
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import ray
import torch
from ray.exceptions import RayActorError

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import ClusterError, TeacherUnavailableError
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.files.stop_file import StopFile
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.file_models import Resources
from recrl.orchestrator.ray import hang_watchdog, nodes
from recrl.orchestrator.ray.clusters import existing_cluster, local_cluster
from recrl.orchestrator.ray.hang_watchdog import HangWatchdog
from recrl.orchestrator.ray.nodes import check_gpus, check_nodes, trials_that_fit
from recrl.orchestrator.ray.ray_executor import (
    RayExecutor,
)
from recrl.orchestrator.ray.teacher_service import RayTeacher, start_teacher_service
from recrl.orchestrator.ray.tune_callbacks import LONGEST_PAUSE_SECONDS, pause_seconds
from recrl.orchestrator.remote.remote_sweep import RemoteSweep
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, Teacher, TeacherSpec

FEW_CRITIC_STEPS = {"hidden_sizes": [8], "critic_steps": 1, "critic_passes": 1}
FEW_STEPS = {**FEW_CRITIC_STEPS, "policy_steps": 1, "policy_passes": 1}  # learning is not the question here
LINEAR = TrialSpec(
    task=Choice("two-state", {"horizon": 10}),
    agent=Choice("ppo-lag", FEW_STEPS),
    method=Choice("linear"),
    train_limits=CostLimits((9.0,)),
    deploy_limits=CostLimits((3.0,)),
    train_steps=11 * 40,
    deploy_steps=40,
    num_envs=4,
    rollout_steps=10,
    evaluation_episodes=4,
    seed=0,
)
DYNAMIC = replace(LINEAR, method=Choice("dynamic", {"window": 2}), agent=Choice("cpo", FEW_CRITIC_STEPS))
SWEEP = (LINEAR, DYNAMIC, replace(LINEAR, seed=1), replace(DYNAMIC, seed=1))
LONG = replace(LINEAR, train_steps=1600 * 40, seed=2)  # long enough to be stopped on a fast machine, too
BROKEN = replace(LINEAR, method=Choice("linear", {"windw": 8}))
CRASHING = replace(LINEAR, task=Choice("os:abort"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    """A cluster of ours; the value is the handler of SIGTERM before it was started."""
    before = signal.getsignal(signal.SIGTERM)
    with local_cluster(num_cpus=2):
        yield before


@pytest.fixture(scope="module")
def inline(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    """The undisturbed trials, one after the other in this process."""
    store = SweepStore(tmp_path_factory.mktemp("inline"), "sweep")
    InlineExecutor().run((*SWEEP, LONG), SweepPlace(store), threading.Event())
    return store


def assert_equal_bytes(specs: Sequence[TrialSpec], store: SweepStore, expected: SweepStore) -> None:
    for spec in specs:
        ours, theirs = store.trial(spec), expected.trial(spec)
        assert ours.record().status is TrialStatus.COMPLETE
        assert ours.episodes_path.read_bytes() == theirs.episodes_path.read_bytes()
        assert ours.events_path.read_bytes() == theirs.events_path.read_bytes()
        assert ours.evaluation_path.read_bytes() == theirs.evaluation_path.read_bytes()


@contextmanager
def once(condition: Callable[[], bool], act: Callable[[], object]) -> Iterator[None]:
    """Do something beside the body of the context, as soon as a condition holds."""

    def watch(over: threading.Event) -> None:
        while not over.is_set():
            if condition():
                act()
                return
            over.wait(0.02)

    with background_thread(watch, name="once"):
        yield


@pytest.mark.usefixtures("cluster")
def test_equal_bytes_in_reused_workers_and_failures_stop_nobody(
    tmp_path: Path, inline: SweepStore, capfd: pytest.CaptureFixture[str]
) -> None:
    store = SweepStore(tmp_path, "sweep")
    RayExecutor(max_failures=0).run((BROKEN, *SWEEP, CRASHING), SweepPlace(store), threading.Event())
    assert_equal_bytes(SWEEP, store, inline)
    assert len({store.trial(spec).record().pid for spec in SWEEP}) <= 2
    failed = store.trial(BROKEN).record()
    assert failed.status is TrialStatus.FAILED
    assert failed.attempt == 1
    assert failed.error.startswith("ValidationError: ")
    crashed = store.trial(CRASHING).record()
    assert crashed.status is TrialStatus.FAILED
    assert crashed.error == (
        "its process failed once; the last time: it ended without an error: killed from outside, "
        "out of memory, or ended by the task's or the agent's own code"
    )
    assert [path.name for path in store.folder.iterdir()] == ["trials"]
    assert capfd.readouterr().out == ""


@pytest.mark.usefixtures("cluster")
def test_a_stopped_sweep_is_finished_by_the_next_run_with_other_workers(
    tmp_path: Path, inline: SweepStore
) -> None:
    store = SweepStore(tmp_path, "sweep")
    stop = threading.Event()
    with once(lambda: store.trial(LONG).record().update >= 20, stop.set):
        RayExecutor(commit_seconds=0.1).run((LONG, *SWEEP), SweepPlace(store), stop)
    record = store.trial(LONG).record()
    assert record.status is TrialStatus.WAITING
    assert 20 <= record.update < LONG.num_updates
    left = [spec for spec in (*reversed(SWEEP), LONG) if not store.trial(spec).record().status.is_finished]
    RayExecutor(resources=Resources(max_concurrent=1, teacher="inline")).run(
        left, SweepPlace(store), threading.Event()
    )
    assert_equal_bytes((LONG, *SWEEP), store, inline)


@pytest.mark.usefixtures("cluster")
def test_a_killed_worker_and_a_killed_teacher_leave_no_trace(tmp_path: Path, inline: SweepStore) -> None:
    store = SweepStore(tmp_path, "sweep")
    killed: list[int] = []

    def kill() -> None:
        [service] = ray.util.list_named_actors(all_namespaces=True)
        teacher = ray.get_actor(service["name"], namespace=service["namespace"])
        os.kill(process_of(teacher), signal.SIGKILL)
        killed.append(store.trial(LONG).record().pid)
        os.kill(killed[0], signal.SIGKILL)

    with once(lambda: store.trial(LONG).record().update >= 40, kill):
        RayExecutor(commit_seconds=0.1).run([LONG], SweepPlace(store), threading.Event())
    assert killed
    assert store.trial(LONG).record().attempt == 2
    assert store.trial(LONG).record().pid not in killed
    assert_equal_bytes([LONG], store, inline)


@pytest.mark.usefixtures("cluster")
def test_trials_in_an_object_store_outlive_their_workers_and_their_folders(
    tmp_path: Path, inline: SweepStore
) -> None:
    copy = SweepStore(tmp_path / "copy", "sweep")
    place = RemoteSweep((tmp_path / "bucket").as_uri(), copy)
    never, killed = threading.Event(), []

    def kill() -> None:
        killed.append(copy.trial(LONG).record().pid)
        os.kill(killed[0], signal.SIGKILL)

    def is_halfway() -> bool:
        record = copy.trial(LONG).record()
        return record.status is TrialStatus.RUNNING and bool(record.committed.get("updates.csv"))

    with place.kept_up_to_date(never, every=0.1), once(is_halfway, kill):
        RayExecutor(commit_seconds=0.2).run([LONG], place, never)
    assert killed
    assert copy.trial(LONG).record().attempt == 2
    assert "resumed after update " in copy.trial(LONG).log_path.read_text()
    assert_equal_bytes([LONG], copy, inline)


def process_of(actor: Any) -> int:
    process = ray.get(actor.__ray_call__.remote(lambda _: os.getpid()))
    assert isinstance(process, int)
    return process


def lessons(teacher: Teacher, reports: Sequence[ProgressReport]) -> Iterator[CurriculumStep]:
    step, state = teacher.start()
    yield step
    for report in reports:
        step, state = teacher.step(state, report)
        yield step


def curriculum(cost: float) -> tuple[TeacherSpec, list[ProgressReport]]:
    """A dynamic teacher and 20 updates of 4 episodes that cost the same: it converges and steps down."""
    spec = TeacherSpec("dynamic", {"window": 2}, CostLimits((9.0,)), CostLimits((3.0,)), train_steps=800)
    reports = [
        ProgressReport(
            update=update,
            env_steps=40 * update,
            episodes=tuple(
                EpisodeStats(
                    index=4 * update - 4 + episode,
                    phase=Phase.TRAINING,
                    end_step=40 * update,
                    length=10,
                    episode_return=5.0,
                    costs=(cost,),
                    limits=CostLimits((9.0,)),
                    noise=0.0,
                )
                for episode in range(4)
            ),
        )
        for update in range(1, 21)
    ]
    return spec, reports


@pytest.mark.usefixtures("cluster")
def test_inline_own_shared_and_killed_teachers_give_identical_limits() -> None:
    expected = [list(lessons(make_teacher(spec), reports)) for spec, reports in map(curriculum, (6.0, 4.0))]
    assert len({step.limits for step in expected[0]}) > 2

    def own(cost: float) -> list[CurriculumStep]:
        spec, reports = curriculum(cost)
        return list(lessons(RayTeacher(spec, start_teacher_service(f"own-{cost}")), reports))

    assert [own(6.0), own(4.0)] == expected

    service = start_teacher_service("shared")
    pupils = [lessons(RayTeacher(spec, service), reports) for spec, reports in map(curriculum, (6.0, 4.0))]
    shared: list[tuple[CurriculumStep, ...]] = []
    for update, pair in enumerate(zip(*pupils, strict=True)):
        shared.append(pair)
        if update == 10:
            os.kill(process_of(service), signal.SIGKILL)
    assert shared == list(zip(*expected, strict=True))


@pytest.mark.usefixtures("cluster")
def test_a_teachers_own_error_comes_through_and_a_lost_teacher_is_told_apart() -> None:
    spec, reports = curriculum(6.0)
    service = start_teacher_service("lost")
    teacher = RayTeacher(spec, service, patience_seconds=0.1)
    _, state = teacher.start()
    with pytest.raises(ValueError) as inline_error:
        make_teacher(spec).step(state, reports[5])
    with pytest.raises(type(inline_error.value), match=f"^{re.escape(str(inline_error.value))}$"):
        teacher.step(state, reports[5])
    ray.kill(service)
    with pytest.raises(RayActorError):
        for _ in range(1000):  # the order to die takes its time
            ray.get(service.start.remote(spec))
            time.sleep(0.01)
    with pytest.raises(TeacherUnavailableError, match=r"has not answered for 0\.1 seconds"):
        teacher.step(state, reports[0])


@pytest.mark.usefixtures("cluster")
def test_what_no_machine_can_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ClusterError,
        match=r"^a trial asks for 3 CPU, 0 GPU, this cluster has 2 CPU, 0 GPU; lower cpus_per_trial, ",
    ):
        RayExecutor(resources=Resources(cpus_per_trial=3)).run(
            SWEEP, SweepPlace(SweepStore(tmp_path, "sweep")), threading.Event()
        )


@pytest.mark.usefixtures("cluster")
def test_nodes_hold_as_many_trials_as_fit_on_each() -> None:
    assert trials_that_fit({"CPU": 1.0, "GPU": 0.0}) == 2
    assert trials_that_fit({"CPU": 0.5}) == 4
    assert trials_that_fit({"CPU": 1.5}) == 1
    assert trials_that_fit({"CPU": 1.0, "big_memory": 1.0}) == 0


def test_no_trial_uses_parts_of_two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        nodes, "_nodes", lambda: [{"Resources": {"CPU": 16.0, "GPU": 2.0}}, {"Resources": {"CPU": 1.0}}]
    )
    assert trials_that_fit({"CPU": 1.0, "GPU": 0.6}) == 2
    assert trials_that_fit({"CPU": 1.0, "GPU": 0.4}) == 4
    assert trials_that_fit({"CPU": 9.0, "GPU": 0.4}) == 1


@pytest.mark.usefixtures("cluster")
def test_nodes_are_asked_before_any_trial(tmp_path: Path) -> None:
    (tmp_path / "probe").touch()
    check_nodes(str(tmp_path / "probe"))
    check_nodes("probe", tmp_path.as_uri())
    with pytest.raises(
        ClusterError,
        match=r"^not every node of the cluster can run these trials: \S+ does not see /nowhere, which must "
        r"be on a file system that all nodes share; give all of them the same environment or image ",
    ):
        check_nodes("/nowhere/probe")
    with pytest.raises(
        ClusterError, match=r": \S+ does not see memory://bucket, but another file in its place; give "
    ):
        check_nodes("probe", "memory://bucket")


@pytest.mark.usefixtures("cluster")
@pytest.mark.skipif(bool(torch.version.cuda or torch.version.hip), reason="PyTorch for GPUs")
def test_nodes_whose_pytorch_cannot_use_their_gpus_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    check_gpus()
    found = [{**node, "Resources": {"CPU": 2.0, "GPU": 1.0}} for node in ray.nodes()]  # type: ignore[no-untyped-call]
    monkeypatch.setattr(nodes, "_nodes", lambda: found)
    with pytest.raises(
        ClusterError,
        match=r"^resources.gpus_per_trial is above 0, but not every node can use its GPUs: \S+ has torch \S+ "
        r"for CPUs only; install torch with CUDA there, or set gpus_per_trial to 0$",
    ):
        check_gpus()


@pytest.mark.usefixtures("cluster")
def test_only_this_user_can_read_the_clusters_token() -> None:
    token = Path(os.environ["RAY_AUTH_TOKEN_PATH"])
    assert os.environ["RAY_AUTH_MODE"] == "token"
    assert stat.S_IMODE(token.stat().st_mode) == 0o600
    assert stat.S_IMODE(token.parent.stat().st_mode) == 0o700


def commands_running() -> Iterator[bytes]:
    """The command line of every process, but of those that end meanwhile."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            yield path.read_bytes()


def listening_addresses(pids: set[int]) -> set[str]:
    """The addresses, in the kernel's hexadecimal form, at which some processes take connections."""
    sockets = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                sockets.add(os.readlink(link))
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == "0A" and f"socket:[{rest[5]}]" in sockets:
                found.add(local.partition(":")[0])
    return found


@pytest.mark.usefixtures("cluster")
def test_nothing_of_a_cluster_of_ours_listens_beyond_this_machine() -> None:
    worker = start_teacher_service("listening")
    names = ("ray::", "raylet", "gcs_server")
    pids = {os.getpid(), process_of(worker)}
    for path in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):
            if path.read_text().startswith(names) and of_this_cluster(path.parent):
                pids.add(int(path.parent.name))
    assert len(pids) >= 6  # this process, head, node, two agents, a worker
    mapped = "0000000000000000FFFF00000100007F"  # 127.0.0.1, in the table of IPv6
    assert listening_addresses(pids) == {"0100007F", mapped}


def of_this_cluster(process: Path) -> bool:
    """Whether the process writes its log to the cluster's folder."""
    folder = str(Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent)
    return any(os.readlink(link).startswith(folder) for link in (process / "fd").iterdir())


@pytest.mark.usefixtures("cluster")
def test_a_cluster_of_ours_has_no_process_that_serves_nobody() -> None:
    folder = os.environ["RAY_AUTH_TOKEN_PATH"].removesuffix("token").encode()
    commands = [command for command in commands_running() if folder in command]
    assert any(b"gcs_server" in command for command in commands)
    assert not any(name in command for command in commands for name in (b"log_monitor", b"monitor.py"))


def test_rays_signal_handlers_do_not_replace_ours(cluster: object) -> None:
    assert signal.getsignal(signal.SIGTERM) is cluster


def test_a_cluster_that_is_not_there_is_a_sentence() -> None:
    with (
        pytest.raises(ClusterError, match=r"^cannot use the Ray cluster at 127\.0\.0\.1:1: .*refused; is it"),
        existing_cluster("127.0.0.1:1"),
    ):
        pass


def test_a_trial_that_ends_is_seen_within_a_hundredth_of_its_time_and_half_a_second() -> None:
    assert [pause_seconds(seconds) for seconds in (0.0, 0.01, 10.0, 50.0, 1e6)] == [0.0, 1e-4, 0.1, 0.5, 0.5]
    assert LONGEST_PAUSE_SECONDS == 0.5


def test_a_process_is_silent_only_after_its_first_heartbeat(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep")
    files = store.trial(LONG)
    tune_trial = SimpleNamespace(
        trial_id="1",
        status="RUNNING",
        config={"spec": json.dumps(LONG.to_json())},
        temporary_state=SimpleNamespace(ray_actor=None),
    )
    process = subprocess.Popen(["ray::trial", "60"], executable=shutil.which("sleep"))
    try:
        files.begin(LONG)  # by a process that is dead, and left its record so
        silence = HangWatchdog(SweepPlace(store), 0.0)
        silence.begin(tune_trial)
        files.write_record(replace(files.record(), pid=process.pid))
        for _ in range(3):
            silence.end([tune_trial])
        assert process.poll() is None
        files.begin(LONG)
        files.write_record(replace(files.record(), pid=process.pid))
        silence.end([tune_trial])
        assert process.poll() is None
        silence.end([tune_trial])
        assert process.wait(timeout=30.0) == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()


def test_a_process_that_never_speaks_of_its_trial_is_ended_by_ray_after_a_longer_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(tmp_path, "sweep")
    tune_trial = SimpleNamespace(
        trial_id="1",
        status="RUNNING",
        config={"spec": json.dumps(LONG.to_json())},
        temporary_state=SimpleNamespace(ray_actor="its actor"),
    )
    ended: list[Any] = []
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(hang_watchdog, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(ray, "kill", ended.append)
    silence = HangWatchdog(SweepPlace(store), 100.0)
    silence.begin(tune_trial)
    found = []
    for clock.now in (101.0, 490.0, 501.0, 510.0, 2000.0):
        silence.end([tune_trial])
        found.append(len(ended))
    assert found == [0, 0, 1, 1, 1]
    assert ended == ["its actor"]


def test_a_stop_file_tells_its_own_run_and_all_earlier_ones(tmp_path: Path) -> None:
    with StopFile.open(tmp_path) as earlier:
        assert not StopFile(earlier.path).is_set()
        with StopFile.open(tmp_path) as stop_file:
            assert StopFile(earlier.path).is_set()
            assert not StopFile(stop_file.path).is_set()
            stop_file.set()
            assert StopFile(stop_file.path).is_set()
    assert list(tmp_path.iterdir()) == []


def test_a_stop_file_that_cannot_be_read_stops_nobody(tmp_path: Path) -> None:
    (tmp_path / "stop").mkdir()  # reading it fails, as on a disk that is away
    assert not StopFile(tmp_path / "stop").is_set()


def test_a_full_disk_keeps_nobody_from_stopping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with StopFile.open(tmp_path) as stop_file:
        stop_file.set()
        assert StopFile(stop_file.path).is_set()


def test_a_hanging_process_that_ends_by_itself_is_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = subprocess.Popen(["true"])
    process.wait()
    monkeypatch.setattr(hang_watchdog, "_is_worker", lambda _: True)  # as it was a moment ago
    files = SweepStore(tmp_path, "s").trial(LONG)
    files.begin(LONG)
    hang_watchdog._end_process(replace(files.record(), pid=process.pid), None)
