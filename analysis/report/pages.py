"""The two reports of a sweep: ``report.html``, one self-contained page, and ``report.md``."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from recrl.analysis.data.labels import GROUP
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.sweep_warnings import doubts
from recrl.analysis.report import html_page, table_formats
from recrl.analysis.report.figure_list import KINDS, SKETCHED, Drawing, without_episodes
from recrl.analysis.report.html_page import Section
from recrl.analysis.report.table_files import Tables
from recrl.analysis.report.verdict_answers import answers, no_verdict
from recrl.analysis.report.verdict_table import FAILED, verdict_kinds, verdict_table
from recrl.analysis.report.verdict_terms import explanation, task_sentences
from recrl.analysis.statistics.intervals import ENOUGH_RUNS
from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.outcomes_file import INFEASIBLE
from recrl.orchestrator.spec import TrialStatus

RELOAD_SECONDS = 120  # of the page of a sweep that runs


def write_reports(
    sweep: Sweep, folder: Path, drawn: list[Path], figures: Mapping[str, Drawing], tables: Tables
) -> list[Path]:
    """Write the two reports.

    Args:
        sweep: its frames.
        folder: of the reports, and of the figures that they show.
        drawn: the files of the figures.
        figures: by file stem.
        tables: that were written.

    Returns:
        The written files.
    """
    said = [_count(sweep), *remarks(sweep)]
    return [
        table_formats.write_text(_html(sweep, said, drawn, figures, tables), folder / "report.html"),
        table_formats.write_text(_markdown(sweep, said, drawn, figures, tables), folder / "report.md"),
    ]


def shown_figures(folder: Path) -> set[str]:
    """Return the file stems of recrl's figures that the report in a folder shows; empty without a report."""
    try:
        text = (folder / "report.md").read_text(encoding="utf-8")
    except (FileNotFoundError, UnicodeDecodeError):
        return set()
    stems = re.findall(r"^!\[([\w.+-]+)\]\(\1\.png\)$", text, re.MULTILINE)
    return {stem for stem in stems if stem.partition("_")[0] in KINDS}


def _html(
    sweep: Sweep, said: list[str], drawn: list[Path], figures: Mapping[str, Drawing], tables: Tables
) -> str:
    """Return the page: answers, verdicts, warnings and the first figures; the rest is folded."""
    failed = bool(sweep.trials["status"].isin([TrialStatus.FAILED.value, TrialStatus.DAMAGED.value]).any())
    files = _full_sizes(drawn)
    first = {path: file for path, file in files.items() if figures[path.stem].kind in SKETCHED}
    further = {path: file for path, file in files.items() if path not in first}
    settings = html_page.verbatim(sweep.grid) + html_page.verbatim(_settings(sweep))
    sections = [
        Section("Trials and warnings", html_page.items(said, kind="failed" if failed else "plain")),
        Section("Figures", _figures(first, figures)),
        *([Section("More figures", _figures(further, figures), folded=True)] if further else []),
        *(
            Section(it.heading, html_page.table(it.table, it.note, it.kinds), folded=True)
            for it in tables.shown
        ),
        Section("Settings", settings, folded=True),
        Section("Provenance", html_page.verbatim("\n".join(_provenance(sweep))), folded=True),
    ]
    goes_on = bool((sweep.trials["status"] == TrialStatus.RUNNING.value).any())
    return html_page.page(
        sweep.name,
        _opening(sweep, tables.verdicts),
        sections,
        made=_made(sweep),
        reload_seconds=RELOAD_SECONDS if goes_on else None,
    )


def _figures(files: Mapping[Path, str], figures: Mapping[str, Drawing]) -> str:
    """Figures with their captions, as HTML."""
    return "\n".join(html_page.figure(path, figures[path.stem].caption, file) for path, file in files.items())


def _made(sweep: Sweep) -> str:
    """Return the versions of recrl that made the trials, and the date of the last policy update."""
    versions = sorted(
        {str(attempt["recrl"]) for it in sweep.facts for attempt in it.attempts if "recrl" in attempt}
    )
    made = [f"recrl {' and '.join(versions)}"] if versions else []
    if "time" in sweep.updates and len(sweep.updates):  # an export has no times
        last = datetime.fromtimestamp(float(sweep.updates["time"].max()), UTC)
        made.append(f"last policy update on {last:%Y-%m-%d} (UTC)")
    return ", ".join(made)


def _opening(sweep: Sweep, judged: pd.DataFrame) -> str:
    """Return the answers and the verdict table."""
    if not len(judged):
        return html_page.items([no_verdict(sweep)], kind="answers")
    return "\n".join(
        [
            html_page.items(answers(judged), kind="answers"),
            html_page.verdict_table(verdict_table(judged), verdict_kinds(judged)),
            html_page.items(task_sentences(sweep, judged), kind="notes"),
            html_page.items(explanation(judged), kind="notes"),
        ]
    )


def _settings(sweep: Sweep) -> str:
    """Return every task, agent and curriculum with its options, one line each, under the tables' labels."""
    lines = [
        f"{kind} {label}: {json.dumps(trial.spec.to_json()[kind])}"
        for group, trial in zip(sweep.groups, sweep.facts, strict=True)
        for kind, label in zip(GROUP, group, strict=True)
    ]
    return "\n".join(dict.fromkeys(lines))


def _provenance(sweep: Sweep) -> list[str]:
    """Return every distinct provenance of the trials, with the number of trials."""
    origins = Counter(trial.provenance for trial in sweep.facts if trial.provenance)
    return [f"{counted(count, 'trial')}:\n{text}" for text, count in sorted(origins.items())]


def _markdown(
    sweep: Sweep, said: list[str], drawn: list[Path], figures: Mapping[str, Drawing], tables: Tables
) -> str:
    """Return the report as text: answers, verdicts, warnings, figures, tables, provenance."""
    judged = tables.verdicts
    lines = [f"# {table_formats.markdown_text(sweep.name)}", ""]
    if len(judged):
        lines += [*_list(answers(judged)), ""]
        lines += [table_formats.markdown(_marked(verdict_table(judged))), ""]
        lines += _list(task_sentences(sweep, judged))
        lines += _list(explanation(judged))
    else:
        lines.append(no_verdict(sweep))
    lines += ["", "## Trials and warnings", "", said[0], "", *_list(said[1:])]
    lines += ["", "## Figures", ""]
    for path in _full_sizes(drawn):
        caption = table_formats.markdown_text(figures[path.stem].caption)
        lines += [f"![{path.stem}]({path.name})", "", f"{caption}.", ""]
    for it in tables.shown:
        lines += [f"## {table_formats.markdown_text(it.heading)}", "", table_formats.markdown(it.table), ""]
        lines += [it.note, ""] if it.note else []
    provenance = "\n".join(_provenance(sweep)).splitlines()
    return "\n".join([*lines, "## Provenance", "", *(f"    {line}" for line in provenance)])


def _list(sentences: Sequence[str]) -> list[str]:
    return [f"- {table_formats.markdown_text(sentence)}" for sentence in sentences]


def _marked(table: pd.DataFrame) -> pd.DataFrame:
    """Return the verdict table with violations and failures in bold."""
    bad = (INFEASIBLE, FAILED)
    texts = [f"**{text}**" if any(word in text for word in bad) else text for text in table["verdict"]]
    return table.assign(verdict=texts)


def remarks(sweep: Sweep) -> list[str]:
    """Return sentences on incomplete and doubtful results; empty for a complete sweep without doubts."""
    sentences = [*sweep.notes, *doubts(sweep)]
    for agent in without_episodes(sweep):
        sentences.append(f"{agent}: no episode has finished, so there are no learning curves")
    for status, what in (
        (TrialStatus.DAMAGED, "damaged"),
        (TrialStatus.FAILED, "failed"),
        (TrialStatus.RUNNING, "running or interrupted"),
        (TrialStatus.WAITING, "waiting to be run"),
    ):
        chosen = sweep.trials[sweep.trials["status"] == status.value]
        if status is TrialStatus.WAITING and (blank := chosen["env_steps"] == 0).any():
            sentences.append(f"{counted(int(blank.sum()), 'trial')}: not begun yet")
            chosen = chosen[~blank]
        for _, row in chosen.iterrows():
            done = row["env_steps"] / row["total_steps"]
            reason = f": {row['error']}" if row["error"] else ""
            title = f"{row['task']} {row['agent']} {row['method']} seed {row['seed']}"
            sentences.append(f"{title}: {what}, {done:.0%} of its steps done{reason}")
    complete = sweep.trials[sweep.trials["status"] == TrialStatus.COMPLETE.value]
    seeds = complete.groupby(list(GROUP), observed=True)["seed"].nunique()
    few = sorted({int(count) for count in seeds if count < ENOUGH_RUNS})
    if few and few != [1]:  # one seed: the answers say so
        sentences.append(
            f"{' or '.join(map(str, few))} seeds: bootstrap intervals are too short below {ENOUGH_RUNS} "
            f"seeds (marked {table_formats.TOO_FEW}); Student's hold for normal data; Wilson's cover about "
            "95% on average, but as low as 83% when the true fraction is near 0 or 1"
        )
    return sentences


def _count(sweep: Sweep) -> str:
    """Count trials by status: ``20 trials: 1 running, 19 complete.``."""
    counts = sweep.trials["status"].value_counts()
    states = [f"{counts[state.value]} {state.value}" for state in TrialStatus if counts.get(state.value)]
    return f"{counted(len(sweep.trials), 'trial')}: {', '.join(states)}."


def _full_sizes(drawn: list[Path]) -> dict[Path, str]:
    """Return each PNG with the name of its full-size file: the PDF if there is one."""
    files = set(drawn)
    return {
        path: next(it.name for it in (path.with_suffix(".pdf"), path) if it in files)
        for path in drawn
        if path.suffix == ".png"
    }
