"""MLflow's own tables, read by a handful of SELECTs however many runs there are.

MLflow's client has no request for the histories of many runs (mlflow#7365), makes an object of every tag,
and takes seconds to be imported. sqlite answers the history of a metric from the primary key of MLflow's
table ``metrics`` alone: with (key, timestamp, step, run_uuid, value, is_nan) it holds all of it.

sqlite is read through ADBC (Apache Arrow), which fills arrays in C and lets other threads run meanwhile: a
quarter of the time of Python's tuples. Other databases are read through SQLAlchemy, as MLflow does.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.environments.cmdp import Floats
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.redaction import redacted

Ints = npt.NDArray[np.int64]

SQLITE = "sqlite:///"
ACTIVE = "lifecycle_stage = 'active'"  # MLflow keeps what was deleted
EXPERIMENTS = f"SELECT name, experiment_id FROM experiments WHERE {ACTIVE}"
RUNS = f"SELECT run_uuid, artifact_uri, start_time FROM runs WHERE experiment_id = :experiment AND {ACTIVE}"
OF_EXPERIMENT = "run_uuid IN (SELECT run_uuid FROM runs WHERE experiment_id = :experiment)"
TAGS = f"SELECT t.run_uuid, t.key, t.value FROM tags AS t WHERE t.{OF_EXPERIMENT}"
METRICS = f"SELECT l.run_uuid, l.key FROM latest_metrics AS l WHERE l.{OF_EXPERIMENT}"
OTHERS = "SELECT COUNT(*) FROM runs WHERE experiment_id <> :experiment"
HISTORY = "SELECT m.run_uuid, m.step, m.value, m.timestamp FROM metrics AS m WHERE m.key = :key"
HISTORY_AMONG_OTHERS = f"{HISTORY} AND m.{OF_EXPERIMENT}"  # takes twice as long
ROWS_AT_ONCE = "65536"  # that ADBC hands over
PATIENCE = 20_000  # milliseconds to wait for whoever writes


@dataclass(frozen=True)
class ShownRun:
    """A run as MLflow shows it.

    Attributes:
        run_id: its identity.
        artifacts: where its files are.
        start_time: milliseconds since 1970.
        tags: by name.
        metrics: names of the metrics it has.
    """

    run_id: str
    artifacts: str
    start_time: int
    tags: Mapping[str, str]
    metrics: frozenset[str]


@dataclass(frozen=True, eq=False)
class Points:
    """Points of one metric, in no order.

    Attributes:
        run_ids: the runs that have some.
        runs: positions in ``run_ids``, [p].
        steps: environment steps, [p].
        values: [p].
        milliseconds: when, since 1970, [p].
    """

    run_ids: Sequence[str]
    runs: Ints
    steps: Ints
    values: Floats
    milliseconds: Ints

    def followed_by(self, others: Points) -> Points:
        """These points and others; a run may be named by both."""
        return Points(
            [*self.run_ids, *others.run_ids],
            np.concatenate([self.runs, others.runs + len(self.run_ids)]),
            np.concatenate([self.steps, others.steps]),
            np.concatenate([self.values, others.values]),
            np.concatenate([self.milliseconds, others.milliseconds]),
        )


def unreadable(uri: str, error: Exception) -> TrackingError:
    """What is said where MLflow's store cannot be read."""
    reason = next(iter(str(error).splitlines()), type(error).__name__)
    return TrackingError(f"MLflow at {redacted(uri)} cannot be read: {redacted(reason)}")


class Tables(Protocol):
    """How a database is asked. Parameters are given in the order in which the query names them."""

    def rows(self, query: str, parameters: Mapping[str, Any]) -> list[tuple[Any, ...]]:
        """All rows of a small answer."""

    def points(self, query: str, parameters: Mapping[str, Any]) -> Points:
        """The answer to a query for a history."""


class Database:
    """MLflow's tables in a database.

    Args:
        uri: of the database, as MLflow takes it.
        tables: how it is asked.
    """

    def __init__(self, uri: str, tables: Tables | None = None) -> None:
        self._tables = tables or (SqliteTables(uri) if uri.startswith(SQLITE) else OtherTables(uri))

    def experiments(self) -> dict[str, str]:
        """The identity of every experiment, by its name."""
        return {str(name): str(identity) for name, identity in self._tables.rows(EXPERIMENTS, {})}

    def runs(self, experiment_id: str) -> list[ShownRun]:
        """The runs of an experiment."""
        of = {"experiment": int(experiment_id)}
        tags: dict[str, dict[str, str]] = {}
        for run, key, value in self._tables.rows(TAGS, of):
            tags.setdefault(run, {})[key] = value
        metrics: dict[str, set[str]] = {}
        for run, key in self._tables.rows(METRICS, of):
            metrics.setdefault(run, set()).add(key)
        return [
            ShownRun(run, place, int(start or 0), tags.get(run, {}), frozenset(metrics.get(run, ())))
            for run, place, start in self._tables.rows(RUNS, of)
        ]

    def points(self, metric: str, experiment_id: str) -> Points:
        """Every point of a metric in an experiment."""
        of = {"experiment": int(experiment_id)}
        if self._tables.rows(OTHERS, of) == [(0,)]:
            return self._tables.points(HISTORY, {"key": metric})
        return self._tables.points(HISTORY_AMONG_OTHERS, {"key": metric, **of})


class SqliteTables:
    """An sqlite file, opened for each query and read-only."""

    def __init__(self, uri: str) -> None:
        path = Path(uri.removeprefix(SQLITE))
        if not path.exists():
            raise TrackingError(f"{path}: no such file; MLflow would make an empty one")
        self._uri = uri
        self._address = f"file:{quote(str(path))}?mode=ro"

    def rows(self, query: str, parameters: Mapping[str, Any]) -> list[tuple[Any, ...]]:
        """All rows of a small answer."""
        return list(zip(*self._columns(query, parameters).to_pydict().values(), strict=True))

    def points(self, query: str, parameters: Mapping[str, Any]) -> Points:
        """The answer to a query for a history."""
        import pyarrow as pa  # noqa: PLC0415

        table = self._columns(query, parameters)
        runs, steps, values, times = (column.combine_chunks() for column in table.columns)
        known = runs.cast(pa.string()).dictionary_encode()
        return Points(
            known.dictionary.to_pylist(),
            known.indices.to_numpy().astype(np.int64),
            steps.to_numpy().astype(np.int64),
            values.to_numpy().astype(np.float64),
            times.to_numpy().astype(np.int64),
        )

    def _columns(self, query: str, parameters: Mapping[str, Any]) -> Any:
        """The answer as a ``pyarrow.Table``."""
        from adbc_driver_manager import Error  # noqa: PLC0415
        from adbc_driver_sqlite import StatementOptions, dbapi  # noqa: PLC0415

        options = {StatementOptions.BATCH_ROWS.value: ROWS_AT_ONCE}
        try:
            with (
                closing(dbapi.connect(self._address)) as connection,
                closing(connection.cursor(adbc_stmt_kwargs=options)) as cursor,
            ):
                cursor.execute(f"PRAGMA busy_timeout = {PATIENCE}")  # a mirror may be writing
                cursor.execute(query, tuple(parameters.values()))
                return cursor.fetch_arrow_table()
        except (Error, OSError) as error:  # Arrow's own errors, while rows are fetched, are OSErrors
            raise unreadable(self._uri, error) from error


class OtherTables:
    """Any database that SQLAlchemy has a driver for."""

    def __init__(self, uri: str) -> None:
        from sqlalchemy import create_engine  # noqa: PLC0415
        from sqlalchemy.exc import SQLAlchemyError  # noqa: PLC0415

        self._uri = uri
        try:
            self._engine = create_engine(uri)
        except (SQLAlchemyError, ImportError) as error:
            raise unreadable(uri, error) from error

    def rows(self, query: str, parameters: Mapping[str, Any]) -> list[tuple[Any, ...]]:
        """All rows of an answer."""
        from sqlalchemy import text  # noqa: PLC0415
        from sqlalchemy.exc import SQLAlchemyError  # noqa: PLC0415

        collects = gc.isenabled()
        gc.disable()  # a million new tuples would make it walk through all of them again and again
        try:
            with self._engine.connect() as connection:
                cursor = connection.execute(text(query), parameters).cursor
                return list(cursor.fetchall())  # plain tuples: SQLAlchemy's rows take longer
        except SQLAlchemyError as error:
            raise unreadable(self._uri, error) from error
        finally:
            if collects:
                gc.enable()

    def points(self, query: str, parameters: Mapping[str, Any]) -> Points:
        """The answer to a query for a history."""
        return points_of(self.rows(query, parameters))


def points_of(rows: Sequence[tuple[str, int, float, int]]) -> Points:
    """Points from tuples: run, step, value, milliseconds."""
    table = pd.DataFrame.from_records(rows, columns=["run", "step", "value", "time"])
    numbers, known = pd.factorize(table["run"])
    return Points(
        list(known),
        np.asarray(numbers, dtype=np.int64),
        table["step"].to_numpy(np.int64),
        table["value"].to_numpy(np.float64),
        table["time"].to_numpy(np.int64),
    )
