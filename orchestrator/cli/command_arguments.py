"""The arguments of each command of ``recrl-sweep``."""

from __future__ import annotations

from collections.abc import Callable

from recrl.orchestrator.cli import requests
from recrl.orchestrator.cli.argument_types import (
    at_least_one,
    at_least_zero,
    cost,
    folder,
    path_of,
    port,
    zip_file,
)
from recrl.orchestrator.cli.shared_arguments import (
    Commands,
    add_command,
    add_grid,
    add_only,
    add_selection,
    add_source,
    add_sweep,
    add_tracking,
    add_trust,
)

VIDEOS = ("gif", "mp4")
TEMPLATES = ("demo", "safety-gym", "velocity", "own-task")
KINDS = ("tasks", "agents", "curricula", "methods")  # methods: the key in a grid


def _add_init(commands: Commands) -> None:
    init = add_command(
        commands, "init", requests.InitRequest, "write a grid file with comments to start from"
    )
    init.add_argument(
        "file",
        nargs="?",
        type=path_of,
        metavar="FILE",
        help="default: the template's name; never overwritten",
    )
    init.add_argument(
        "--template",
        choices=TEMPLATES,
        default=TEMPLATES[0],
        help="demo: RiverGrid in a few minutes (default); safety-gym and velocity: MuJoCo tasks; "
        "own-task: your own environment, with a small example in Python",
    )


def _add_catalogue(commands: Commands) -> None:
    catalogue = add_command(commands, "list", requests.ListRequest, "list the tasks, agents or curricula")
    catalogue.add_argument("kind", choices=KINDS, help="what to list")
    options = add_command(
        commands, "options", requests.OptionsRequest, "list the options of a task, an agent or a curriculum"
    )
    options.add_argument("name", metavar="NAME", help="as 'list' shows it, or package.module:attribute")
    add_trust(options)
    add_command(commands, "schema", requests.SchemaRequest, "print a JSON schema of grid files, for editors")


def _add_validate(commands: Commands) -> None:
    validate = add_command(
        commands,
        "validate",
        requests.ValidateRequest,
        "check a grid file; all mistakes at once, with their lines",
    )
    add_grid(validate)
    add_trust(validate)


def _add_plan(commands: Commands) -> None:
    plan = add_command(
        commands, "plan", requests.PlanRequest, "say what a launch would do, and about how long it takes"
    )
    add_grid(plan)
    add_trust(plan)
    add_selection(plan)
    plan.add_argument(
        "--check", action="store_true", help="exit with code 5 if a launch would have something to do"
    )
    plan.add_argument(
        "--measure",
        action="store_true",
        help="run about a second of each task and agent without a known speed, to estimate the time",
    )
    room = plan.add_mutually_exclusive_group()
    room.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="estimate for this Ray cluster, which must run; by default for this machine",
    )
    room.add_argument("--cores", type=at_least_one, metavar="N", help="estimate for this number of cores")


def _add_progress(commands: Commands) -> None:
    status = add_command(
        commands, "status", requests.StatusRequest, "show the progress of a sweep, from its files"
    )
    add_sweep(status)
    status.add_argument("--brief", action="store_true", help="one line, without the table of trials")
    add_sweep(
        add_command(
            commands,
            "check",
            requests.CheckRequest,
            "check every file of a sweep against the length and digest that were committed",
        )
    )
    add_sweep(
        add_command(
            commands,
            "stop",
            requests.StopRequest,
            "ask the launch that runs a sweep to save its trials and end, and wait",
        )
    )


def _add_launch(commands: Commands) -> None:
    launch = add_command(
        commands,
        "launch",
        requests.LaunchRequest,
        "run what is not complete, draw the figures, print the results",
    )
    add_grid(launch)
    add_selection(launch)
    add_tracking(launch)
    launch.add_argument(
        "--executor",
        choices=("ray", "inline"),
        default="ray",
        help="ray: in parallel on all cores or a cluster (default); inline: one after the other "
        "in this process, for debuggers",
    )
    launch.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="an existing Ray cluster that this machine is a node of, or 'auto' to find it; by default one "
        "is started here",
    )
    launch.add_argument(
        "--ship-package",
        action="store_true",
        help="with --address: send recrl itself, without its dependencies, to the cluster's nodes",
    )
    launch.add_argument(
        "--no-mlflow",
        dest="mlflow",
        action="store_false",
        help="do not log to MLflow; 'sync' can do it later",
    )
    launch.add_argument(
        "--no-figures", dest="figures", action="store_false", help="draw no figures at the end"
    )


def _add_logs(commands: Commands) -> None:
    logs = add_command(commands, "logs", requests.LogsRequest, "print a trial's log")
    add_sweep(logs)
    logs.add_argument(
        "trial",
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, as status shows them; default: the running trial",
    )
    logs.add_argument(
        "--follow",
        action="store_true",
        help="wait until the trial starts, and show new lines as long as it runs",
    )
    logs.add_argument("--folder", action="store_true", help="print the trial's folder instead")


def _add_evaluate(commands: Commands) -> None:
    evaluate = add_command(
        commands,
        "evaluate",
        requests.EvaluateRequest,
        "evaluate the policies of trials without learning; optionally film them",
    )
    add_sweep(evaluate)
    evaluate.add_argument(
        "trial",
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, or of several; by default all that have a checkpoint",
    )
    add_only(evaluate)
    add_trust(evaluate)
    evaluate.add_argument(
        "--episodes",
        type=at_least_one,
        metavar="N",
        help="for each policy; by default the number of the trial's own evaluation",
    )
    evaluate.add_argument(
        "--seed",
        type=at_least_zero,
        metavar="S",
        help="for the episodes; by default that of the trial's own evaluation, whose results are then equal",
    )
    evaluate.add_argument(
        "--policy",
        choices=("stochastic", "deterministic", "both"),
        default="both",
        help="stochastic as in training, deterministic, or both one after the other (default)",
    )
    evaluate.add_argument(
        "--video",
        choices=VIDEOS,
        help="also film one episode of each policy, as a GIF or, with the package av, as MP4; it "
        "is also logged to MLflow",
    )
    add_tracking(evaluate)


def _add_figures(commands: Commands) -> None:
    figures = add_command(
        commands,
        "figures",
        requests.FiguresRequest,
        "draw the figures, tables and report of the present results",
    )
    add_source(figures)
    add_trust(figures)
    figures.add_argument(
        "--to", type=folder, metavar="FOLDER", help="the output folder; by default the sweep's figures folder"
    )
    figures.add_argument(
        "--band",
        choices=("mean", "iqm"),
        default="mean",
        help="of learning curves: mean and standard error (default), or interquartile mean and 95%% "
        "bootstrap band",
    )
    figures.add_argument(
        "--sketch",
        action="store_true",
        help="only learning curves, limits and tables, no PDF: fast, as during a launch",
    )


def _add_export(commands: Commands) -> None:
    export = add_command(
        commands,
        "export",
        requests.ExportRequest,
        "write one small file that figures and tables can be drawn from",
    )
    add_source(export)
    export.add_argument(
        "--to", type=zip_file, metavar="FILE.zip", help="by default the sweep's name, in this folder"
    )


def _add_merge(commands: Commands) -> None:
    merge = add_command(
        commands,
        "merge",
        requests.MergeRequest,
        "join files that export wrote, of a sweep that ran in several places",
    )
    merge.add_argument(
        "parts",
        type=path_of,
        nargs="+",
        metavar="FILE.zip",
        help="the first gives the name; if several have a trial, the furthest is used",
    )
    merge.add_argument("--to", type=zip_file, metavar="FILE.zip", required=True, help="the output file")


def _add_bound(commands: Commands) -> None:
    bound = add_command(
        commands,
        "bound",
        requests.BoundRequest,
        "compare the cost of training with its bounds; find the largest training limit for a budget",
    )
    add_source(bound)
    add_trust(bound)
    bound.add_argument(
        "--budget",
        type=cost,
        metavar="COST",
        help="allowed cost above the deployment limit of all training episodes together: find the "
        "largest training limit d_t",
    )
    bound.add_argument(
        "--cost", type=at_least_one, default=1, metavar="I", help="index of the cost (default: 1)"
    )


def _add_replay(commands: Commands) -> None:
    replay = add_command(
        commands,
        "replay",
        requests.ReplayRequest,
        "the limits that another curriculum would have set on recorded episodes",
    )
    add_sweep(replay)
    add_trust(replay)
    replay.add_argument(
        "--teacher",
        required=True,
        metavar="NAME",
        help="a method of the sweep, or any curriculum by its name",
    )
    replay.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="its options that differ from the sweep's, window=8",
    )
    add_only(replay)


def _add_ui(commands: Commands) -> None:
    user_interface = add_command(
        commands, "ui", requests.UIRequest, "open MLflow's pages about a sweep, on this machine only"
    )
    add_sweep(user_interface)
    add_tracking(user_interface)
    user_interface.add_argument(
        "--port", type=port, default=5000, metavar="N", help="of 127.0.0.1 (default: 5000)"
    )


def _add_sync(commands: Commands) -> None:
    sync = add_command(
        commands,
        "sync",
        requests.SyncRequest,
        "bring MLflow up to date with the files, for example after it was unreachable",
    )
    add_sweep(sync)
    add_tracking(sync)
    sync.add_argument(
        "--rebuild", action="store_true", help="send everything again, for example to an empty MLflow"
    )


COMMANDS: tuple[Callable[[Commands], None], ...] = (
    _add_init,
    _add_catalogue,
    _add_validate,
    _add_plan,
    _add_launch,
    _add_progress,
    _add_logs,
    _add_evaluate,
    _add_figures,
    _add_export,
    _add_merge,
    _add_bound,
    _add_replay,
    _add_ui,
    _add_sync,
)
