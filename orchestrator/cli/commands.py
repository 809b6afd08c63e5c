"""The function for each command."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from rich.console import Console

from recrl.orchestrator.cli import (
    catalogue,
    curricula,
    evaluate,
    init,
    launch,
    plan,
    requests,
    results,
    status,
    tracking,
)
from recrl.orchestrator.exit_codes import ExitCode

Command: TypeAlias = Callable[[Any, Console], ExitCode]

COMMANDS: Mapping[type[requests.Request], Command] = {
    requests.InitRequest: init.run_init,
    requests.ListRequest: catalogue.run_list,
    requests.OptionsRequest: catalogue.run_options,
    requests.SchemaRequest: catalogue.run_schema,
    requests.LaunchRequest: launch.run_launch,
    requests.PlanRequest: plan.run_plan,
    requests.ValidateRequest: plan.run_validate,
    requests.StatusRequest: status.run_status,
    requests.CheckRequest: status.run_check,
    requests.StopRequest: status.run_stop,
    requests.LogsRequest: status.run_logs,
    requests.EvaluateRequest: evaluate.run_evaluate,
    requests.FiguresRequest: results.run_figures,
    requests.ExportRequest: results.run_export,
    requests.MergeRequest: results.run_merge,
    requests.BoundRequest: curricula.run_bound,
    requests.ReplayRequest: curricula.run_replay,
    requests.UIRequest: tracking.run_ui,
    requests.SyncRequest: tracking.run_sync,
}
