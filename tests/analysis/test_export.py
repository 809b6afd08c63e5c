"""A finished sweep in one file: what comes back, and what it leaves out."""

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from recrl.analysis.data import export, sweep_data
from recrl.analysis.data.sweep_data import Sweep, drawn_columns
from recrl.analysis.figures import styles
from recrl.analysis.figures.diagnostics import curriculum_diagnostics
from recrl.analysis.report import figure_list, table_files
from recrl.analysis.statistics import metrics
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import DamagedError, RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from tests.faults.committing import commit_file


@pytest.fixture(scope="module")
def restored(finished: Sweep, tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    return export.load(export.save(finished, tmp_path_factory.mktemp("compact") / "sweep.zip"))


@pytest.mark.parametrize("name", ["trials", "phases", "evaluations", "events", "policies"])
def test_outcomes_are_exact(restored: Sweep, finished: Sweep, name: str) -> None:
    pd.testing.assert_frame_equal(getattr(restored, name), getattr(finished, name), check_exact=True)


def test_updates_are_rounded_and_only_what_is_drawn(restored: Sweep, finished: Sweep) -> None:
    expected = finished.updates[drawn_columns(map(str, finished.updates))]
    assert list(restored.updates[expected.columns]) == list(expected)
    pd.testing.assert_frame_equal(restored.updates[expected.columns], expected, rtol=1e-5)
    assert (
        restored.updates["episode_return"].map(lambda value: len(f"{abs(value):.12g}".strip("0."))).max() <= 8
    )


def test_settings_and_provenance_come_back(restored: Sweep, finished: Sweep) -> None:
    assert restored.facts == finished.facts
    assert (restored.name, restored.grid, restored.notes) == (finished.name, finished.grid, finished.notes)


def test_saving_again_gives_equal_bytes(restored: Sweep, finished: Sweep, tmp_path: Path) -> None:
    first, second = export.save(finished, tmp_path / "1.zip"), export.save(restored, tmp_path / "2.zip")
    assert first.read_bytes() == second.read_bytes()


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(int)


def test_figures_and_tables_are_drawn_from_it(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=2, tasks=["a"], agents=["cpo"], methods=["none", "step"], failed=["a cpo step seed 1"]
    )
    sweep = sweep_data.load(store)
    small = export.load(export.save(sweep, tmp_path / "sweep.zip"))
    for stem in ("learning-curves_cpo", "curricula"):
        pictures = [figure_list.drawings(it)[stem].make() for it in (sweep, small)]
        one, other = (
            pixels(styles.save_png(picture, tmp_path / f"{number}.png"))
            for number, picture in enumerate(pictures)
            if picture is not None
        )
        assert np.abs(one - other).max() <= 4, stem  # a rounded curve has other soft edges
    written, _ = table_files.write_tables(sweep, tmp_path / "files")
    table_files.write_tables(small, tmp_path / "compact")
    for path in written:
        if path.name != "bounds.csv":  # sums over rounded updates
            assert path.read_bytes() == (tmp_path / "compact" / path.name).read_bytes(), path.name


def test_diagnostics_have_the_same_panels(made_up_sweep: Callable[..., SweepStore], tmp_path: Path) -> None:
    sweep = sweep_data.load(made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"]))
    explained = {f"explained_variance_{signal}": 0.5 for signal in ("reward", "cost_0")}
    sweep = replace(sweep, updates=sweep.updates.assign(**explained))
    small = export.load(export.save(sweep, tmp_path / "sweep.zip"))
    labels = [
        [axes.get_ylabel() for axes in curriculum_diagnostics(it, "a", "cpo").axes] for it in (sweep, small)
    ]
    assert "explained\nvariance, reward" in labels[0]
    assert labels[0] == labels[1]


ARCHIVES = sorted((Path(__file__).parents[2] / "results").rglob("*.zip"))


def test_there_are_archives() -> None:
    assert len(ARCHIVES) >= 5


@pytest.mark.parametrize("path", ARCHIVES, ids=lambda path: path.stem)
def test_every_archive_can_be_read_and_tabulated(path: Path, tmp_path: Path) -> None:
    sweep = export.load(path)
    assert sweep.notes == ()
    assert len(metrics.outcomes(sweep))
    assert table_files.write_tables(sweep, tmp_path)[1].shown


@pytest.fixture
def of_another_version(made_up_sweep: Callable[..., SweepStore]) -> Sweep:
    """A sweep whose task has an option that is no more; every trial has the table of its final policy."""
    store = made_up_sweep(seeds=2, tasks=["a"], agents=["cpo"], methods=["none", "linear"])
    for trial in store.trials():
        commit_file(trial, "policy.csv", "action_0,action_1\n0.0,1.0\n0.6,0.4\n")
    sweep = sweep_data.load(store)
    facts = []
    for it in sweep.facts:
        task = replace(it.spec.task, options={**it.spec.task.options, "out_of_range": "clip"})
        facts.append(replace(it, spec=replace(it.spec, task=task)))
    return sweep_data.assemble(sweep.name, facts, {name: sweep.rows(name) for name in sweep_data.ROWS})


@pytest.mark.usefixtures("unrendered")
def test_options_of_another_version_cost_no_more_than_what_is_computed_from_them(
    of_another_version: Sweep, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    note = (
        "a: the optimum is unknown here, because this version cannot read its options: out_of_range: unknown "
        "key"
    )
    path = export.save(of_another_version, tmp_path / "sweep.zip")
    sweep = export.load(path)
    assert of_another_version.notes == sweep.notes == (note,)
    rows = metrics.outcomes(sweep)
    assert not rows["exact"].any()
    assert rows["optimal_return"].isna().all()
    assert main(["figures", str(path), "--to", str(tmp_path / "figures")]) == ExitCode.OK
    assert note in (tmp_path / "figures" / "report.md").read_text().replace("\\", "")
    assert main(["bound", str(path)]) == ExitCode.OK
    assert capsys.readouterr().err == ""


def test_notes_that_hold_no_more_are_left_out(finished: Sweep, tmp_path: Path) -> None:
    notes = ("kept", "river-a: the optimum is unknown here, because it was not installed")
    path = export.save(replace(finished, notes=notes), tmp_path / "sweep.zip")
    assert export.load(path).notes == ("kept",)


def test_what_is_no_compact_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "none.zip"
    with pytest.raises(RecrlError, match=r"none\.zip: there is no such file in /"):
        export.load(path)
    for suffix in ("yaml", "zip", "csv"):
        (tmp_path / f"some.{suffix}").touch()
    with pytest.raises(RecrlError, match=r"did you mean 'some\.zip'\?"):
        export.load(tmp_path / "sone.zip")
    with pytest.raises(RecrlError, match="cannot be read as a sweep's compact file"):
        export.load(tmp_path)
    path.write_text("nothing")
    with pytest.raises(RecrlError, match="File is not a zip file"):
        export.load(path)


def test_a_file_that_would_fill_the_memory_is_refused(
    finished: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = export.save(finished, tmp_path / "sweep.zip")
    monkeypatch.setattr(export, "MAX_BYTES", 10_000)
    with pytest.raises(RecrlError, match=r"file \(it unpacks to \d+ bytes, at most 10000 are taken\)"):
        export.load(path)
    with pytest.raises(RecrlError, match=r"an export may unpack to 10000 bytes, this one has \d+"):
        export.save(finished, path)


@pytest.mark.parametrize("told", ["[]", '{"format": 1}', '{"format": 3}', "null"])
def test_a_file_of_another_format_is_named(finished: Sweep, tmp_path: Path, told: str) -> None:
    path = export.save(finished, tmp_path / "sweep.zip")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, member in (members | {"sweep.json": told.encode()}).items():
            archive.writestr(name, member)
    with pytest.raises(
        RecrlError,
        match=r"of another version of recrl, or was changed: its format must be 2, got (1|3|None)$",
    ):
        export.load(path)


def changed(sweep: Sweep, path: Path, member: str, change: Callable[[str], str]) -> Path:
    """The compact file of a sweep with another content of one table, and the digest of that content."""
    export.save(sweep, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name).decode() for name in archive.namelist()}
    members[member] = change(members[member])
    told = json.loads(members["sweep.json"])
    if member != "sweep.json":
        told["digests"][member] = hashlib.sha256(members[member].encode()).hexdigest()
        del told["digests"]["sweep.json"]  # as in archives of earlier versions
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in (members | {"sweep.json": json.dumps(told)}).items():
            archive.writestr(name, text)
    return path


@pytest.fixture
def one_trial(made_up_sweep: Callable[..., SweepStore]) -> Sweep:
    return sweep_data.load(made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], updates=20))


@pytest.mark.parametrize(
    ("name", "value"), [("deploy_limits", [40.0]), ("status", "failed"), ("cpu_seconds", 1.5)]
)
def test_a_change_of_the_trials_is_found(one_trial: Sweep, tmp_path: Path, name: str, value: object) -> None:
    def change(text: str) -> str:
        told = json.loads(text)
        trial = told["trials"][0]
        (trial if name in trial else trial["spec"])[name] = value
        return json.dumps(told)

    path = changed(one_trial, tmp_path / "sweep.zip", "sweep.json", change)
    with pytest.raises(
        DamagedError, match=r"its sweep\.json is not what was written; export the sweep again$"
    ):
        export.load(path)


def without_digest(text: str) -> str:
    told = json.loads(text)
    del told["digests"]["sweep.json"]
    return json.dumps(told)


def test_an_earlier_archive_has_no_digest_of_its_trials(one_trial: Sweep, tmp_path: Path) -> None:
    path = changed(one_trial, tmp_path / "sweep.zip", "sweep.json", without_digest)
    assert export.load(path).facts == one_trial.facts


def test_other_limits_than_those_of_the_deployment_phase_are_refused(
    one_trial: Sweep, tmp_path: Path
) -> None:
    def change(text: str) -> str:
        told = json.loads(without_digest(text))
        told["trials"][0]["spec"]["deploy_limits"] = [40.0]
        return json.dumps(told)

    path = changed(one_trial, tmp_path / "sweep.zip", "sweep.json", change)
    with pytest.raises(
        RecrlError,
        match=r"a cpo none seed 0: deploy_limits has 40, but updates\.csv has the limit 5 in the deployment",
    ):
        export.load(path)


def test_a_trial_that_is_there_twice_is_refused(one_trial: Sweep, tmp_path: Path) -> None:
    def change(text: str) -> str:
        told = json.loads(without_digest(text))
        return json.dumps({**told, "trials": told["trials"] * 2})

    path = changed(one_trial, tmp_path / "sweep.zip", "sweep.json", change)
    with pytest.raises(RecrlError, match=r"the trial a cpo none seed 0 is there 2 times$"):
        export.load(path)


def without(column: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    return lambda rows: rows.drop(columns=column)


def instead(column: str, word: str, other: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    return lambda rows: rows.assign(**{column: rows[column].replace(word, other)})


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("phases", without("cost_0_total"), "phases.csv has no column 'cost_0_total'"),
        ("phases", without("excess_0_total"), "phases.csv has no column 'excess_0_total'"),
        ("phases", without("cost_0_std"), "phases.csv has no column 'cost_0_std'"),
        (
            "phases",
            instead("phase", "deployment", "deploy"),
            "phases.csv: the column 'phase' must hold training or deployment",
        ),
        (
            "evaluations",
            instead("policy", "stochastic", "sampled"),
            "evaluations.csv: the column 'policy' must hold stochastic or deterministic",
        ),
        (
            "evaluations",
            lambda rows: rows.assign(cost_0=rows["cost_0"].where(rows.index % 2 == 0)),
            "evaluations.csv: the column 'cost_0' lacks numbers",
        ),
        (
            "phases",
            lambda rows: rows.assign(excess_0_total=np.nan),
            "phases.csv: the column 'excess_0_total' lacks numbers",
        ),
    ],
)
def test_rows_that_would_give_other_statistics_are_refused(
    one_trial: Sweep,
    tmp_path: Path,
    name: str,
    change: Callable[[pd.DataFrame], pd.DataFrame],
    sentence: str,
) -> None:
    def rewritten(text: str) -> str:
        return str(change(pd.read_csv(io.StringIO(text))).to_csv(index=False))

    path = changed(one_trial, tmp_path / "sweep.zip", f"{name}.csv", rewritten)
    with pytest.raises(RecrlError, match=f"{re.escape(sentence)}$"):
        export.load(path)


def test_costs_that_a_task_does_not_have_may_lack_numbers(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    few = {"seeds": 1, "agents": ["cpo"], "methods": ["none"], "updates": 20}
    made_up_sweep(tasks=["a"], **few)
    both = sweep_data.load(made_up_sweep(tasks=["b"], num_costs=2, **few))
    assert both.evaluations["cost_1"].isna().mean() == 0.5
    small = export.load(export.save(both, tmp_path / "both.zip"))
    pd.testing.assert_frame_equal(small.evaluations, both.evaluations)


def test_a_policy_table_that_does_not_fit_is_noted(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(seeds=2, tasks=["a"], agents=["cpo"], methods=["none"], updates=20)
    fitting, other = store.trials()
    commit_file(fitting, "policy.csv", "action_0,action_1\n0.0,1.0\n0.6,0.4\n")
    commit_file(other, "policy.csv", "action_0,action_1\n0.0,1.0\n")
    sweep = sweep_data.load(store)
    note = "policy tables that do not fit their task, so that the values are sampled: a cpo none seed 1"
    assert sweep.notes == (note,)
    assert export.load(export.save(sweep, tmp_path / "sweep.zip")).notes == (note,)  # and not twice
    final = metrics.outcomes(sweep).query("measure == 'stochastic'")
    assert final["exact"].tolist() == [True, False]


def test_significant_digits() -> None:
    values = np.array([123456.7, 1.2345678e-9, -0.1, np.inf])
    assert export._significant(values).tolist() == [123457.0, 1.23457e-9, -0.1, np.inf]


def test_pandas_reads_every_number_exactly() -> None:
    """Earlier versions do not: exports would not be exact, and merged parts would differ."""
    numbers = np.random.default_rng(0).normal(size=10_000) * 37.0
    text = pd.DataFrame({"number": numbers}).to_csv(index=False)
    assert (pd.read_csv(io.StringIO(text))["number"].to_numpy() == numbers).all()
