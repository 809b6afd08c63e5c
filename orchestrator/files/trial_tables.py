"""Read the tables of a trial: episodes, policy updates, events, evaluations, the final policy."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pandas as pd

from recrl.orchestrator.files.atomic_files import parsed_object
from recrl.orchestrator.files.trial_reader import TrialReader

EPISODE_COLUMNS = ("index", "phase", "end_step", "length", "episode_return", "noise")
UPDATE_COLUMNS = (
    "update",
    "phase",
    "end_step",
    "episodes",
    "episode_return",
    "noise",
    "time",
    "collect_seconds",
    "update_seconds",
)
EVALUATION_COLUMNS = ("policy", "index", "length", "episode_return")


class TrialTables(TrialReader):
    """The committed tables of a trial."""

    def episodes(self) -> pd.DataFrame:
        """Read the committed episodes: EPISODE_COLUMNS, then cost_i and limit_i for each cost.

        This and the other readers raise DamagedError if a file differs from its commit.
        """
        return self._committed_csv(self.episodes_path)

    def updates(self) -> pd.DataFrame:
        """Read the committed policy updates: UPDATE_COLUMNS, cost_i, limit_i, then the agent's metrics."""
        return self._committed_csv(self.updates_path)

    def events(self) -> list[dict[str, Any]]:
        """Read the committed events, in order; each has ``update``, ``end_step`` and ``event``."""
        return [json.loads(line) for line in self.committed_bytes(self.events_path).splitlines()]

    def evaluation(self) -> pd.DataFrame:
        """Read the final evaluations: EVALUATION_COLUMNS, then cost_i; empty before the end."""
        rows = self._committed_csv(self.evaluation_path)
        return rows if len(rows.columns) else pd.DataFrame(columns=list(EVALUATION_COLUMNS))

    def policy(self) -> pd.DataFrame:
        """Read the final policy pi(a | s): one row per state, columns action_j; empty if missing."""
        return self._committed_csv(self.policy_path)

    def provenance(self) -> list[dict[str, Any]]:
        """Read the provenance of each attempt, the first one first; empty if the trial never began."""
        data = self.committed_bytes(self.provenance_path)
        if not data:
            return []
        attempts: list[dict[str, Any]] = parsed_object(data, self.provenance_path.name).get("attempts", [])
        return attempts

    def _committed_csv(self, path: Path) -> pd.DataFrame:
        data = self.committed_bytes(path)
        return pd.read_csv(io.BytesIO(data)) if data else pd.DataFrame()
