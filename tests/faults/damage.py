"""Damage every file of a sweep in every way, and look what every command makes of it.

A case is one command after one damage. It is right if nothing is raised, and if what is printed with the exit
code 0 is what was printed of the undamaged sweep, but for the damaged trial, which is then named. After the
reading commands ``launch --rerun-damaged`` must bring the undamaged sweep's results back, byte by byte.

    python -m tests.faults.damage --cases 3000 --seed 0
"""

from __future__ import annotations

import argparse
import io
import itertools
import logging
import shutil
import sys
import tempfile
import threading
import traceback
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from recrl.orchestrator.cli.main import main as recrl_sweep
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.run_sweep import SweepRunSettings, run_sweep
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import sync
from recrl.orchestrator.trial.attempt import run_recorded

GRID = """\
name: {name}
tasks: [{{name: two-state, deploy_limits: {limit}, options: {{horizon: 5}}}}]
agents: [{{name: ppo-lag, options: {{hidden_sizes: [4], policy_steps: 2, critic_steps: 2}}}}]
methods: [none, linear]
seeds: 1
run: {{total_steps: 120, deploy_fraction: 0.5, num_envs: 2, rollout_steps: 10, evaluation_episodes: 2}}
"""
STOPPED_AFTER = 3  # updates of six, in the sweep that was interrupted
NAME = "small"
READING: dict[str, tuple[str, ...]] = {
    "status": ("status", NAME),
    "plan": ("plan", "grid.yaml"),
    "check": ("check", NAME),
    "logs": ("logs", NAME, "two-state ppo-lag linear"),
    "export": ("export", NAME, "--to", "small.zip"),
    "evaluate": ("evaluate", NAME),
}
SLOW: dict[str, tuple[str, ...]] = {
    "merge": ("merge", "small.zip", "small.zip", "--to", "merged.zip"),
    "bound": ("bound", NAME),
    "replay": ("replay", NAME, "--teacher", "linear"),
    "figures": ("figures", NAME, "--sketch"),
    "sync": ("sync", NAME),
}
DATABASE = Path("runs") / NAME / "mlflow.db"
LAUNCH = ("launch", "grid.yaml", "--executor", "inline", "--no-mlflow", "--no-figures")
LAUNCHES: dict[str, tuple[str, ...]] = {
    "launch": LAUNCH,
    "launch --rerun-damaged": (*LAUNCH, "--rerun-damaged"),
}
SLOW_SHARES = {"merge": 0.25, "bound": 0.25, "replay": 0.02, "figures": 0.02, "sync": 0.04}  # of the damages
LAUNCH_SHARE = 0.3
DAMAGES = ("cut", "emptied", "deleted", "flipped", "another's", "a folder")
UNCOMMITTED = ("log.txt", "lock", ".lock", ".reserve")  # nothing is read from these but a log
RESULTS = ("episodes.csv", "events.jsonl", "evaluation.csv", "policy.csv")
# Lines that sum up what is there: they may change where a trial is said to be damaged.
SUMMARIES = (
    f"{NAME}: ",
    f"{NAME}.zip: ",
    "merged.zip: ",
    "about ",
    "time unknown",
    "nothing to do",
    "launch continues damaged",
    "its files: ",
)


@dataclass(frozen=True)
class Said:
    """What a command ended with.

    Attributes:
        code: its exit code; None if it raised.
        out: what it printed.
        err: its errors, or the traceback.
    """

    code: int | None
    out: str
    err: str

    @cached_property
    def lines(self) -> list[str]:
        """What it printed, without blanks that only align."""
        return [" ".join(line.split()) for line in self.out.splitlines()]


@dataclass
class Sweep:
    """An undamaged sweep, and what the commands say of it.

    Attributes:
        folder: that holds ``grid.yaml`` and ``runs/small``.
        other: one of the same files and other contents.
        said: of each command.
        tables: of its export, by the member's name.
    """

    folder: Path
    other: Path
    said: dict[str, Said] = field(default_factory=dict)
    tables: dict[str, list[str]] = field(default_factory=dict)

    @property
    def files(self) -> list[Path]:
        """Every file and folder of the sweep, as paths below its folder."""
        root = self.folder / "runs" / NAME
        return sorted(path.relative_to(root) for path in root.rglob("*"))


@dataclass(frozen=True)
class Damage:
    """What is done to one file.

    Attributes:
        path: below the sweep's folder.
        kind: of DAMAGES.
        place: where, as a share of the file's bytes, in [0, 1).
        bits: flipped there, 1 to 255.
    """

    path: Path
    kind: str
    place: float = 0.5
    bits: int = 1

    def __str__(self) -> str:
        where = f" at {self.place:.3f} by {self.bits}" if self.kind in ("cut", "flipped") else ""
        return f"{self.path}: {self.kind}{where}"

    def do(self, folder: Path, other: Path) -> bool:
        """Damage the sweep in a folder; whether that changed anything.

        Args:
            folder: with ``runs/small``.
            other: an undamaged sweep to take another's files from.
        """
        path = folder / "runs" / NAME / self.path
        if path.is_dir():
            if self.kind != "deleted":
                shutil.rmtree(path)
                path.write_text("a file where a folder should be\n")
                return self.kind == "emptied"
            shutil.rmtree(path)
            return True
        before = path.read_bytes()
        place = int(self.place * len(before))
        match self.kind:
            case "cut":
                path.write_bytes(before[:place])
            case "emptied":
                path.write_bytes(b"")
            case "flipped" if before:
                path.write_bytes(before[:place] + bytes([before[place] ^ self.bits]) + before[place + 1 :])
            case "another's":
                path.write_bytes(self._others(folder, other) or before)
            case "deleted" | "a folder":
                path.unlink()
                if self.kind == "a folder":
                    path.mkdir()
                    (path / "something").touch()
                return bool(before) or self.kind == "a folder"
        return path.read_bytes() != before

    def _others(self, folder: Path, other: Path) -> bytes:
        """The file of this name of the other trial; of the other sweep where it is the sweep's."""
        if self.path.parts[0] != "trials":
            path = other / "runs" / NAME / self.path
            return path.read_bytes() if path.is_file() else b""
        trials = sorted((folder / "runs" / NAME / "trials").iterdir())
        below = Path(*self.path.parts[2:])
        found = [trial / below for trial in trials if trial.name != self.path.parts[1]]
        return next((path.read_bytes() for path in found if path.is_file()), b"")


def make(folder: Path, *, interrupted: bool, limit: float = 0.5) -> Path:
    """Run a sweep of two trials, the second of which is interrupted if it is to be; returns its folder."""
    folder.mkdir(parents=True)
    (folder / "grid.yaml").write_text(GRID.format(name=NAME, limit=limit))
    grid = read_grid(folder / "grid.yaml")
    store = SweepStore(folder / "runs", NAME)
    executor = _Interrupted() if interrupted else InlineExecutor()
    run_sweep(SweepRunSettings(grid, SweepPlace(store), executor), stop=threading.Event())
    return folder


@dataclass(frozen=True)
class _Interrupted:
    """An executor that stops the last trial half way, with two checkpoints."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        for spec in specs:
            answers = itertools.chain([False] * STOPPED_AFTER, itertools.repeat(spec is specs[-1]))
            run_recorded(spec, place.store.trial(spec), should_stop=lambda: next(answers), commit_seconds=0.0)  # noqa: B023


def say(folder: Path, arguments: Sequence[str]) -> Said:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    handler = logging.StreamHandler(err)
    logging.getLogger("recrl").addHandler(handler)
    try:
        with chdir(folder), redirect_stdout(out), redirect_stderr(err):
            code = int(recrl_sweep(list(arguments)))
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        return Said(None, out.getvalue(), traceback.format_exc())
    finally:
        logging.getLogger("recrl").removeHandler(handler)
    return Said(code, out.getvalue(), err.getvalue())


def tables_of(path: Path) -> dict[str, list[str]]:
    """The tables of a compact file, as lines."""
    with zipfile.ZipFile(path) as archive:
        return {
            name: archive.read(name).decode().splitlines()
            for name in archive.namelist()
            if name.endswith(".csv")
        }


def undamaged(folder: Path, other: Path, commands: dict[str, tuple[str, ...]]) -> Sweep:
    """What the commands say of a sweep; it is left as it was."""
    sweep = Sweep(folder, other)
    with tempfile.TemporaryDirectory() as name:
        copy = Path(shutil.copytree(folder, Path(name) / "copy"))
        for command, arguments in commands.items():
            sweep.said[command] = say(copy, arguments)
            assert sweep.said[command].code == 0, (command, sweep.said[command])
        sweep.tables = tables_of(copy / "small.zip")
    return sweep


def make_database(folder: Path) -> None:
    """Make ``empty.db``, a database with MLflow's tables: that takes MLflow seconds."""
    store = SweepStore(folder / "nothing", "nothing")
    assert not sync(store, tracking_uri(store, None)).problem
    shutil.copy(store.mlflow_database, folder / "empty.db")


def mistakes(
    sweep: Sweep, damage: Damage, commands: dict[str, tuple[str, ...]], *, launches: bool
) -> Iterator[tuple[str, str]]:
    """Do a damage to a copy of a sweep; each command with what is wrong with what it says, or nothing.

    Args:
        sweep: undamaged.
        damage: to do.
        commands: to ask.
        launches: whether to launch afterwards, and compare the results with those of ``sweep.other``'s kind.
    """
    with tempfile.TemporaryDirectory() as name:
        copy = Path(shutil.copytree(sweep.folder, Path(name) / "copy"))
        has_changed = damage.do(copy, sweep.other)
        for command, arguments in commands.items():
            if command == "sync" and not (copy / DATABASE).exists():
                shutil.copy(sweep.folder.parent / "empty.db", copy / DATABASE)
            if command == "merge" and not (copy / "small.zip").exists():
                continue
            said = say(copy, arguments)
            wrong = _wrong(sweep, damage, command, said, has_changed=has_changed)
            if command == "export" and said.code == 0 and not wrong:
                wrong = _wrong_tables(sweep.tables, tables_of(copy / "small.zip"))
            yield command, wrong
        if launches:
            for command, arguments in LAUNCHES.items():
                said = say(copy, arguments)
                wrong = "" if said.code is not None else said.err
                if command == "launch --rerun-damaged" and not wrong:
                    wrong = f"exit {said.code}: {said.out}{said.err}" if said.code else ""
                    wrong = wrong or _wrong_results(sweep.folder.parent / "complete", copy)
                yield command, wrong


def _wrong(sweep: Sweep, damage: Damage, command: str, said: Said, *, has_changed: bool) -> str:
    """What is wrong with what a command said of a damaged sweep; empty if nothing is."""
    whole = sweep.said[command]
    if said.code is None or "Traceback" in said.err:
        return f"a traceback: {said.err}"
    if (said.code, said.lines) == (0, whole.lines):
        is_read = (
            damage.path.name not in UNCOMMITTED
            and damage.kind != "another's"
            and "figures" not in damage.path.parts
            and not _is_spare(sweep, damage)
        )
        return (
            "check found nothing"
            if command == "check" and has_changed and is_read and _is_kept(damage)
            else ""
        )
    if command == "logs" and (said.code or damage.path.name == "log.txt"):
        return ""
    everything = said.out + said.err
    if damage.path.name not in everything and "damaged" not in everything:
        return f"exit {said.code}, and the damage is not named: {everything}"
    if said.code:
        return ""
    new = [line for line in said.lines if line not in whole.lines and any(sign.isdigit() for sign in line)]
    unexcused = [
        line
        for line in new
        if not line.startswith(SUMMARIES)
        and "damaged" not in line
        and "repair" not in line
        and damage.path.name not in line
    ]
    return f"exit 0 with other lines: {unexcused}" if unexcused else ""


def _is_spare(sweep: Sweep, damage: Damage) -> bool:
    """Whether what is gone is an older checkpoint, which nothing needs as long as the newest is there."""
    folder = damage.path.parent
    if damage.kind != "deleted" or folder.name != "checkpoints":
        return False
    return damage.path != max(path for path in sweep.files if path.parent == folder)


def _is_kept(damage: Damage) -> bool:
    """Whether a change of a file must show: JSON does not mind other blanks."""
    is_json = damage.path.suffix == ".json"
    return not (is_json and damage.kind in ("flipped", "cut"))


def _wrong_tables(whole: dict[str, list[str]], found: dict[str, list[str]]) -> str:
    """What of an export is not of the undamaged sweep's."""
    for name, lines in found.items():
        new = [line for line in lines if line not in whole[name]]
        if new and len(lines) > 1:
            return f"exit 0 with other rows in {name}: {new[:3]}"
    return ""


def _wrong_results(whole: Path, found: Path) -> str:
    """Which results differ from those of the sweep that nobody damaged."""
    root = whole / "runs" / NAME / "trials"
    for folder in sorted(root.iterdir()):
        one, other = TrialStore(folder), TrialStore(found / "runs" / NAME / "trials" / folder.name)
        for name in RESULTS:
            if one.committed_bytes(folder / name) != other.committed_bytes(other.folder / name):
                return f"{folder.name}/{name} is not what an undamaged sweep has"
    return ""


def damages_of(sweep: Sweep, generator: np.random.Generator) -> Iterator[Damage]:
    """Every damage to every file once, at random places."""
    for path in sweep.files:
        is_folder = (sweep.folder / "runs" / NAME / path).is_dir()
        is_trial = path.parts[0] == "trials" and len(path.parts) <= 2  # without its folder it never ran
        for kind in (
            ("emptied",) if is_folder and is_trial else ("emptied", "deleted") if is_folder else DAMAGES
        ):
            yield Damage(path, kind, float(generator.uniform()), int(generator.integers(1, 256)))


def prepared(folder: Path) -> list[Sweep]:
    """Make the sweeps to damage, a complete and an interrupted one, in an empty folder."""
    other = make(folder / "other", interrupted=False, limit=0.75)
    commands = {**READING, **SLOW}
    make_database(folder)
    return [
        undamaged(make(folder / "complete", interrupted=False), other, commands),
        undamaged(make(folder / "interrupted", interrupted=True), other, commands),
    ]


def run(sweeps: Sequence[Sweep], *, cases: int, seed: int) -> tuple[int, list[str]]:
    """Do at least so many cases; returns how many, and a sentence for each that is wrong.

    Args:
        sweeps: of ``prepared``.
        cases: at least 1.
        seed: of places and bits, and of which damages the slow commands and launches meet.
    """
    generator, commands = np.random.default_rng(seed), {**READING, **SLOW}
    done, wrong = 0, list[str]()
    while True:
        for sweep in sweeps:
            for damage in damages_of(sweep, generator):
                slow = {name for name, share in SLOW_SHARES.items() if generator.uniform() < share}
                chosen = {name: given for name, given in commands.items() if name in READING or name in slow}
                launches = bool(generator.uniform() < LAUNCH_SHARE)
                for command, mistake in mistakes(sweep, damage, chosen, launches=launches):
                    done += 1
                    if done % 100 == 0:
                        print(f"{done} cases, {len(wrong)} wrong", flush=True)
                    if mistake:
                        wrong.append(f"{sweep.folder.name}: {damage}: {command}: {mistake}")
                        print(wrong[-1], flush=True)
                if done >= cases:
                    return done, wrong


def main() -> int:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.damage", description=__doc__)
    parser.add_argument("--cases", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        done, wrong = run(prepared(Path(name)), cases=arguments.cases, seed=arguments.seed)
    print(f"seed {arguments.seed}: {done} cases, {len(wrong)} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
