"""Requests of ``recrl-sweep``: one frozen, typed value per command.

``arguments`` makes them. Imports only the standard library, so that ``--help`` is fast.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, Self


@dataclass(frozen=True)
class Request:
    """Common part of all requests.

    Attributes:
        given: the arguments as they were typed.
    """

    trusted: ClassVar[bool] = False  # whether the command itself is the permission to follow import paths
    given: tuple[str, ...]

    @classmethod
    def of(cls, parsed: argparse.Namespace) -> Self:
        """Make a request of parsed arguments; lists become tuples."""
        values = {field.name: getattr(parsed, field.name) for field in fields(cls)}
        return cls(**{key: tuple(it) if isinstance(it, list) else it for key, it in values.items()})

    @property
    def about(self) -> Path | str | None:
        """The grid or the sweep, as it was typed."""
        return None

    @property
    def follows_import_paths(self) -> bool:
        """Whether import paths in files are followed."""
        return self.trusted or bool(getattr(self, "trust", False))


@dataclass(frozen=True)
class PlaceRequest(Request):
    """Location of sweeps.

    Attributes:
        root: the folder of all sweeps.
        storage: the address of an object store, or None.
    """

    root: Path
    storage: str | None


@dataclass(frozen=True)
class GridRequest(PlaceRequest):
    """A grid, and a selection of its trials.

    Attributes:
        grid: its file.
        only: the trials to work on, each ``KEY=VALUE``.
        retry_failed: whether to try failed trials again.
        rerun_damaged: whether to run damaged trials again that were complete or failed.
        rerun_changed: whether to run trials again that ran other code than is installed now.
        max_concurrent: largest number of parallel trials.
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
        mlflow: whether to log to MLflow.
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
        check: whether to exit with code 5 if there is something to do.
        cores: number of cores of the estimate.
        measure: whether to run a second of each cell to measure its speed.
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
        sweep: its name, folder or grid file; None for the only sweep there.
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
        follow: whether to wait for new lines.
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
        episodes: of each policy; None for the number of the trial's own evaluation.
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
        tracking_uri: of MLflow, to be read instead of files.
    """

    tracking_uri: str | None


@dataclass(frozen=True)
class FiguresRequest(SourceRequest):
    """``figures``.

    Attributes:
        trust: whether to follow import paths.
        to: the folder to draw into; None for the sweep's own.
        band: ``mean`` or ``iqm``.
        sketch: whether to draw only the fast figures.
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
        budget: allowed cost above the deployment limit in training; None to compute no limit.
        cost: index of the cost, from 1.
    """

    trust: bool
    budget: float | None
    cost: int


@dataclass(frozen=True)
class ReplayRequest(SweepRequest):
    """``replay``.

    Attributes:
        trust: whether to follow import paths.
        teacher: a method of the sweep, or any curriculum by its name.
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
        template: name of the grid to write.
        file: output file; None for the template's name.
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
