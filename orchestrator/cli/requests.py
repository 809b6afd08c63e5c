"""What each command of ``recrl-sweep`` is asked for: one frozen, typed value a command.

``arguments`` fills them in. Imports nothing but the standard library, so that ``--help`` is quick.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, Self


@dataclass(frozen=True)
class Request:
    """What every command has.

    Attributes:
        given: the arguments as they were typed.
    """

    trusted: ClassVar[bool] = False  # whether the command itself is the order to run what a file names
    given: tuple[str, ...]

    @classmethod
    def of(cls, parsed: argparse.Namespace) -> Self:
        """The request that parsed arguments make; lists become tuples."""
        values = {field.name: getattr(parsed, field.name) for field in fields(cls)}
        return cls(**{key: tuple(it) if isinstance(it, list) else it for key, it in values.items()})

    @property
    def about(self) -> Path | str | None:
        """The grid or the sweep, as it was typed."""
        return None

    @property
    def follows_import_paths(self) -> bool:
        """Whether code that a file names by an import path may run."""
        return self.trusted or bool(getattr(self, "trust", False))


@dataclass(frozen=True)
class PlaceRequest(Request):
    """Where sweeps are.

    Attributes:
        root: the folder of all sweeps.
        storage: the address of an object store, or None.
    """

    root: Path
    storage: str | None


@dataclass(frozen=True)
class GridRequest(PlaceRequest):
    """A grid, and which of its trials.

    Attributes:
        grid: its file.
        only: the trials to work on, each ``KEY=VALUE``.
        retry_failed: whether to try failed trials again.
        rerun_damaged: whether to run damaged trials again that were complete or failed.
        rerun_changed: whether to run trials again that ran other code than is installed now.
        max_concurrent: trials at once, at most.
        address: of an existing Ray cluster.
    """

    grid: Path
    only: tuple[str, ...]
    retry_failed: bool
    rerun_damaged: bool
    rerun_changed: bool
    max_concurrent: int | None
    address: str | None

    @property
    def about(self) -> Path:
        """The grid file."""
        return self.grid


@dataclass(frozen=True)
class LaunchRequest(GridRequest):
    """``launch``.

    Attributes:
        tracking_uri: of MLflow; None for a database in the sweep's folder.
        executor: ``ray`` or ``inline``.
        ship_package: whether to send recrl itself to the cluster.
        mlflow: whether MLflow is told.
        figures: whether to draw figures at the end.
    """

    trusted: ClassVar[bool] = True
    tracking_uri: str | None
    executor: str
    ship_package: bool
    mlflow: bool
    figures: bool


@dataclass(frozen=True)
class PlanRequest(GridRequest):
    """``plan``.

    Attributes:
        trust: whether to follow import paths.
        check: whether to end with 5 if there is something to do.
        cores: to estimate for.
        measure: whether to run a second of each cell to learn its speed.
    """

    trust: bool
    check: bool
    cores: int | None
    measure: bool


@dataclass(frozen=True)
class ValidateRequest(Request):
    """``validate``.

    Attributes:
        grid: the file.
        trust: whether to follow import paths.
    """

    grid: Path
    trust: bool

    @property
    def about(self) -> Path:
        """The grid file."""
        return self.grid


@dataclass(frozen=True)
class SweepRequest(PlaceRequest):
    """A sweep.

    Attributes:
        sweep: its name, folder or grid file; None for the only one there.
    """

    sweep: str | None

    @property
    def about(self) -> str | None:
        """The sweep as it was typed."""
        return self.sweep


@dataclass(frozen=True)
class StatusRequest(SweepRequest):
    """``status``.

    Attributes:
        brief: whether to leave out the table of trials.
    """

    brief: bool


class CheckRequest(SweepRequest):
    """``check``."""


class StopRequest(SweepRequest):
    """``stop``."""


@dataclass(frozen=True)
class LogsRequest(SweepRequest):
    """``logs``.

    Attributes:
        trial: words of its id, title or folder.
        follow: whether to wait for more.
        folder: whether to print the trial's folder instead.
    """

    trial: tuple[str, ...]
    follow: bool
    folder: bool


@dataclass(frozen=True)
class EvaluateRequest(SweepRequest):
    """``evaluate``.

    Attributes:
        trial: words of the beginning of the trials' ids, titles or folders.
        only: the trials, each ``KEY=VALUE``.
        trust: whether to follow import paths.
        episodes: of each policy; None for as many as the trial itself evaluates.
        seed: of the episodes; None for the trial's own.
        policy: ``stochastic``, ``deterministic`` or ``both``.
        video: ``gif``, ``mp4`` or None.
        tracking_uri: of MLflow.
    """

    trial: tuple[str, ...]
    only: tuple[str, ...]
    trust: bool
    episodes: int | None
    seed: int | None
    policy: str
    video: str | None
    tracking_uri: str | None


@dataclass(frozen=True)
class SourceRequest(SweepRequest):
    """A sweep in its folder, in an exported file, or in MLflow.

    Attributes:
        tracking_uri: read MLflow alone.
    """

    tracking_uri: str | None


@dataclass(frozen=True)
class FiguresRequest(SourceRequest):
    """``figures``.

    Attributes:
        trust: whether to follow import paths.
        to: the folder to draw into; None for the sweep's own.
        band: ``mean`` or ``iqm``.
        sketch: whether to draw only what is quick.
    """

    trust: bool
    to: Path | None
    band: str
    sketch: bool


@dataclass(frozen=True)
class ExportRequest(SourceRequest):
    """``export``.

    Attributes:
        to: the file to write; None for the sweep's name in this folder.
    """

    to: Path | None


@dataclass(frozen=True)
class MergeRequest(Request):
    """``merge``.

    Attributes:
        parts: the files to join.
        to: the file to write.
    """

    parts: tuple[Path, ...]
    to: Path

    @property
    def about(self) -> Path:
        """The file to write."""
        return self.to


@dataclass(frozen=True)
class BoundRequest(SourceRequest):
    """``bound``.

    Attributes:
        trust: whether to follow import paths.
        budget: cost above the deployment limit that may be spent in training; None for no answer.
        cost: which of the costs, from 1.
    """

    trust: bool
    budget: float | None
    cost: int


@dataclass(frozen=True)
class ReplayRequest(SweepRequest):
    """``replay``.

    Attributes:
        trust: whether to follow import paths.
        teacher: a method of the sweep, or any teacher by its name.
        option: its options, each ``KEY=VALUE``.
        only: the trials, each ``KEY=VALUE``.
    """

    trust: bool
    teacher: str
    option: tuple[str, ...]
    only: tuple[str, ...]


@dataclass(frozen=True)
class UIRequest(SweepRequest):
    """``ui``.

    Attributes:
        tracking_uri: of MLflow.
        port: of 127.0.0.1.
    """

    tracking_uri: str | None
    port: int


@dataclass(frozen=True)
class SyncRequest(SweepRequest):
    """``sync``.

    Attributes:
        tracking_uri: of MLflow.
        rebuild: whether to send everything again.
    """

    tracking_uri: str | None
    rebuild: bool


@dataclass(frozen=True)
class InitRequest(Request):
    """``init``.

    Attributes:
        template: which grid to write.
        file: where to; None for the template's name.
    """

    template: str
    file: Path | None


@dataclass(frozen=True)
class ListRequest(Request):
    """``list``.

    Attributes:
        kind: ``tasks``, ``agents`` or ``curricula``.
    """

    kind: str


@dataclass(frozen=True)
class OptionsRequest(Request):
    """``options``.

    Attributes:
        name: of a task, an agent or a curriculum.
        trust: whether to follow import paths.
    """

    name: str
    trust: bool


class SchemaRequest(Request):
    """``schema``."""
