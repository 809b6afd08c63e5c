"""A sweep over S3's own protocol: s3fs against moto's server. Runs where both are installed."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.remote.remote_sweep import RemoteSweep
from recrl.orchestrator.run_sweep import SweepRunSettings, run_sweep
from recrl.orchestrator.sweep_place import SweepPlace

pytestmark = pytest.mark.filterwarnings("default")  # theirs
s3fs: Any = pytest.importorskip(
    "s3fs", reason="pip install 's3fs' 'moto[server]' to test against S3's protocol"
)
moto: Any = pytest.importorskip("moto.server", reason="pip install 's3fs' 'moto[server]' likewise")

GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [linear]
seeds: 1
run: {total_steps: 160, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
"""


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    """A server that holds the bucket ``results`` and forgets it at its end."""
    with pytest.MonkeyPatch.context() as patch:
        server = moto.ThreadedMotoServer(port=0)
        server.start()
        host, port = server.get_host_and_port()
        for name, value in {
            "AWS_ACCESS_KEY_ID": "somebody",
            "AWS_SECRET_ACCESS_KEY": "hunter2",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        }.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem().mkdir("results")
        try:
            yield server
        finally:
            server.stop()


@pytest.mark.usefixtures("server")
def test_a_sweep_on_s3_is_the_sweep_of_a_folder(tmp_path: Path) -> None:
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    local = SweepStore(tmp_path / "local", "small")
    run_sweep(SweepRunSettings(grid, SweepPlace(local), InlineExecutor()), stop=threading.Event())
    copy = SweepStore(tmp_path / "copy", "small")
    place = RemoteSweep("s3://results/runs", copy)
    place.prepare()
    run_sweep(SweepRunSettings(grid, place, InlineExecutor()), stop=threading.Event())
    elsewhere = SweepStore(tmp_path / "elsewhere", "small")
    RemoteSweep("s3://results/runs", elsewhere).pull()
    [spec] = grid.trials()
    for store in (copy, elsewhere):
        assert store.trial(spec).episodes_path.read_bytes() == local.trial(spec).episodes_path.read_bytes()
        assert len(store.trial(spec).checkpoints()) == 1


@pytest.mark.usefixtures("server")
def test_objects_on_s3_behave_as_those_of_any_store() -> None:
    store = ObjectStore("s3://results/objects")
    assert store.create("a/x", b"1")
    assert not store.create("a/x", b"2")
    store.write("c", b"3")
    assert (store.read("a/x"), store.read("b")) == (b"1", None)
    assert (store.keys_in(), store.names("file"), store.names("directory")) == (["a/x", "c"], ["c"], ["a"])
    store.delete(["a/x", "a/x", "c"])
    assert store.keys_in() == []


@pytest.mark.usefixtures("server")
def test_a_bucket_that_is_not_there_is_a_sentence_without_secrets() -> None:
    with pytest.raises(
        StorageError, match=r"^s3://nowhere/runs: cannot be written \(FileNotFoundError: "
    ) as error:
        ObjectStore("s3://nowhere/runs").probe()
    assert os.environ["AWS_SECRET_ACCESS_KEY"] not in str(error.value)
