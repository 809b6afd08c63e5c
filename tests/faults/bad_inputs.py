"""Inputs that are wrong, each of which must be answered by a sentence and an exit code, never by a traceback.

    python tests/faults/bad_inputs.py [--every 1]

Grids, options, names, paths, compact files, plug-ins and command lines, given to the command line as it is.
An answer is clear if the exit code says that something is wrong, the standard error says what, and nothing in
it is Python's own: no traceback, no attribute that an object lacks, no name of a private function. Prints how
many were tried and how many are clear, and ends with 0 if all are.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import signal
import sys
import tempfile
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from recrl.orchestrator.cli.main import main

GRID: dict[str, Any] = {
    "name": "small",
    "tasks": [{"name": "two-state", "deploy_limits": 2}],
    "agents": ["ppo-lag"],
    "methods": ["none", "linear"],
    "seeds": 1,
    "run": {
        "total_steps": 160,
        "deploy_fraction": 0.5,
        "num_envs": 4,
        "rollout_steps": 10,
        "evaluation_episodes": 2,
    },
}
INLINE = ("--executor", "inline", "--no-mlflow", "--no-figures")
LONG = "x" * 5000
SECONDS = 60  # that an answer may take
# What only Python says, or what nobody but us knows.
NOT_CLEAR = (
    "Traceback",
    "object has no attribute",
    "NoneType",
    "object at 0x",
    "[Errno",
    "_at_least",
    "invalid _",
    "<class",
    "Namespace(",
    "string indices",
    "not subscriptable",
    "unhashable",
)
GRID_COMMANDS = ("validate", "plan", "launch")
SWEEP_COMMANDS = ("status", "stop", "logs", "evaluate", "figures", "export", "bound", "ui", "sync")
ALL = (*GRID_COMMANDS, *SWEEP_COMMANDS, "replay")


@dataclass(frozen=True)
class Case:
    """One wrong input.

    Attributes:
        name: what is wrong.
        arguments: the command line.
        prepare: makes the files it needs in the working directory.
        says: what the answer must hold.
        may_pass: whether an answer with exit code 0 is clear, too: it is right in another way.
    """

    name: str
    arguments: tuple[str, ...]
    prepare: Callable[[], object] = lambda: None
    says: str = ""
    may_pass: bool = False


@dataclass(frozen=True)
class Answer:
    """What came of a case."""

    case: Case
    code: int | None
    text: str
    problem: str


def write(name: str, content: str | bytes) -> Callable[[], object]:
    data = content.encode() if isinstance(content, str) else content
    return lambda: Path(name).write_bytes(data)


def changed(*place: str | int, to: Any) -> str:
    """The grid with one value changed, as YAML."""
    grid: Any = json.loads(json.dumps(GRID))
    inner = grid
    for part in place[:-1]:
        inner = inner.setdefault(part, {}) if isinstance(inner, dict) else inner[part]
    inner[place[-1]] = to
    return yaml.safe_dump(grid, allow_unicode=True)


def grids() -> Iterator[Case]:
    """Files that are no grid, and grids with a wrong value."""
    wholes: dict[str, str | bytes] = {
        "empty": "",
        "blank": "   \n\n",
        "a list": "[1, 2]",
        "a word": "grid",
        "a number": "7",
        "null": "null",
        "NUL bytes": b"\0" * 64,
        "not UTF-8": b"name: \xff\xfe\n",
        "UTF-16": "name: small".encode("utf-16"),
        "a tab": "name:\n\t- x",
        "an open quote": 'name: "small',
        "an open list": "tasks: [",
        "a Python tag": "name: !!python/object/apply:os.system [ls]",
        "another tag": "name: !x y",
        "two documents": "name: a\n---\nname: b\n",
        "a key twice": "name: a\nname: b\n",
        "an alias to nothing": "name: *x",
        "an alias to itself": "name: &x [*x]",
        "laughs": "a: &a [x,x,x,x,x,x,x,x,x]\n"
        + "".join(
            f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        ),
        "very deep": "x: " + "[" * 500 + "]" * 500,
        "2 MB": "name: " + "a" * 2_000_000,
        "a merge key": "<<: 3\nname: a",
        "a complex key": "? [a, b]\n: c\n",
        "control characters": 'name: "a\\x1b[31m"',
    }
    for name, content in wholes.items():
        yield Case(f"grid: {name}", ("validate", "g.yaml"), write("g.yaml", content))
    bad: dict[tuple[str | int, ...], list[Any]] = {
        ("name",): [
            None,
            7,
            "",
            ".",
            "..",
            "../x",
            "a/b",
            "a b",
            "a\nb",
            "-x",
            "é",
            "x" * 65,
            [],
            {},
            True,
            "a\0",
        ],
        ("tasks",): [None, [], {}, "two-state", 3, [None], [3], [[]], [{}], ["nope"], ["two-stat"], [""]],
        ("agents",): [None, [], {}, "ppo-lag", [None], [{}], ["nope"], ["ppo_lag"], [""], [{"name": 3}]],
        ("methods",): [None, [], {}, "none", [None], [{}], ["nope"], ["none", "none"], [""], [{"x": 3}]],
        ("seeds",): [None, 0, -1, 1.5, "3", [], [0, 0], [-1], [2**63], [True], {}, 10**9, [1.5]],
        ("run",): [None, [], 3, {}, "long"],
        ("run", "total_steps"): [
            None,
            0,
            -1,
            1.5,
            "many",
            True,
            [],
            {},
            10**13,
            float("nan"),
            float("inf"),
            39,
        ],
        ("run", "deploy_fraction"): [None, -0.1, 0.95, 1, "half", True, [], float("nan"), float("inf")],
        ("run", "num_envs"): [None, 0, -4, 1.5, "four", True, [], 10**6, float("nan")],
        ("run", "rollout_steps"): [0, -1, 1.5, "ten", True, [], 10**9, float("inf")],
        ("run", "evaluation_episodes"): [None, -1, 1.5, "all", True, [], 10**9],
        ("run", "videos"): ["some", 3, True, [], None],
        ("run", "total_step"): [160],
        ("tasks", 0, "deploy_limits"): [
            -1,
            "two",
            [1, 2],
            [],
            True,
            float("inf"),
            float("nan"),
            {},
            [None],
            [[1]],
        ],
        ("tasks", 0, "train_limits"): [-1, "automatic", [1, 2], [], True, 1, float("nan"), {}, [None]],
        ("tasks", 0, "label"): [3, "x" * 61, "\x1b[31mred", "a\nb", [], {}, True, "\u202eabc"],
        ("tasks", 0, "name"): [
            None,
            3,
            "",
            "os:",
            ":x",
            "a:b:c",
            "nope.nope:x",
            "x" * 300,
            [],
            "\x1b]0;x\x07",
        ],
        ("tasks", 0, "options"): [
            None,
            3,
            [],
            {"x": 1},
            {"horizon": "ten"},
            {"horizon": 0},
            {"horizon": 1.5},
        ],
        ("tasks", 0, "weight"): [1],
        ("agents", 0): [{"name": "ppo-lag", "options": {"discount": 2}}, {"name": "ppo-lag", "options": [1]}],
        ("methods", 0): [
            {"name": "linear", "options": {"windw": 2}},
            {"name": "dynamic", "options": {"window": 0}},
        ],
        ("resources",): [None, 3, [], {"cpus": 1}],
        ("resources", "cpus_per_trial"): [0, -1, "two", True, float("inf"), 10**9],
        ("resources", "gpus_per_trial"): [-1, "one", True, float("nan"), 100],
        ("resources", "custom_per_trial"): [3, [], {"CPU": 1}, {"": 1}, {"x": 0}, {"x": "y"}, {"a b": 1}],
        ("resources", "max_concurrent"): [0, -1, 1.5, "all", True, 10**9],
        ("resources", "teacher"): ["remote", 3, None],
        ("resources", "silence_seconds"): [0, -1, "long", True, float("inf")],
        ("exclude",): [3, {}, [3], [{}], [{"task": "nope"}], [{"tsk": "x"}], [{"seed": "x"}], [{"seed": 7}]],
        ("train_limits",): ["automatic", -1, True, {}, [[1]]],
        ("deploy_limits",): ["low", float("inf"), True],
        ("sweep",): ["x"],
    }
    for place, values in bad.items():
        for value in values:
            where = ".".join(map(str, place))
            text = changed(*place, to=value)
            command = ("validate", "g.yaml", "--trust")
            yield Case(f"grid: {where} is {value!r:.40}", command, write("g.yaml", text))


def commands() -> Iterator[Case]:
    """Every command, with a wrong grid, root, object store or too much."""
    for command in ALL:
        more = ("--teacher", "linear") if command == "replay" else ()
        quick = INLINE if command == "launch" else ()
        for name in ("nope.yaml", "folder.yaml", "list.yaml", "bad-name.yaml", "empty.yaml", f"{LONG}.yaml"):
            prepare = _wrong_files if command in ALL else _nothing
            yield Case(f"{command} {name[:20]}", (command, name, *more, *quick), prepare)
        target = "grid.yaml" if command in GRID_COMMANDS else "small"
        if command != "validate":
            for root in ("grid.yaml", LONG, "/dev/null", "s3://bucket/x", "grid.yaml/below"):
                yield Case(f"{command} --root {root[:20]}", (command, target, *more, *quick, "--root", root))
            for uri in (
                "x",
                "://",
                "s3://",
                "nope://x",
                "s3://k:s@b",
                "s3://b?x=1",
                "memory://",
                "file://",
                "file://store",
                "a::b://c",
            ):
                arguments = (command, target, *more, *quick, "--storage", uri)
                yield Case(f"{command} --storage {uri}", arguments, may_pass=uri == "file://")
        yield Case(f"{command} with an unknown option", (command, target, *more, "--nope"))
        yield Case(f"{command} with too much", (command, target, *more, "a", "b", "--", "c"))


def options() -> Iterator[Case]:
    """Options with wrong values."""
    whole = {
        "--cores": ("plan", "grid.yaml"),
        "--max-concurrent": ("plan", "grid.yaml"),
        "--episodes": ("evaluate", "small"),
        "--seed": ("evaluate", "small"),
        "--cost": ("bound", "small"),
        "--port": ("ui", "small"),
    }
    for option, arguments in whole.items():
        for value in ("1e9", "-1", "", "1.5", "nan", "many", "9" * 30, "٣", "0x10", "1_000", "true", " 1"):
            yield Case(f"{option} {value!r:.20}", (*arguments, f"{option}={value}"))
    for value in ("nan", "inf", "-inf", "", "much", "1e999"):
        yield Case(f"--budget {value!r}", ("bound", "small", f"--budget={value}"))
    for value in (
        "x",
        "=",
        "a=b",
        "method=",
        "=none",
        "method=nope",
        "seed=x",
        "task=../x",
        "method=none,",
        "\x1b=\x1b",
    ):
        for command in (("plan", "grid.yaml"), ("evaluate", "small")):
            yield Case(f"{command[0]} --only {value!r}", (*command, f"--only={value}"))
        yield Case(f"plan --only {value!r} before", ("plan", "--only", value, "grid.yaml"))
    for value in ("x", "=", "window", "window=", "window=0", "windw=3", "window=[", "window=NaN", "=3"):
        line = ("replay", "small", "--teacher", "dynamic", "--option", value)
        yield Case(f"replay --option {value!r}", line)
    for value in ("", "nope", "os:system", "x:y:z", "../x", "\x1b[31m"):
        yield Case(f"replay --teacher {value!r}", ("replay", "small", "--teacher", value))
    uris = (
        "",
        "x",
        "http://",
        "sqlite://",
        "sqlite:///",
        "ftp://x",
        "http://me:CANARY@",
        "sqlite:///nope/no.db",
        "http:// x",
    )
    for uri in uris:
        yield Case(f"figures --tracking-uri {uri!r}", ("figures", "small", "--tracking-uri", uri))


def paths() -> Iterator[Case]:
    """Wrong files, folders, sweeps and trials."""
    yield Case("export to a folder", ("export", "small", "--to", "folder.yaml"), _wrong_files)
    for to in ("x.txt", "", "grid.yaml/x.zip", f"{LONG}.zip", "\0.zip", "/dev/null/x.zip", "/proc/x.zip"):
        yield Case(f"export --to {to!r:.20}", ("export", "small", "--to", to))
    for to in ("grid.yaml", "/dev/null", LONG, "grid.yaml/x", "\0", "/proc/x", "s3://x"):
        yield Case(f"figures --to {to!r:.20}", ("figures", "small", "--to", to))
    for sweep in (
        "nope",
        "smal",
        "",
        ".",
        "..",
        "../small",
        "/",
        "small/",
        "a/b",
        "\x1b[31m",
        LONG,
        "*",
        "\0",
        "-",
    ):
        yield Case(f"status {sweep!r:.20}", ("status", sweep))
    for trial in ("nope", "..", "../..", "*", "\x1b[31m", LONG, "\0", "0"):
        yield Case(f"logs small {trial!r:.20}", ("logs", "small", trial), may_pass=trial == "0")
        yield Case(f"evaluate small {trial!r:.20}", ("evaluate", "small", trial), may_pass=trial == "0")


def lines() -> Iterator[Case]:
    """Whole command lines."""
    for line in (
        (),
        ("nope",),
        ("lanch", "grid.yaml"),
        ("launch",),
        ("plan",),
        ("validate",),
        ("validate", "grid.yaml", "--root", "x"),
        ("replay", "small"),
        ("merge", "a.zip"),
        ("merge", "--to", "x.zip"),
        ("merge", "small", "--to", "x.zip"),
        ("merge", "nope.zip", "--to", "x.zip"),
        ("merge", "grid.yaml", "--to", "x.zip"),
        ("launch", "grid.yaml", "--executor", "slurm"),
        ("launch", "grid.yaml", "--address", "http://x"),
        ("launch", "grid.yaml", "--address", "nowhere:1"),
        ("launch", "grid.yaml", "--address", "127.0.0.1:x"),
        ("launch", "grid.yaml", "--ship-package"),
        ("launch", "grid.yaml", *INLINE, "--tracking-uri", "x", "--storage", "x"),
        ("plan", "grid.yaml", "--cores", "2", "--address", "x:1"),
        ("plan", "--address", "127.0.0.1:1", "grid.yaml"),
        ("evaluate", "small", "--video=avi"),
        ("evaluate", "--video", "nope"),
        ("evaluate", "small", "--policy", "best"),
        ("figures", "small", "--band", "median"),
        ("ui", "small", "--port", "70000"),
        ("bound", "small", "--cost", "2"),
        ("figures", "nope.zip"),
        ("export", "nope.zip"),
        ("bound", "nope.zip"),
        ("--nope",),
        ("-x",),
        ("--version", "--nope", "nope"),
    ):
        yield Case(f"line: {' '.join(line)}", line, may_pass=line[:1] == ("--version",))


def _nothing() -> None:
    pass


def _wrong_files() -> None:
    Path("folder.yaml").mkdir(exist_ok=True)
    Path("list.yaml").write_text("[1]\n")
    Path("bad-name.yaml").write_text(changed("name", to="../x"))
    Path("empty.yaml").write_text("")


def _compact_cases(name: str, make: Callable[[], object], some: int = 1) -> Iterator[Case]:
    """A wrong compact file, given to the first few commands that read one."""
    commands = (("figures",), ("export", "--to", "out.zip"), ("bound",), ("merge", "--to", "out.zip"))
    for command, *more in commands[:some]:
        yield Case(f"{command} of a file {name}", (command, "evil.zip", *more), make)


def archives() -> Iterator[Case]:
    """Compact files that were not written by ``export``."""
    cases = _compact_cases
    for name, data in {
        "that is empty": b"",
        "that is text": b"hello",
        "of zeros": b"\0" * 5000,
        "that only begins like a zip": b"PK\x03\x04" + b"x" * 100,
        "that is an empty zip": b"PK\x05\x06" + b"\0" * 18,
    }.items():
        yield from cases(name, write("evil.zip", data), 4)
    yield from cases("that is a folder", lambda: Path("evil.zip").mkdir(), 4)
    yield from cases("that is cut", _cut, 4)
    for at in (0.1, 0.3, 0.5, 0.7, 0.9):
        yield from cases(f"with bytes flipped at {at:.0%}", partial(_flip, at))
    yield from cases("that is a bomb", _bomb, 4)
    yield from cases("that says it is small", _liar)
    yield from cases("with bzip2", lambda: _repack(zipfile.ZIP_BZIP2))
    yield from cases("with links", _linked, 4)


def changed_archives() -> Iterator[Case]:
    """Compact files in which something was changed."""
    cases = _compact_cases
    values: list[Any] = [None, 3, "x", [], {}, True, [1], {"a": 1}, float("nan")]
    for key in ("format", "name", "notes", "grid", "provenance", "trials"):
        for value in values:
            if (key, value) in (
                ("notes", []),
                ("provenance", []),
                ("trials", []),
                ("grid", "x"),
                ("name", "x"),
            ):
                continue
            yield from cases(f"whose {key} is {value!r}", partial(_edit, {key: value}))
        yield from cases(f"without {key}", partial(_edit, {}, without=key))
    for name in (
        "../evil",
        "/tmp/evil",
        "..",
        ".",
        "",
        "a/b",
        "a\\b",
        "\x1b[31m",
        "x" * 300,
        ".hidden",
        "a\nb",
        "a\0b",
        "~",
    ):
        yield from cases(f"named {name!r:.20}", partial(_edit, {"name": name}), 4)
    for key in ("spec", "status", "error", "env_steps", "cpu_seconds", "start_limits", "provenance"):
        for value in ("x", -1, [], {}, True, 10**30, float("nan")):
            if (key, value) == ("error", "x"):
                continue
            make = partial(_edit, {key: value}, "trials", 0)
            yield from cases(f"with a trial whose {key} is {value!r:.20}", make)
    for key in (
        *("task", "agent", "method"),
        "train_limits",
        "deploy_limits",
        "train_steps",
        "num_envs",
        "seed",
    ):
        for value in (
            None,
            "x",
            -1,
            [],
            {},
            True,
            [1, 2, 3],
            {"name": "../x", "options": 3, "label": "\x1b[2J"},
        ):
            make = partial(_edit, {key: value}, "trials", 0, "spec")
            yield from cases(f"with a spec whose {key} is {value!r:.20}", make)
    for member in ("phases.csv", "updates.csv", "evaluations.csv", "events.csv", "policies.csv"):
        for text in (
            "",
            "x\n",
            "trial\nx\n",
            "trial,a\n-1,2\n",
            "trial,a\n99,2\n",
            "a,b\n1,2,3\n1\n",
            '"',
            "\0\0",
        ):
            yield from cases(f"whose {member} is {text!r}", partial(_replace, member, text.encode()))
        yield from cases(f"without {member}", partial(_replace, member, None))


def _read_good() -> dict[str, bytes]:
    with zipfile.ZipFile("good.zip") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _pack(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile("evil.zip", "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def _edit(changes: dict[str, Any], *place: str | int, without: str = "") -> None:
    """Change some keys of sweep.json, at a place in it, without its digest."""
    members = _read_good()
    told = json.loads(members["sweep.json"])
    del told["digests"]["sweep.json"]
    inner = told
    for part in place:
        inner = inner[part]
    inner.update(changes)
    inner.pop(without, None)
    _pack({**members, "sweep.json": json.dumps(told).encode()})


def _replace(member: str, data: bytes | None) -> None:
    members = _read_good()
    members.pop(member)
    _pack(members if data is None else {**members, member: data})


def _cut() -> None:
    Path("evil.zip").write_bytes(Path("good.zip").read_bytes()[:-200])


def _repack(method: int) -> None:
    _pack(_read_good(), method)


def _flip(at: float) -> None:
    data = bytearray(Path("good.zip").read_bytes())
    for offset in range(20):
        data[int(at * len(data)) + offset] ^= 0xFF
    Path("evil.zip").write_bytes(data)


def _bomb() -> None:
    Path("evil.zip").write_bytes(_bomb_of(Path("good.zip").read_bytes()))


@functools.cache  # packing 600 MiB takes seconds
def _bomb_of(good: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {**members, "updates.csv": b"0" * 600 * 2**20}.items():
            archive.writestr(name, data)
    return packed.getvalue()


def _liar() -> None:
    _pack({**_read_good(), "updates.csv": b"0" * 2**20})
    data = Path("evil.zip").read_bytes()
    Path("evil.zip").write_bytes(data.replace((2**20).to_bytes(4, "little"), (16).to_bytes(4, "little")))


def _linked() -> None:
    with zipfile.ZipFile("evil.zip", "w") as archive:
        for name, data in _read_good().items():
            info = zipfile.ZipInfo(name)
            info.external_attr = 0o120777 << 16
            archive.writestr(info, b"/etc/passwd" if name == "sweep.json" else data)


PLUGIN = """\
import sys
import gymnasium
import numpy as np

class Broken(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        return {reset}
    def step(self, action):
        observation, reward, info = np.zeros(2), 1.0, {{"cost": 1.0}}
        {step}
        return {returned}

def make(**options):
    {make}
    return Broken()
{top}
"""
WHOLE = "observation, reward, False, False, info"


def plugins() -> Iterator[Case]:
    """Tasks of a user's own that are wrong, checked and run."""

    def case(
        name: str,
        *,
        top: str = "",
        make: str = "pass",
        step: str = "pass",
        reset: str = "np.zeros(2), {}",
        returned: str = WHOLE,
    ) -> Iterator[Case]:
        module = "plug_" + "".join(letter if letter.isalnum() else "_" for letter in name)
        text = PLUGIN.format(top=top, make=make, step=step, reset=reset, returned=returned)
        grid = changed("tasks", 0, "name", to=f"{module}:make")

        def prepare() -> None:
            Path(f"{module}.py").write_text(text)
            Path("g.yaml").write_text(grid)

        command = (
            ("validate", "g.yaml", "--trust") if top or make != "pass" else ("launch", "g.yaml", *INLINE)
        )
        yield Case(f"task: {name}", command, prepare, says=module)

    yield from case("exits when imported", top="sys.exit(5)")
    yield from case("raises when imported", top="raise RuntimeError('no')")
    yield from case("exits when made", make="sys.exit(5)")
    yield from case("raises when made", make="raise KeyError('x')")
    yield from case("is no environment", make="return 3")
    yield from case("is None", make="return None")
    yield from case("returns NaN observations", step="observation[0] = np.nan")
    yield from case("returns infinite observations", step="observation[0] = np.inf")
    yield from case("returns too long observations", step="observation = np.zeros(3)")
    yield from case("returns text observations", step="observation = 'x'")
    yield from case("returns no observation", step="observation = None")
    yield from case("returns NaN rewards", step="reward = float('nan')")
    yield from case("returns infinite rewards", step="reward = float('inf')")
    yield from case("returns no reward", step="reward = None")
    yield from case("returns text as reward", step="reward = 'x'")
    yield from case("returns two rewards", step="reward = np.zeros(2)")
    yield from case("returns NaN costs", step="info['cost'] = float('nan')")
    yield from case("returns negative costs", step="info['cost'] = -1.0")
    yield from case("returns two costs", step="info['cost'] = [1.0, 2.0]")
    yield from case("returns no cost", step="info.clear()")
    yield from case("returns text as cost", step="info['cost'] = 'x'")
    yield from case("returns no info", step="info = None")
    yield from case("returns four values", returned="observation, reward, False, info")
    yield from case("returns nothing", returned="None")
    yield from case("resets to NaN", reset="np.full(2, np.nan), {}")
    yield from case("resets to nothing", reset="None")
    yield from case("resets without info", reset="np.zeros(2)")
    yield from case("exits in a step", step="sys.exit(5)")
    yield from case("raises in a step", step="raise RuntimeError('no')")
    for kind, name in (
        ("agents", "os:system"),
        ("methods", "os:system"),
        ("tasks", "os:getpid"),
        ("tasks", "os:nope"),
    ):
        for value in (name, {"name": name, "options": {"command": "true"}}):
            grid = changed(
                kind,
                to=[{"deploy_limits": 2, **value} if isinstance(value, dict) and kind == "tasks" else value],
            )
            yield Case(
                f"{kind}: {value!r:.60}", ("validate", "g.yaml", "--trust"), write("g.yaml", grid), says=name
            )
    for identifier in ("nope:CartPole-v1", "os:Nope-v0", ":", "a:b:c", "CartPole-v99", "", "nope/x", "\x1b"):
        grid = changed(
            "tasks", 0, to={"name": "gymnasium", "deploy_limits": 1, "options": {"id": identifier}}
        )
        yield Case(f"gymnasium id {identifier!r}", ("validate", "g.yaml", "--trust"), write("g.yaml", grid))


def cases() -> list[Case]:
    kinds = (grids, commands, options, paths, lines, archives, changed_archives, plugins)
    return [case for kind in kinds for case in kind()]


@contextlib.contextmanager
def workplace(folder: Path) -> Iterator[None]:
    """Put a right grid, a finished sweep ``small`` and its compact file into a folder, and work there."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        Path("grid.yaml").write_text(yaml.safe_dump(GRID))
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert main(["launch", "grid.yaml", *INLINE]) == 0
            assert main(["export", "small", "--to", "good.zip"]) == 0
        yield
    finally:
        os.chdir(before)


def ask(case: Case, home: Path) -> Answer:
    """Give one case to the command line, in a folder of its own that has the workplace's files."""
    with tempfile.TemporaryDirectory(prefix="case-", dir=home) as name:
        for shared in ("grid.yaml", "good.zip", "runs"):
            Path(name, shared).symlink_to(home / shared)
        os.chdir(name)
        sys.path.insert(0, name)
        out, err = io.StringIO(), io.StringIO()
        code: Any = None
        try:
            case.prepare()
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _at_most(SECONDS):
                code = main(list(case.arguments))
        except SystemExit as end:
            code = end.code
        except BaseException:
            err.write(traceback.format_exc())
        finally:
            sys.path.remove(name)
            os.chdir(home)
        text = err.getvalue() + (out.getvalue() if code == 1 else "")
        outside = sorted(path.name for path in home.iterdir() if path.name.startswith("evil"))
    return Answer(case, code, text, f"wrote {outside}" if outside else _problem(case, code, text))


@contextlib.contextmanager
def _at_most(seconds: int) -> Iterator[None]:
    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"no answer within {seconds} seconds")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _problem(case: Case, code: Any, text: str) -> str:
    """Why an answer is not clear; empty if it is."""
    found = [f"says {word!r}" for word in NOT_CLEAR if word in text]
    checks = {
        "was accepted": code == 0 and not case.may_pass,
        f"ended with {code!r}": code not in (0, 1, 2, 3, 4),
        "says nothing": code and not text.strip(),
        f"does not name {case.says!r}": case.says not in text,
        "shows what it should not": "\x1b" in text or "CANARY" in text,
        "is too long": len(text) > 10_000,
    }
    return next(iter([*found, *(problem for problem, holds in checks.items() if holds)]), "")


def run() -> int:
    parser = argparse.ArgumentParser(description="Give everything that is wrong to the command line.")
    parser.add_argument("--every", type=int, default=1, help="only every n-th case")
    given = parser.parse_args()
    chosen = cases()[:: given.every]
    answers = []
    with tempfile.TemporaryDirectory(prefix="bad-inputs-") as name, workplace(Path(name)):
        for case in chosen:
            answers.append(ask(case, Path(name)))
            if answers[-1].problem:
                last = answers[-1].text.strip().splitlines()[-1:] or [""]
                print(f"{case.name}: {answers[-1].problem}: {last[0][:300]}", flush=True)
    clear = sum(not answer.problem for answer in answers)
    tracebacks = sum("Traceback" in answer.text for answer in answers)
    print(f"{len(answers)} tried, {clear} clear, {tracebacks} with a traceback")
    return 0 if clear == len(answers) else 1


if __name__ == "__main__":
    sys.exit(run())
