"""``figures``, ``export`` and ``merge``: outputs made from a sweep's results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from recrl.orchestrator.cli.output import say, short
from recrl.orchestrator.cli.requests import ExportRequest, FiguresRequest, MergeRequest, SourceRequest
from recrl.orchestrator.cli.sweeps import open_store
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import DamagedError, RecrlError, described
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.grid.checking import read_name
from recrl.orchestrator.grid.only_selection import parse_only, select
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.tracking.client import checked_uri

if TYPE_CHECKING:
    from recrl.analysis.data.sweep_data import Sweep


def run_figures(request: FiguresRequest, console: Console) -> ExitCode:
    """Draw the figures and tables of a sweep in its folder, an export or MLflow."""
    _require_place_of_part(request)
    sweep, folder = source(request)
    if request.only:
        shown = " ".join(request.only)
        note = f"only trials with {shown} are here, and p is corrected for the comparisons of these only"
        sweep = replace(sweep, notes=(*sweep.notes, note))
    say_warnings(sweep, console)
    require_undamaged(sweep)
    folder = request.to or folder
    try:
        draw(sweep, folder, console, band=request.band, whole=not request.sketch)
    except (RecrlError, OSError):
        raise
    except Exception as error:
        if not str(request.sweep).endswith(".zip"):
            raise
        raise RecrlError(
            f"{request.sweep}: not all figures could be drawn ({described(error)}); the others are in "
            f"{folder}"
        ) from error
    return ExitCode.OK


def run_export(request: ExportRequest, console: Console) -> ExitCode:
    """Write the compact file of a sweep."""
    from recrl.analysis.data import export  # noqa: PLC0415  (imports pandas)

    _require_place_of_part(request)
    sweep, _ = source(request)
    _say_file(export.save(sweep, request.to or Path(f"{sweep.name}{export.SUFFIX}")), sweep, console)
    say_warnings(sweep, console)
    return ExitCode.OK


def run_merge(request: MergeRequest, console: Console) -> ExitCode:
    """Join compact files into one."""
    from recrl.analysis.data import export, merging  # noqa: PLC0415  (imports pandas)

    for path in request.parts:
        if path.suffix != export.SUFFIX:
            raise RecrlError(f"{path}: merge joins files that export wrote (.zip): recrl-sweep export SWEEP")
    sweep = merging.merge([export.load(path) for path in request.parts], finished_only=request.finished)
    _say_file(export.save(sweep, request.to), sweep, console)
    for note in sweep.notes:
        say(console, note)
    say_warnings(sweep, console)
    return ExitCode.OK


def say_warnings(sweep: Sweep, console: Console) -> None:
    """Print the trials that are left out, and other remarks on validity."""
    from recrl.analysis.data.sweep_warnings import damages, doubts  # noqa: PLC0415  (imports pandas)

    for sentence in damages(sweep):
        say(console, f"damaged: {sentence}")
    for sentence in doubts(sweep):
        say(console, f"warning: {sentence}")


def require_undamaged(sweep: Sweep) -> None:
    """Check that a trial is not damaged, before results are made of the sweep.

    Raises:
        DamagedError: all are; ``say_warnings`` has said why.
    """
    if sweep.facts and all(trial.status is TrialStatus.DAMAGED for trial in sweep.facts):
        raise DamagedError(f"{sweep.name}: all trials are damaged")


def _require_place_of_part(request: FiguresRequest | ExportRequest) -> None:
    """Check that what has only some trials does not replace what has all.

    Raises:
        RecrlError: it would.
    """
    if request.only and request.to is None:
        raise RecrlError("--only: give --to as well, so that a part does not replace what has all trials")


def _say_file(path: Path, sweep: Sweep, console: Console) -> None:
    complete = sum(trial.status is TrialStatus.COMPLETE for trial in sweep.facts)
    size = f"{path.stat().st_size / 1000:,.0f} kB"
    say(console, f"{short(path)}: {counted(len(sweep.facts), 'trial')}, {complete} of them complete, {size}")


def source(request: SourceRequest) -> tuple[Sweep, Path]:
    """Return the chosen trials of a sweep, from its files, an export or MLflow, and a folder for figures."""
    from recrl.analysis.data import merging  # noqa: PLC0415  (imports pandas and SciPy)

    only = parse_only(request.only)
    sweep, folder = _source_of_all(request)
    if only:
        sweep = merging.part_of(sweep, select([trial.spec for trial in sweep.facts], only))
    return sweep, folder


def _source_of_all(request: SourceRequest) -> tuple[Sweep, Path]:
    from recrl.analysis.data import export, from_mlflow, sweep_data  # noqa: PLC0415  (imports pandas and SciPy)

    given: str | None = request.sweep
    is_file = bool(given and given.endswith(export.SUFFIX))
    places = {
        str(given): is_file,
        "--tracking-uri": request.tracking_uri is not None,
        "--storage": request.storage is not None,
    }
    if len(chosen := [place for place, is_given in places.items() if is_given]) > 1:
        raise RecrlError(f"{', '.join(chosen)}: give one of them, the place to read the sweep from")
    if request.tracking_uri is not None:
        name = read_name(Path(given)) if given and given.endswith((".yaml", ".yml")) else given
        sweep = from_mlflow.load(checked_uri(request.tracking_uri), name)
        return sweep, Path(f"{sweep.name}-figures")
    if given and is_file:
        return export.load(Path(given)), Path(f"{Path(given).stem}-figures")
    store = open_store(request)
    return sweep_data.load(store), store.figures_folder


def draw(sweep: Sweep, folder: Path, console: Console, *, band: str = "mean", whole: bool = True) -> None:
    """Draw a sweep's figures, tables and report, and print their place."""
    from recrl.analysis.report.drawing import draw, sketch  # noqa: PLC0415  (imports matplotlib)
    from recrl.analysis.report.figure_list import curve_averages  # noqa: PLC0415

    (draw if whole else sketch)(sweep, folder, averaging=curve_averages()[band])
    say(console, f"Figures    {short(folder)}")
