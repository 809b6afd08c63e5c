"""The directive ``solved-table``: counts of solved trials from a committed ``outcomes.csv``.

    ```{solved-table} results/rivergrid/fresh/outcomes.csv
    :methods: none, linear, dynamic
    ```

``recrl.analysis.statistics.verdicts`` defines "solved" and its tolerance.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pandas as pd
from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from recrl.analysis.statistics.verdicts import solved

ROOT = Path(__file__).resolve().parents[2]
MEASURES = {
    "stochastic": "final policy, stochastic",
    "deterministic": "final policy, deterministic",
    "deployment": "deployment phase",
}


def solved_table(path: Path, methods: list[str]) -> str:
    """Return a Markdown table with one row per task, agent and curriculum.

    Args:
        path: an ``outcomes.csv``.
        methods: the curricula to show, in this order; all if empty.
    """
    rows = pd.read_csv(path)
    rows["solved"] = solved(rows)
    shown = methods or list(dict.fromkeys(rows["method"]))
    lines = [f"| task | agent | curriculum | {' | '.join(MEASURES.values())} |", "|---|---|---|---|---|---|"]
    for (task, agent), cell in rows.groupby(["task", "agent"], sort=False):
        for method in shown:
            of = cell[cell["method"] == method]
            if of.empty:
                continue
            counts = [of.loc[of["measure"] == measure, "solved"] for measure in MEASURES]
            texts = " | ".join(f"{int(each.sum())} of {len(each)}" for each in counts)
            lines.append(f"| `{task}` | `{agent}` | `{method}` | {texts} |")
    return "\n".join(lines)


class SolvedTable(SphinxDirective):
    """See the module's docstring."""

    required_arguments = 1
    option_spec: ClassVar = {"methods": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the table."""
        path = ROOT / self.arguments[0]
        self.env.note_dependency(str(path))
        methods = [it.strip() for it in self.options.get("methods", "").split(",") if it.strip()]
        table = nodes.container()
        self.state.nested_parse(StringList(solved_table(path, methods).split("\n")), 0, table)
        for each in table.findall(nodes.table):
            each["classes"].append("names")  # recrl.css keeps names on one line
        return list(table.children)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_directive("solved-table", SolvedTable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
