"""Update the sweep's parent run: its note, its status, the grid, the figures, the export file."""

from __future__ import annotations

import time
from dataclasses import replace

from recrl.orchestrator.files.outcomes_file import OUTCOMES_FILE
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.sweep_progress import SweepProgress, progress
from recrl.orchestrator.tracking.chart_view import charts_page
from recrl.orchestrator.tracking.export_file import ExportUpload, ExportWriter
from recrl.orchestrator.tracking.mlflow_runs import SweepRuns
from recrl.orchestrator.tracking.positions import Position, read_position, sync_folder
from recrl.orchestrator.tracking.run_content import note, report_page
from recrl.orchestrator.tracking.run_status import sweep_run_status


class SweepSync:
    """Sync of a sweep's own data to its parent run."""

    def __init__(
        self,
        store: SweepStore,
        uri: str,
        runs: SweepRuns,
        write_export: ExportWriter | None,
    ) -> None:
        """Continue from the position of an earlier process.

        Args:
            store: the sweep.
            uri: of ``client.tracking_uri``.
            runs: its runs.
            write_export: writes the export file; None to upload none.
        """
        self._store = store
        self._runs = runs
        folder = sync_folder(store, uri)
        self._path = folder / "sweep.json"
        known = read_position(self._path)
        self._position = known if known and known.run_id == runs.parent_id else Position(runs.parent_id)
        self._export = ExportUpload(store, runs, write_export, folder) if write_export else None

    def show(self, *, live: bool) -> str:
        """Bring the parent run up to date.

        Returns:
            The reason why the export file could not be uploaded, or empty.
        """
        now = progress(self._store.specs(), self._store)
        position = self._show_state(self._position, now, live=live)
        position = self._runs.send_files(position, [self._store.grid_path, self._store.info_path])
        figures = sorted(self._store.figures_folder.glob("[!.]*"))  # no temporary files
        position = self._runs.send_files(position, figures, "figures")
        self._save(position)
        if self._export is None:
            return ""
        records = {trial.spec.folder_name: trial.record for trial in now.trials}
        position, remark = self._export.bring_up_to_date(position, records, live=live)
        self._save(position)
        return remark

    def _show_state(self, position: Position, now: SweepProgress, *, live: bool) -> Position:
        from mlflow.entities import RunTag  # noqa: PLC0415

        status = sweep_run_status(now.counts, live=live)
        text = note(
            self._store.name,
            {str(status): count for status, count in now.counts.items()},
            charts=f"#{charts_page(self._runs.experiment_id)}",
            report=f"#{report_page(self._runs.experiment_id, self._runs.parent_id)}",
            report_text=self._report_text(),
        )
        if position.shown.get("note") != text:
            tags = [RunTag("mlflow.note.content", text)]
            self._runs.client.log_batch(position.run_id, tags=tags, synchronous=True)
        if position.shown.get("status") != status:
            last = max((trial.record.heartbeat for trial in now.trials), default=0.0)
            self._runs.set_status(position.run_id, status, last or time.time())
        return replace(position, shown={**position.shown, "note": text, "status": status})

    def _report_text(self) -> str:
        """Return the report as Markdown; nothing if there is none, or the policies were judged since."""
        report, outcomes = (self._store.figures_folder / name for name in ("report.md", OUTCOMES_FILE))
        try:
            is_older = outcomes.exists() and report.stat().st_mtime_ns < outcomes.stat().st_mtime_ns
            return "" if is_older else report.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def _save(self, position: Position) -> None:
        if position != self._position:
            position.write(self._path)
            self._position = position
