"""The commands of ``recrl-sweep``, each as a frozen, typed request with its arguments.

``argument_fields`` says how a class declares them. Imports almost nothing, so that ``--help`` is fast.
"""

# ruff: noqa: RUF009  (what looks like a default is a dataclass field)

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from recrl.orchestrator.cli import argument_types as types
from recrl.orchestrator.cli.argument_fields import Request, by_flag, by_place
from recrl.orchestrator.executor_kind import ExecutorKind
from recrl.orchestrator.files.trial_files import DEFAULT_ROOT

VIDEOS = ("gif", "mp4")
TEMPLATES = ("demo", "safety-gym", "velocity", "own-task")
KINDS = ("tasks", "agents", "curricula", "methods")  # methods: the key in a grid
SWEEP_HELP = "a sweep's name, folder or grid file; optional if there is only one"

_STORE = "an object store (s3://bucket/folder, gs://, abfs://...)"
_COPY = "its folder under --root is then a local copy that stores the address"
# Settings that several commands have.
_GRID: Mapping[str, Any] = {
    "type": types.path_of,
    "metavar": "GRID.yaml",
    "help": "what the sweep is made of",
}
_TRUST: Mapping[str, Any] = {
    "action": "store_true",
    "help": "import and call what the file names by an import path, package.module:attribute: do so only "
    "with files whose author you trust; launch always does",
}
_ONLY: Mapping[str, Any] = {
    "action": "append",
    "default": [],
    "metavar": "KEY=VALUE",
    "help": "only these trials: task, agent or method by label, or seed; several pairs with spaces, several "
    "values with commas: --only method=none,dynamic seed=0",
}
_TRACKING: Mapping[str, Any] = {
    "metavar": "URI",
    "help": "an MLflow server (http://host:port) or database (sqlite:///file.db); "
    "by default one in the sweep's folder",
}


@dataclass(frozen=True)
class PlaceRequest(Request):
    """Location of sweeps."""

    root: Path = by_flag(
        type=types.folder,
        default=Path(DEFAULT_ROOT),
        metavar="FOLDER",
        help=f"the folder of all sweeps (default: {DEFAULT_ROOT})",
    )
    storage: str | None = by_flag(
        type=types.not_empty, metavar="URI", help=f"read the sweep from {_STORE}; {_COPY}"
    )


@dataclass(frozen=True)
class GridRequest(PlaceRequest):
    """A grid, and a selection of its trials."""

    grid: Path = by_place(**_GRID)
    only: tuple[str, ...] = by_flag(**_ONLY)
    retry_failed: bool = by_flag(
        action="store_true", help="try failed trials again, from their last checkpoint"
    )
    rerun_damaged: bool = by_flag(
        action="store_true",
        help="run damaged trials again that were complete or had failed; other damaged trials are repaired "
        "anyway",
    )
    rerun_changed: bool = by_flag(
        action="store_true",
        help="run trials again that ran other code than is installed now; their old files are kept aside",
    )
    max_concurrent: int | None = by_flag(
        type=types.at_least_one,
        metavar="N",
        help="largest number of parallel trials; by default as many as fit, at most the grid's "
        "max_concurrent",
    )
    address: str | None = by_flag()


@dataclass(frozen=True)
class LaunchRequest(GridRequest):
    """Run what is not complete, draw the figures, print the results."""

    example: ClassVar[str] = "recrl-sweep launch demo.yaml --only method=none,dynamic seed=0"
    trusted: ClassVar[bool] = True
    storage: str | None = by_flag(
        type=types.not_empty, metavar="URI", help=f"keep the sweep in {_STORE} for all nodes; {_COPY}"
    )
    address: str | None = by_flag(
        type=types.not_empty,
        metavar="HOST:PORT",
        help="an existing Ray cluster that this machine is a node of; auto: that of RAY_ADDRESS, else "
        "this machine's; by default one is started here",
    )
    tracking_uri: str | None = by_flag(**_TRACKING)
    executor: str = by_flag(
        choices=tuple(map(str, ExecutorKind)),
        default=str(ExecutorKind.RAY),
        help="ray: in parallel on all cores or a cluster (default); inline: one after the other in this "
        "process, for debuggers",
    )
    ship_package: bool = by_flag(
        action="store_true",
        help="with --address: send recrl itself, without its dependencies, to the cluster's nodes",
    )
    mlflow: bool = by_flag(
        "--no-mlflow", action="store_false", help="do not log to MLflow; 'sync' can do it later"
    )
    figures: bool = by_flag("--no-figures", action="store_false", help="draw no figures at the end")


@dataclass(frozen=True)
class PlanRequest(GridRequest):
    """Say what a launch would do, and about how long it takes."""

    example: ClassVar[str] = "recrl-sweep plan demo.yaml --measure"
    address: str | None = by_flag(
        group="room",
        type=types.not_empty,
        metavar="HOST:PORT",
        help="estimate for this Ray cluster, which must run, or 'auto' to find it; by default for this "
        "machine",
    )
    cores: int | None = by_flag(
        group="room", type=types.at_least_one, metavar="N", help="estimate for this number of cores"
    )
    check: bool = by_flag(
        action="store_true",
        help="exit with code 5 if a launch would have something to do, or trials come from other code",
    )
    measure: bool = by_flag(
        action="store_true",
        help="run about a second of each task and agent without a known speed, to estimate the time",
    )
    trust: bool = by_flag(**_TRUST)


@dataclass(frozen=True)
class ValidateRequest(Request):
    """Check a grid file; the mistakes of all entries at once, with their lines."""

    example: ClassVar[str] = "recrl-sweep validate demo.yaml"
    grid: Path = by_place(**_GRID)
    trust: bool = by_flag(**_TRUST)


@dataclass(frozen=True)
class SweepRequest(PlaceRequest):
    """A sweep."""

    sweep: str | None = by_place(nargs="?", metavar="SWEEP", help=SWEEP_HELP)


@dataclass(frozen=True)
class StatusRequest(SweepRequest):
    """Show the progress of a sweep, from its files."""

    example: ClassVar[str] = "recrl-sweep status demo"
    brief: bool = by_flag(
        action="store_true", help="without the table of trials: one line, and what is wrong"
    )


class CheckRequest(SweepRequest):
    """Check every file of a sweep against its recorded length and digest."""

    example: ClassVar[str] = "recrl-sweep check demo"


class StopRequest(SweepRequest):
    """Ask a sweep's launch to save its trials and end; wait until it has."""

    example: ClassVar[str] = "recrl-sweep stop demo"


@dataclass(frozen=True)
class LogsRequest(SweepRequest):
    """Print a trial's log."""

    example: ClassVar[str] = "recrl-sweep logs demo 3f2a --follow"
    ends_with_reader: ClassVar[bool] = True
    trial: tuple[str, ...] = by_place(
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, as status shows them; default: the running trial",
    )
    follow: bool = by_flag(
        group="what",
        action="store_true",
        help="wait until the trial starts, and show new lines as long as it runs",
    )
    folder: bool = by_flag(group="what", action="store_true", help="print the trial's folder instead")


@dataclass(frozen=True)
class EvaluateRequest(SweepRequest):
    """Evaluate the policies of trials without learning; optionally film them."""

    example: ClassVar[str] = "recrl-sweep evaluate demo 3f2a --episodes 500 --video"
    trial: tuple[str, ...] = by_place(
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, or of several; by default all of the grid that have "
        "a checkpoint",
    )
    only: tuple[str, ...] = by_flag(**_ONLY)
    trust: bool = by_flag(**_TRUST)
    episodes: int | None = by_flag(
        type=types.at_least_one,
        metavar="N",
        help="episodes for each policy (default: the trial's own number)",
    )
    seed: int | None = by_flag(
        type=types.at_least_zero,
        metavar="S",
        help="seed of the episodes (default: the trial's own evaluation's, whose results are then equal)",
    )
    policy: str = by_flag(
        choices=("stochastic", "deterministic", "both"),
        default="both",
        help="stochastic as in training, deterministic, or both one after the other (default)",
    )
    video: str | None = by_flag(
        choices=VIDEOS,
        help="also film one episode of each policy, as a GIF (--video alone) or, with the package av, as "
        "MP4; it is also logged to MLflow",
    )
    tracking_uri: str | None = by_flag(**_TRACKING)


@dataclass(frozen=True)
class SourceRequest(SweepRequest):
    """A sweep in its folder, in an exported file, or in MLflow."""

    sweep: str | None = by_place(
        nargs="?", metavar="SWEEP", help=f"{SWEEP_HELP}; or a file that export wrote (.zip)"
    )
    only: tuple[str, ...] = by_flag(**_ONLY)
    tracking_uri: str | None = by_flag(
        metavar="URI",
        help="read MLflow instead of files: a server (http://host:port) or database (sqlite:///file.db)",
    )


@dataclass(frozen=True)
class FiguresRequest(SourceRequest):
    """Draw the figures, tables and report of the present results."""

    example: ClassVar[str] = "recrl-sweep figures demo --band iqm"
    trust: bool = by_flag(**_TRUST)
    to: Path | None = by_flag(
        type=types.folder, metavar="FOLDER", help="the output folder; by default the sweep's figures folder"
    )
    band: str = by_flag(
        choices=("mean", "iqm"),
        default="mean",
        help="what learning curves show: mean and standard error (default), or interquartile mean and "
        "95%% bootstrap band",
    )
    sketch: bool = by_flag(
        action="store_true",
        help="only learning curves, limits and tables, no PDF: fast, as during a launch",
    )


@dataclass(frozen=True)
class ExportRequest(SourceRequest):
    """Write one small file that figures and tables can be drawn from."""

    example: ClassVar[str] = "recrl-sweep export demo --to demo.zip"
    to: Path | None = by_flag(
        type=types.zip_file, metavar="FILE.zip", help="by default the sweep's name, in this folder"
    )


@dataclass(frozen=True)
class MergeRequest(Request):
    """Join files that export wrote, of a sweep that ran in several places."""

    example: ClassVar[str] = "recrl-sweep merge here.zip there.zip --to both.zip"
    parts: tuple[Path, ...] = by_place(
        type=types.path_of,
        nargs="+",
        metavar="FILE.zip",
        help="the first gives the name; if several have a trial, the furthest is used",
    )
    to: Path = by_flag(type=types.zip_file, metavar="FILE.zip", required=True, help="the output file")
    finished: bool = by_flag(
        action="store_true", help="leave out trials that are waiting or running; failed and damaged ones stay"
    )


@dataclass(frozen=True)
class BoundRequest(SourceRequest):
    """Compare the cost of training with its bounds; estimate the largest training limit for a budget."""

    example: ClassVar[str] = "recrl-sweep bound demo --budget 5000"
    trust: bool = by_flag(**_TRUST)
    budget: float | None = by_flag(
        type=types.cost,
        metavar="COST",
        help="allowed cost above the deployment limit d_d, over all training episodes: estimate the largest "
        "training limit d_t, for curricula whose limits are known in advance",
    )
    cost: str = by_flag(
        default="0", metavar="INDEX|NAME", help="the cost's index, counted from 0, or its name (default: 0)"
    )


@dataclass(frozen=True)
class ReplayRequest(SweepRequest):
    """The limits that another curriculum would have set on recorded episodes."""

    example: ClassVar[str] = "recrl-sweep replay demo --teacher dynamic --option window=8 --only method=none"
    trust: bool = by_flag(**_TRUST)
    teacher: str = by_flag(
        required=True, metavar="NAME", help="a method of the sweep, or any curriculum by its name"
    )
    option: tuple[str, ...] = by_flag(
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="its options that differ from the sweep's; several with spaces: --option window=8 preset=paper",
    )
    only: tuple[str, ...] = by_flag(**_ONLY)


@dataclass(frozen=True)
class UIRequest(SweepRequest):
    """Open MLflow's pages about a sweep, on this machine only."""

    example: ClassVar[str] = "recrl-sweep ui demo"
    tracking_uri: str | None = by_flag(**_TRACKING)
    port: int = by_flag(
        type=types.port, default=5000, metavar="N", help="port on this machine (default: 5000)"
    )


@dataclass(frozen=True)
class SyncRequest(SweepRequest):
    """Bring MLflow up to date with the files, for example after it was unreachable."""

    example: ClassVar[str] = "recrl-sweep sync demo --tracking-uri http://localhost:5000"
    trust: bool = by_flag(
        action="store_true",
        help="import tasks that files name by an import path, so that their values final/... are exact: do "
        "so only with files whose author you trust",
    )
    tracking_uri: str | None = by_flag(**_TRACKING)
    rebuild: bool = by_flag(action="store_true", help="send everything again, for example to an empty MLflow")


@dataclass(frozen=True)
class InitRequest(Request):
    """Write a grid file with comments to start from."""

    example: ClassVar[str] = "recrl-sweep init --template own-task"
    file: Path | None = by_place(
        nargs="?",
        type=types.path_of,
        metavar="FILE",
        help="default: the template's name, demo.yaml; never overwritten",
    )
    template: str = by_flag(
        choices=TEMPLATES,
        default=TEMPLATES[0],
        help="demo: RiverGrid in a few minutes (default); safety-gym and velocity: MuJoCo tasks; "
        "own-task: your own environment, with a small example in Python",
    )


@dataclass(frozen=True)
class ListRequest(Request):
    """List the tasks, agents or curricula."""

    example: ClassVar[str] = "recrl-sweep list agents"
    kind: str = by_place(
        choices=KINDS,
        metavar="KIND",
        help="tasks, agents or curricula (methods, their key in a grid, is the same)",
    )


@dataclass(frozen=True)
class OptionsRequest(Request):
    """List the options of a task, an agent, a curriculum or a section of the grid."""

    example: ClassVar[str] = "recrl-sweep options ppo-lag"
    name: str = by_place(
        metavar="NAME",
        help="as 'list' shows it, or package.module:attribute; or a section: run, resources, limits, "
        "tasks, agents, methods",
    )
    trust: bool = by_flag(
        action="store_true", help="import NAME if it is an import path: do so only with code that you trust"
    )


class SchemaRequest(Request):
    """Print a JSON schema of grid files, for editors."""

    example: ClassVar[str] = "recrl-sweep schema > recrl.schema.json"
