"""A cluster whose nodes share no folder, only an S3 server, and a sweep on it while parts of it fail.

    python -m tests.faults.cluster_storage [--steps 1500000] [--log results/cluster/storage.txt]

The head, two workers and the launch of docker/compose.yaml as ``tests.faults.cluster`` starts them, in
namespaces of their own, but without the volume that they share there. The sweep is kept at
``s3://results/runs`` by moto's server, the only thing that all of them reach. Meanwhile one worker is killed
and restarted, the server is away for a while, the other worker is cut off from the network until its trial
runs elsewhere and then let back, a second launch is tried from another machine, and a third machine asks how
the sweep stands. At the end every file is compared with those of the same sweep in a folder of one machine.
Needs what ``tests.faults.cluster`` needs but for PostgreSQL, s3fs beside recrl, and moto; says why and ends
with 0 where it cannot run.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.remote.remote_sweep import RemoteSweep
from tests.faults.chaos import differences
from tests.faults.cluster import (
    READY_SECONDS,
    Cluster,
    Trouble,
    _ip,
    reason_not_to_run,
    single_machine,
    wait_for,
)

GRID = """\
name: cluster
tasks: [{{name: rivergrid-1a, deploy_limits: 5}}]
agents: [ppo-lag]
methods: [linear, {{name: dynamic, options: {{window: 5}}}}]
seeds: 3
run: {{num_envs: 4, rollout_steps: 200, total_steps: {steps}, evaluation_episodes: 10}}
"""
STORAGE = "s3://results/runs"
SERVICES = ("ray-head", "ray-worker-1", "ray-worker-2")
LAUNCHES = ("sweep", "second", "third")
AWAY_SECONDS = 45.0
PORT = 5555


def reason() -> str:
    """Why this machine cannot run it, or empty."""
    missing = [name for name in ("s3fs", "moto") if importlib.util.find_spec(name) is None]
    if missing:
        return f"{' and '.join(missing)} missing (pip install s3fs 'moto[server]')"
    other = reason_not_to_run()
    return "" if other.startswith("PostgreSQL") else other


def unshared(cluster: Cluster, endpoint: str) -> None:
    """Take the shared folder from the compose file's services, and give them the server's address."""
    for name in ("ray-head", "ray-worker", "sweep"):
        service = cluster.compose["services"][name]
        service["volumes"] = [volume for volume in service.get("volumes", ()) if ":/runs" not in volume]
        service["environment"] = {**service["environment"], **credentials(endpoint)}


def credentials(endpoint: str) -> dict[str, str]:
    return {
        "AWS_ACCESS_KEY_ID": "somebody",
        "AWS_SECRET_ACCESS_KEY": "something",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": endpoint,
    }


def serve(cluster: Cluster) -> Any:
    """S3 on the cluster's own network, which leads nowhere else."""
    from moto.server import ThreadedMotoServer  # noqa: PLC0415  (may be missing)

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line a request
    answer(cluster, "add")
    server = ThreadedMotoServer(ip_address=address(cluster), port=PORT, verbose=False)
    server.start()
    return server


def answer(cluster: Cluster, verb: str) -> None:
    """``add`` or ``del``: whether anybody has the server's address; connections to nobody's time out."""
    _ip(f"addr {verb} {address(cluster)}/24 dev {cluster.networks['cluster']}")


def address(cluster: Cluster) -> str:
    return f"10.77.{list(cluster.compose['networks']).index('cluster')}.1"


def up(cluster: Cluster) -> None:
    """Start Ray, and start again whatever of it ends."""
    containers = [cluster.containers[name] for name in SERVICES]
    for container in containers:
        container.start()
        cluster.wait_until_healthy(container.name)
    threading.Thread(target=cluster._keep_up, args=(containers,), daemon=True).start()


def run(cluster: Cluster, name: str, *command: str) -> tuple[int, str]:
    """What a command in a container of its own ends with, and its last line."""
    container = cluster.containers[name]
    container.start(command)
    assert container.process is not None
    code = container.process.wait()
    return code, next(iter(container.output.read_text().splitlines()[-1:]), "")


def launch_command(root: str) -> list[str]:
    command = ["recrl-node", "run", "recrl-sweep", "launch", "/grids/cluster.yaml", f"--root={root}"]
    return [*command, "--address=auto", f"--storage={STORAGE}", "--no-mlflow", "--no-figures"]


def disturbed(cluster: Cluster) -> Iterator[str]:
    """The whole story; what went wrong."""
    import s3fs  # noqa: PLC0415  (may be missing)

    expected = single_machine(cluster)
    endpoint = f"http://{address(cluster)}:{PORT}"
    unshared(cluster, endpoint)
    cluster.connect(LAUNCHES)
    server = serve(cluster)
    os.environ.update(credentials(endpoint))
    s3fs.S3FileSystem().mkdir("results")
    cluster.say(f"an S3 server answers at {endpoint}; nodes share no folder")
    up(cluster)
    launch = cluster.containers["sweep"]
    launch.start(launch_command("/tmp/runs"))
    cluster.say(f"launched: recrl-sweep launch ... --address=auto --storage={STORAGE}")
    store = SweepStore(cluster.folder / "copy", "cluster")
    storage = RemoteSweep(STORAGE, store)
    trouble = Trouble(cluster, store)

    def has_saved(name: str) -> bool:
        return any(record.committed.get("updates.csv") for record in trouble.running_on(name))

    with storage.kept_up_to_date(threading.Event(), every=2.0):
        wait_for(lambda: has_saved("ray-worker-1"), READY_SECONDS)
        trouble.kill("ray-worker-1")
        code, last = run(cluster, "second", *launch_command("/tmp/second"))
        cluster.say(f"a second launch from another machine ends with {code}: {last}")
        if code != ExitCode.BUSY:
            yield f"a second launch ended with {code}"
        cluster.containers["second"].kill()
        answer(cluster, "del")
        cluster.say(f"the S3 server is away for {AWAY_SECONDS:.0f} seconds")
        time.sleep(AWAY_SECONDS)
        answer(cluster, "add")
        cluster.say("the S3 server is back")
        wait_for(lambda: has_saved("ray-worker-2"), READY_SECONDS)
        trouble.cut_off("ray-worker-2")
        code, last = run(
            cluster, "third", "recrl-sweep", "status", "--brief", "--root=/tmp/third", f"--storage={STORAGE}"
        )
        cluster.say(f"a third machine sees: {last}")
        assert launch.process is not None
        code = launch.process.wait()
        cluster.say(f"the launch ended with {code}")
        print(launch.output.read_text(), file=cluster.log)
        if code != ExitCode.OK:
            yield f"the launch ended with {code}"
    yield from compared(cluster, store, expected)
    server.stop()


def compared(cluster: Cluster, store: SweepStore, expected: SweepStore) -> Iterator[str]:
    """What differs between the two sweeps."""
    trials = store.trials()
    for trial in trials:
        for difference in differences(trial, expected.trial(trial.spec)):
            yield f"{trial.spec.title}: {difference}"
    if [trial.spec for trial in trials] != [trial.spec for trial in expected.trials()] or not trials:
        yield "the sweeps have different trials"
    episodes = sum(len(trial.episodes()) for trial in trials)
    attempts = sum(trial.record().attempt for trial in trials)
    cluster.say(f"{len(trials)} trials in {attempts} attempts, {episodes} episodes compared byte for byte")


def main() -> int:
    parser = argparse.ArgumentParser(
        description="A sweep on a cluster that shares an S3 server and no folder."
    )
    parser.add_argument("--steps", type=int, default=1_500_000, help="of a trial")
    parser.add_argument("--log", type=Path, default=Path(os.devnull), help="write what happened there too")
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # also in the background
    if why := reason():
        print(f"skipped: {why}")
        return 0
    with (
        tempfile.TemporaryDirectory(prefix="cluster-", ignore_cleanup_errors=True) as name,
        given.log.open("w") as log,
    ):
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "grids").mkdir()
        (folder / "grids/cluster.yaml").write_text(GRID.format(steps=given.steps))
        print(f"python -m tests.faults.cluster_storage {' '.join(sys.argv[1:])}", file=log, flush=True)
        cluster = Cluster(folder, log, {"RECRL_CPUS": "1", "RECRL_GRID": "cluster.yaml"})
        try:
            problems = list(disturbed(cluster))
        finally:
            cluster.down()
        for problem in problems:
            cluster.say(f"WRONG {problem}")
        cluster.say(
            "everything agrees" if not problems else f"NOT everything agrees: {len(problems)} are wrong"
        )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
