"""The cluster of docker/compose.yaml without Docker, and a sweep on it while its nodes fail.

    python -m tests.faults.cluster [--steps 600000] [--log results/cluster/log.txt]      (make cluster-test)

Every service of the compose file becomes a process in namespaces of its own (network, mounts, processes, host
name), from the file's own command, environment, user, networks, volumes, secrets, health check and read-only
root, and the Dockerfile's variables. What is not the file's: the image (this machine's Python and PostgreSQL
stand in for it), what PostgreSQL's entry point does at the first start, and the limits on cores and memory.

A sweep is launched on two workers, as `docker compose run sweep` does. Meanwhile one worker is killed and
restarted, the other is cut off from the network until its trial runs elsewhere and then let back, MLflow's
server is killed while several processes write to it, and strangers knock. At the end every file is compared
with those of the same sweep on one machine, and MLflow's points with what the files give. Needs root for the
namespaces, iproute2, util-linux and PostgreSQL's server; says why and ends with 0 where it cannot run.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, TextIO

import yaml

from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.spec import TrialStatus
from tests.faults.chaos import compared, shown

ROOT = Path(__file__).resolve().parents[2]
GRID = """\
name: cluster
tasks: [{{name: rivergrid-1a, deploy_limits: 5}}]
agents: [ppo-lag, cpo]
methods: [linear, {{name: dynamic, options: {{window: 5}}}}]
seeds: 3
run: {{num_envs: 4, rollout_steps: 200, total_steps: {steps}, evaluation_episodes: 10}}
"""
SMALL_GRID = """\
name: shipped
tasks: [{name: rivergrid-1a, deploy_limits: 5}]
agents: [ppo-lag]
methods: [none, linear]
seeds: 2
run: {total_steps: 40_000, evaluation_episodes: 2}
"""
COPIES = 3  # finished sweeps that are sent to MLflow while the sweep runs, each by a process of its own
READY_SECONDS = 300.0
# What PostgreSQL's image does before the first start.
POSTGRES = """\
initdb --username="$POSTGRES_USER" --pwfile="$POSTGRES_PASSWORD_FILE" --encoding=UTF8 --locale=C.UTF-8 \
    $POSTGRES_INITDB_ARGS >/dev/null
echo "host all all all scram-sha-256" >>"$PGDATA/pg_hba.conf"
echo "CREATE DATABASE $POSTGRES_DB" | postgres --single -D "$PGDATA" postgres >/dev/null
exec postgres -c 'listen_addresses=*'
"""
KNOCK = """\
import ray
try:
    ray.init(address="ray-head:6379", log_to_driver=False)
    print("let in")
except Exception as error:
    print("refused:", type(error).__name__)
"""


def interpolated(text: str, variables: Mapping[str, str]) -> str:
    """A compose file's text with ``${NAME}`` and ``${NAME:-default}`` filled in."""
    return re.sub(
        r"\$\{(\w+)(?::-([^}]*))?\}", lambda found: variables.get(found[1]) or found[2] or "", text
    ).replace("$$", "$")


def image_environment(dockerfile: str) -> dict[str, str]:
    """The variables that the Dockerfile's last stage sets."""
    stage = dockerfile.rpartition("\nFROM ")[2]
    [block] = re.findall(r"^ENV ((?:.*\\\n)*.*)$", stage, re.MULTILINE)
    return dict(pair.split("=", 1) for pair in block.replace("\\\n", " ").split())


@dataclass
class Container:
    """One process tree that sees what a container of its service would see.

    Attributes:
        name: also its host name.
        service: its part of the compose file.
        addresses: by network.
        folder: holds what is made for it.
        names: who has which address, as it sees it.
        compose: the whole file.
        environment: what the image sets.
        bare: whether it is an image that lacks recrl, though not what recrl needs.
    """

    name: str
    service: Mapping[str, Any]
    addresses: Mapping[str, str]
    folder: Path
    names: Mapping[str, str]
    compose: Mapping[str, Any]
    environment: Mapping[str, str]
    bare: bool = False
    process: subprocess.Popen[bytes] | None = None

    @property
    def namespace(self) -> str:
        return f"recrl-{self.name}"

    @property
    def output(self) -> Path:
        return self.folder / f"{self.name}.txt"

    def start(self, command: Sequence[str] | None = None) -> None:
        """Start its command, or another one in its place."""
        shutil.rmtree(self.root, ignore_errors=True)
        self.root.mkdir(parents=True)
        command = self.service.get("command", ()) if command is None else command
        script = "\n".join([*self._mounts(), f"exec chroot {self.root} {shlex.join(self._inside(command))}"])
        own = ["unshare", "--mount", "--uts", "--pid", "--fork", "--kill-child=KILL"]
        with self.output.open("ab") as out:
            self.process = subprocess.Popen(
                ["nsenter", f"--net=/run/netns/{self.namespace}", *own, "sh", "-euc", script],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    @property
    def root(self) -> Path:
        return self.folder / "roots" / self.name

    def _mounts(self) -> Iterator[str]:
        """Build a root of its own: the system read-only, and what the compose file mounts."""
        root, venv = self.root, ROOT / ".venv"
        yield "mount --make-rprivate /"
        yield f"hostname {self.name}"
        yield "ip link set lo up"
        yield f"mount -t tmpfs -o mode=755 tmpfs {root}"
        for name in ("bin", "lib", "lib64", "sbin"):
            yield f"cp -P /{name} {root}/ 2>/dev/null || true"
        yield " ".join(
            ["mkdir -p", *(f"{root}/{name}" for name in ("proc", "dev", "run/secrets", "var", "tmp"))]
        )
        yield f"ln -s ../run {root}/var/run"
        yield f"mount -t proc proc {root}/proc"
        yield f"mount --rbind /dev {root}/dev"
        size = self.service.get("shm_size", "64mb").removesuffix("b")
        yield f"mount -t tmpfs -o mode=1777,size={size} tmpfs {root}/dev/shm"
        for target in sorted(self._tmpfs()):
            yield f"mkdir -p {root}{target} && mount -t tmpfs -o mode=1777 tmpfs {root}{target}"
        seen = {"/usr": Path("/usr"), "/etc": Path("/etc"), str(ROOT): ROOT, "/opt/recrl": venv}
        seen[sys.base_prefix] = Path(sys.base_prefix)
        for target, source in seen.items():
            if target == "/usr" or not target.startswith("/usr/"):
                yield f"mkdir -p {root}{target} && mount -o rbind,ro {source} {root}{target}"
        if self.bare:
            installed = [path.relative_to(venv) for path in venv.glob("lib/python*/site-packages/*recrl*")]
            for seen_as, path in product((venv, "/opt/recrl"), installed):
                empty = "-t tmpfs tmpfs" if (venv / path).is_dir() else "-o bind,ro /dev/null"
                yield f"mount {empty} {root}{seen_as}/{path}"
        yield f"mount -t tmpfs -o mode=755 tmpfs {root}/usr/local/bin"
        yield f"install -m 755 {ROOT}/docker/recrl-node {root}/usr/local/bin/"
        for name, text in (("hosts", self._hosts()), ("passwd", "recrl:x:10001:10001::/tmp:/bin/sh\n")):
            path = self.folder / f"{self.name}-{name}"
            path.write_text(text)
            yield f"mount -o bind,ro {path} {root}/etc/{name}"
        for name in self.service.get("secrets", ()):
            source = self.folder / "docker" / self.compose["secrets"][name]["file"]
            yield f"touch {root}/run/secrets/{name} && mount -o bind,ro {source} {root}/run/secrets/{name}"
        yield f"mkdir -p -m 1777 {root}/runs"
        for volume in self.service.get("volumes", ()):
            source_name, target, *mode = volume.split(":")
            source = self.folder / "docker" / source_name
            if source_name in self.compose["volumes"]:
                source = self.folder / "volumes" / source_name
                source.mkdir(parents=True, exist_ok=True)
                source.chmod(0o1777)
            how = mode[0] if mode else "rw"
            yield f"mkdir -p {root}{target} && mount -o bind,{how} {source} {root}{target}"
        if self.service["read_only"]:
            yield f"mount -o remount,ro {root}"

    def _tmpfs(self) -> Iterator[str]:
        for entry in self.service.get("tmpfs", ()):
            yield entry.partition(":")[0].replace("/var/run", "/run")

    def _hosts(self) -> str:
        own = next(iter(self.addresses.values()))
        others = (f"{address} {name}\n" for name, address in self.names.items())
        return f"127.0.0.1 localhost\n{own} {self.name}\n{''.join(others)}"

    def _inside(self, command: Sequence[str], **extra: str) -> list[str]:
        """The command as the service's user, with the service's variables, and without any capability."""
        user, group = self.service["user"].split(":")
        assert (
            self.service["cap_drop"] == ["ALL"] and "no-new-privileges:true" in self.service["security_opt"]
        )
        drop = ["setpriv", f"--reuid={user}", f"--regid={group}", "--clear-groups", "--no-new-privs"]
        drop += ["--bounding-set=-all", "--inh-caps=-all"]
        variables = {**self.environment, **self.service.get("environment", {}), **extra}
        pairs = [f"{key}={value}" for key, value in variables.items()]
        return [*drop, "env", "-i", *pairs, "sh", "-c", 'cd /runs && exec "$@"', "sh", *command]

    def run(
        self, command: Sequence[str], *, seconds: float = 60.0, **extra: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in the running container, as ``docker compose exec`` does."""
        where = ["nsenter", "--target", str(self.pid), "--mount", "--uts", "--net", "--pid", "--root"]
        return subprocess.run(
            [*where, *self._inside(command, **extra)],
            capture_output=True,
            text=True,
            check=False,
            timeout=seconds,
        )

    @property
    def pid(self) -> int:
        """Its first process, as this machine numbers it."""
        assert self.process is not None
        [child] = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return int(child)

    def is_healthy(self) -> bool:
        _, *command = self.service["healthcheck"]["test"]
        with suppress(subprocess.TimeoutExpired, OSError, ValueError):
            return self.run(command).returncode == 0
        return False

    def kill(self) -> None:
        """End everything in it at once, as a power cut would."""
        if self.process is not None:
            with suppress(OSError, ValueError):  # the first process of a namespace takes all others with it
                os.kill(self.pid, signal.SIGKILL)
            with suppress(ProcessLookupError):
                os.kill(self.process.pid, signal.SIGKILL)
            self.process.wait()


@dataclass
class Cluster:
    """All the containers, and the networks between them.

    Attributes:
        folder: holds a copy of docker/, prepared as a user prepares it, and everything that is written.
        log: where it is told.
    """

    folder: Path
    log: TextIO
    variables: Mapping[str, str]
    began: float = field(default_factory=time.monotonic)
    containers: dict[str, Container] = field(default_factory=dict)
    networks: dict[str, str] = field(default_factory=dict)
    over: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        shutil.copytree(
            ROOT / "docker", self.folder / "docker", ignore=shutil.ignore_patterns("secrets", ".env")
        )
        subprocess.run([self.folder / "docker/prepare"], check=True, stdout=subprocess.DEVNULL)
        settings = dict(line.split("=") for line in (self.folder / "docker/.env").read_text().splitlines())
        text = interpolated((self.folder / "docker/compose.yaml").read_text(), {**settings, **self.variables})
        self.compose = yaml.safe_load(text)
        self.environment = image_environment((ROOT / "docker/Dockerfile").read_text())

    def say(self, sentence: str) -> None:
        line = f"{time.monotonic() - self.began:7.1f} s  {sentence}"
        print(line, flush=True)
        print(line, file=self.log, flush=True)

    def connect(self, launches: Sequence[str]) -> None:
        """Make the networks, and the containers of every service; ``launches`` are those of ``sweep``."""
        for number, name in enumerate(self.compose["networks"]):
            self.networks[name] = f"recrl-br{number}"
            _ip(f"link add {self.networks[name]} type bridge")
            _ip(f"link set {self.networks[name]} up")
        members: dict[str, str] = {}
        for name, service in self.compose["services"].items():
            number = int(service.get("deploy", {}).get("replicas", 1))
            copies = launches if name == "sweep" else [f"{name}-{i + 1}" for i in range(number)]
            members |= {copy: name for copy in (copies if number > 1 or name == "sweep" else [name])}
        addresses = {
            copy: {
                network: f"10.77.{list(self.networks).index(network)}.{10 + place}"
                for network in self.compose["services"][name]["networks"]
            }
            for place, (copy, name) in enumerate(members.items())
        }
        for copy, name in members.items():
            own = addresses[copy]
            names = {
                alias: addresses[other][shared[0]]
                for other, service in reversed(members.items())
                if (shared := [network for network in own if network in addresses[other]])
                for alias in (service, other)
                if other != copy
            }
            self.containers[copy] = Container(
                copy, self.compose["services"][name], own, self.folder, names, self.compose, self.environment
            )
            self._plug_in(self.containers[copy])

    def _plug_in(self, container: Container) -> None:
        _ip(f"netns add {container.namespace}")
        for network, address in container.addresses.items():
            _, _, subnet, host = address.split(".")
            ours, theirs = f"rv{subnet}-{host}", f"eth{subnet}"
            _ip(f"link add {ours} type veth peer name {theirs} netns {container.namespace}")
            _ip(f"link set {ours} master {self.networks[network]} up")
            _ip(f"-n {container.namespace} addr add {address}/24 dev {theirs}")
            _ip(f"-n {container.namespace} link set {theirs} up")

    def set_link(self, container: Container, state: str) -> None:
        for address in container.addresses.values():
            _, _, subnet, host = address.split(".")
            _ip(f"link set rv{subnet}-{host} {state}")

    def up(self) -> None:
        """Start the services that have no profile, each when those it depends on are healthy."""
        waiting = [c for c in self.containers.values() if "profiles" not in c.service]
        for container in waiting:
            for needed in container.service.get("depends_on", {}):
                self.wait_until_healthy(needed)
            container.start(["sh", "-euc", POSTGRES] if container.name == "postgres" else None)
        for container in waiting:
            self.wait_until_healthy(container.name)
        threading.Thread(target=self._keep_up, args=(waiting,), daemon=True).start()

    def wait_until_healthy(self, service: str) -> None:
        for name, container in self.containers.items():
            if name == service or name.startswith(f"{service}-"):
                if not wait_for(container.is_healthy, READY_SECONDS):
                    raise RuntimeError(f"{name} is not healthy:\n{container.output.read_text()[-3000:]}")
                self.say(f"{name} is healthy")

    def _keep_up(self, containers: Sequence[Container]) -> None:
        """What ``restart: unless-stopped`` does."""
        while not self.over.wait(1.0):
            for container in containers:
                assert container.service["restart"] == "unless-stopped"
                if container.process is not None and container.process.poll() is not None:
                    self.say(f"{container.name} has ended; it is started again")
                    container.start(
                        ["postgres", "-c", "listen_addresses=*"] if container.name == "postgres" else None
                    )

    def publish(self) -> None:
        """What Docker's proxy does for ``ports``."""
        for container in self.containers.values():
            for port in container.service.get("ports", ()):
                host, outside, inside = port.split(":")
                assert host == "127.0.0.1"
                target = (container.addresses["ui"], int(inside))
                _ip(f"addr add 10.77.{list(self.networks).index('ui')}.1/24 dev {self.networks['ui']}")
                server = socket.create_server((host, int(outside)))
                threading.Thread(target=_forward, args=(server, target), daemon=True).start()

    def down(self) -> None:
        self.over.set()
        for container in self.containers.values():
            container.kill()
        for container in self.containers.values():
            _ip(f"netns del {container.namespace}", check=False)
        for bridge in self.networks.values():
            _ip(f"link del {bridge}", check=False)


def _forward(server: socket.socket, target: tuple[str, int]) -> None:
    """Pass every connection on to the target."""

    def copy(source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_WR)

    while True:
        near, _ = server.accept()
        try:
            far = socket.create_connection(target, timeout=5.0)
            far.settimeout(None)
        except OSError:
            near.close()
            continue
        for ends in ((near, far), (far, near)):
            threading.Thread(target=copy, args=ends, daemon=True).start()


def _ip(arguments: str, *, check: bool = True) -> None:
    subprocess.run(["ip", *arguments.split()], check=check, capture_output=True)


def wait_for(condition: Callable[[], object], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.5)
    return True


def reason_not_to_run() -> str:
    """Why this machine cannot, or empty."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    missing = [tool for tool in ("ip", "nsenter", "unshare", "setpriv") if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} missing (apt-get install iproute2 util-linux)"
    if not postgres_programs():
        return "PostgreSQL's server is missing (apt-get install postgresql)"
    tried = subprocess.run(["unshare", "--net", "--mount", "--uts", "--pid", "--fork", "true"], check=False)
    return "" if tried.returncode == 0 else "this machine does not allow new namespaces"


def postgres_programs() -> str:
    """The folder of the newest PostgreSQL's programs, or empty."""
    return max(map(str, Path("/usr/lib/postgresql").glob("*/bin")), default="")


class Trouble:
    """What happens to the cluster while the sweep runs."""

    def __init__(self, cluster: Cluster, store: SweepStore) -> None:
        self.cluster = cluster
        self.store = store

    def running_on(self, name: str) -> list[TrialRecord]:
        """The trials that a node runs, as far as their files say, with something to lose."""
        records = (trial.record() for trial in self.store.trials())
        return [r for r in records if r.status is TrialStatus.RUNNING and r.host == name and r.update > 0]

    def kill(self, name: str) -> None:
        """A node loses its power while it runs a trial."""
        assert wait_for(lambda: self.running_on(name), READY_SECONDS), f"{name} runs nothing"
        container = self.cluster.containers[name]
        lost = self.running_on(name)
        container.kill()
        self.cluster.say(f"{name} is killed with all its processes; it ran {_titles(self.store, lost)}")

    def cut_off(self, name: str) -> None:
        """A node loses its network until its trial runs elsewhere; its own processes go on meanwhile."""
        assert wait_for(lambda: self.running_on(name), READY_SECONDS), f"{name} runs nothing"
        container, lost = self.cluster.containers[name], self.running_on(name)
        tokens = {record.token for record in lost}
        self.cluster.set_link(container, "down")
        self.cluster.say(f"{name} is cut off; it runs {_titles(self.store, lost)}")
        began = time.monotonic()

        def taken_over() -> bool:
            return not tokens & {trial.record().token for trial in self.store.trials()}

        taken = wait_for(taken_over, READY_SECONDS)
        seconds = time.monotonic() - began
        assert taken, f"nobody took over what {name} ran"
        self.cluster.say(f"after {seconds:.0f} seconds another node has taken over what {name} ran")
        self.cluster.set_link(container, "up")
        self.cluster.say(f"{name} is connected again")
        self.cluster.wait_until_healthy(name)

    def restart_mlflow(self) -> None:
        self.cluster.containers["mlflow"].kill()
        self.cluster.say(f"MLflow's server is killed while {1 + COPIES} processes write to it")
        time.sleep(5.0)
        self.cluster.wait_until_healthy("mlflow")

    def without_recrl(self, name: str) -> Iterator[str]:
        """What goes otherwise than it should when a node's image lacks recrl."""
        container, launch = self.cluster.containers[name], self.cluster.containers["second"]
        container.bare = True
        container.kill()
        self.cluster.say(f"{name} is killed, and comes back with an image that lacks recrl")
        time.sleep(30.0)  # until nobody believes in the old one any more
        self.cluster.wait_until_healthy(name)
        command = ["recrl-node", "run", "recrl-sweep", "launch", "/grids/shipped.yaml", "--root=/runs"]
        command += ["--address=auto", "--no-mlflow", "--no-figures"]
        for shipped, expected in (([], ExitCode.CANNOT_RUN), (["--ship-package"], ExitCode.OK)):
            launch.kill()
            launch.output.unlink(missing_ok=True)
            launch.start([*command, *shipped])
            assert launch.process is not None
            code = launch.process.wait()
            last = launch.output.read_text().splitlines()[-1]
            self.cluster.say(f"a launch {' '.join(shipped)} ends with {code}: {last}".replace("  ", " "))
            if code != expected:
                yield f"a launch with {shipped} ended with {code}"
        small = SweepStore(self.store.folder.parent, "shipped")
        hosts = sorted({trial.record().host for trial in small.trials()})
        self.cluster.say(f"the trials of the shipped recrl ran on {', '.join(hosts)}")
        if name not in hosts:
            yield f"{name} ran no trial of the shipped recrl"

    def strangers(self, port: int) -> Iterator[str]:
        """Who is let in though they should not be."""
        worker = self.cluster.containers["ray-worker-1"]
        drivers = {
            "the token": {},
            "no token": {"RAY_AUTH_MODE": "disabled"},
            "a wrong token": {"RAY_AUTH_TOKEN": "0" * 64, "RAY_AUTH_TOKEN_PATH": ""},
        }
        for who, extra in drivers.items():
            answer = worker.run(["python", "-c", KNOCK], seconds=180.0, **extra).stdout.strip()
            self.cluster.say(f"a driver with {who} is {answer}")
            if answer.startswith("refused") == (who == "the token"):
                yield f"a driver with {who} was {answer}"
        for closed in (8265, 10001):
            code = worker.run(
                ["python", "-c", f"import socket; socket.create_connection(('ray-head', {closed}), 5)"]
            )
            self.cluster.say(f"port {closed} of the head is {'closed' if code.returncode else 'OPEN'}")
            if closed == 8265 and code.returncode == 0:
                yield "the dashboard is there"
        code = worker.run(["python", "-c", "import socket; socket.create_connection(('1.1.1.1', 53), 5)"])
        if code.returncode == 0:
            yield "the cluster's network is not internal"
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/api/2.0/mlflow/experiments/search?max_results=1"
        )
        request.add_header("Host", "evil.example")
        try:
            urllib.request.urlopen(request, timeout=30.0)
            yield "MLflow answers under any name"
        except urllib.error.HTTPError as error:
            self.cluster.say(f"MLflow answers a request for evil.example: {error.code} {error.reason}")
            if error.code != 403:
                yield f"MLflow answers a request for evil.example with {error.code}"


def _titles(store: SweepStore, records: Sequence[TrialRecord]) -> str:
    tokens = {record.token for record in records}
    return ", ".join(trial.spec.title for trial in store.trials() if trial.record().token in tokens)


def single_machine(cluster: Cluster) -> SweepStore:
    """The same sweep on this machine, undisturbed."""
    command = [
        sys.executable,
        "-m",
        "recrl",
        "launch",
        str(cluster.folder / "grids/cluster.yaml"),
    ]
    command += ["--root", str(cluster.folder / "single"), "--no-figures", "--no-mlflow"]
    with (cluster.folder / "single.txt").open("ab") as out:
        code = subprocess.run(command, stdout=out, stderr=out, check=False).returncode
    cluster.say(f"the sweep on one machine ended with {code}")
    return SweepStore(cluster.folder / "single", "cluster")


def copies(expected: SweepStore, root: Path) -> list[SweepStore]:
    """Finished sweeps of other names, for other processes to send to MLflow at the same time."""
    stores = []
    for number in range(COPIES):
        store = SweepStore(root, f"copy-{number + 1}")
        shutil.copytree(expected.folder, store.folder)
        stores.append(store)
    subprocess.run(["chown", "-R", "10001:10001", str(root)], check=True)
    return stores


def check(
    cluster: Cluster, store: SweepStore, expected: SweepStore, others: Sequence[SweepStore], uri: str
) -> int:
    """Compare everything; how many things are wrong."""
    wrong = compared(store, expected, cluster.say)
    for sweep in (store, *others):
        problems = list(shown(sweep, uri))
        cluster.say(
            f"MLflow shows {sweep.name} as its files are" if not problems else f"WRONG in MLflow: {problems}"
        )
        wrong += len(problems)
    return wrong


def disturbed(cluster: Cluster, port: int, uri: str) -> int:
    """The whole story; returns how many things went wrong."""
    expected = single_machine(cluster)
    root = cluster.folder / "runs"
    others = copies(expected, root)
    names = ["sweep", "second", *(store.name for store in others)]
    cluster.connect(names)
    cluster.publish()
    cluster.up()
    store = SweepStore(root, "cluster")
    trouble = Trouble(cluster, store)
    launch = cluster.containers["sweep"]
    launch.start()
    cluster.say(f"launched: {shlex.join(launch.service['command'])}")
    trouble.kill("ray-worker-1")
    for other in others:
        tracking = ["--root", "/runs", "--tracking-uri", "http://mlflow:5000"]
        cluster.containers[other.name].start(["recrl-sweep", "sync", other.name, *tracking])
    told = [other.sync_folder for other in others]
    assert wait_for(lambda: all(any(folder.glob("*/trial-*.json")) for folder in told), READY_SECONDS)
    trouble.restart_mlflow()
    trouble.cut_off("ray-worker-2")
    refused = list(trouble.strangers(port))
    for problem in refused:
        cluster.say(f"WRONG {problem}")
    assert launch.process is not None
    code = launch.process.wait()
    cluster.say(f"the launch ended with {code}")
    print(launch.output.read_text(), file=cluster.log)
    for other in others:  # those that met a dead server say so and are asked again
        while (process := cluster.containers[other.name].process) is not None and process.wait() != 0:
            cluster.say(f"{other.name}: {cluster.containers[other.name].output.read_text().splitlines()[-1]}")
            time.sleep(2.0)
            cluster.containers[other.name].start(["recrl-sweep", "sync", other.name, *tracking])
    wrong = (code != 0) + len(refused) + check(cluster, store, expected, others, uri)
    for problem in trouble.without_recrl("ray-worker-2"):
        cluster.say(f"WRONG {problem}")
        wrong += 1
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Run docker/compose.yaml's cluster in namespaces, and harm it."
    )
    parser.add_argument("--steps", type=int, default=600_000, help="of a trial")
    parser.add_argument("--log", type=Path, default=Path(os.devnull), help="write what happened there too")
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # also in the background
    reason = reason_not_to_run()
    if reason:
        print(f"skipped: {reason}")
        return 0
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    variables = {"RECRL_CPUS": "1", "RECRL_GRID": "cluster.yaml", "MLFLOW_PORT": str(port)}
    os.environ["PATH"] += f":{postgres_programs()}"
    given.log.parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="cluster-", ignore_cleanup_errors=True) as name,
        given.log.open("w") as log,
    ):
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "grids").mkdir()
        (folder / "grids/cluster.yaml").write_text(GRID.format(steps=given.steps))
        (folder / "grids/shipped.yaml").write_text(SMALL_GRID)
        print(f"python -m tests.faults.cluster {' '.join(sys.argv[1:])}", file=log, flush=True)
        cluster = Cluster(folder, log, variables)
        cluster.environment["PATH"] += f":{postgres_programs()}"
        try:
            wrong = disturbed(cluster, port, f"http://127.0.0.1:{port}")
        finally:
            cluster.down()
        cluster.say("everything agrees" if not wrong else f"NOT everything agrees: {wrong} things are wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
