"""A sweep's report as one self-contained HTML page, without scripts and external files.

Figures are embedded PNGs; a click magnifies one. Parts that are too wide for a phone scroll separately from
the page; in print they shrink instead. Folded sections are printed as well. All text is escaped.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import pandas as pd

STYLE = """\
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; background: #fff; margin: 0 auto;
       max-width: 74rem; padding: 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; border-top: 1px solid #ddd; padding-top: 1rem; }
a { color: #00548f; }
figure { margin: 1rem 0; }
figure img { width: 100%; min-width: 42rem; height: auto; display: block; cursor: zoom-in; }
figure input { position: absolute; opacity: 0; }
figure input:focus-visible + .scroll { outline: 2px solid #00548f; }
figure input:checked + .scroll img { width: 250%; min-width: 105rem; cursor: zoom-out; }
figcaption { color: #555; font-size: 0.85rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; overflow-wrap: normal; padding: 0.2rem 0.6rem 0.2rem 0; white-space: nowrap;
         border-bottom: 1px solid #e6e6e6; }
th { border-bottom: 2px solid #999; vertical-align: bottom; white-space: normal; }
pre { font-size: 0.8rem; background: #f6f6f6; padding: 0.6rem; overflow-x: auto; }
details { border-top: 1px solid #ddd; padding: 0.5rem 0; }
summary { cursor: pointer; }
summary h2 { display: inline; font-size: 1rem; border: 0; }
.answers { font-size: 1.1rem; padding-left: 1.2rem; }
.notes { color: #555; font-size: 0.85rem; }
ul.notes { padding-left: 1.2rem; }
.name { white-space: nowrap; }
td.name small { display: none; color: #555; font-weight: 400; }
tr.solved td.verdict { background: #e3f1e3; }
tr.infeasible td { background: #fbe9e7; }
tr.infeasible td.verdict, tr.failed td.verdict { color: #a11a0e; font-weight: 700; }
.verdicts td.verdict { white-space: normal; min-width: 13rem; }
.verdicts td:last-child { white-space: normal; min-width: 9rem; }
@media screen and (max-width: 44rem) {
  .verdicts td.verdict { min-width: 7rem; }
  .verdicts th { white-space: nowrap; }
  .verdicts th:nth-child(-n+2), .verdicts td:nth-child(-n+2) { display: none; }
  .verdicts th:nth-child(3), .verdicts td:nth-child(3) { position: sticky; left: 0; background: #fff; }
  .verdicts tr.infeasible td:nth-child(3) { background: #fbe9e7; }
  td.name small { display: block; }
  .scroll::before { content: "scroll sideways →"; position: sticky; left: 0; color: #555;
                    font-size: 0.8rem; }
}
ul.failed { border-left: 4px solid #c0392b; padding-left: 0.6rem; }
@media print {
  @page { margin: 14mm; }
  body { font-size: 10pt; max-width: none; padding: 0; }
  .scroll, pre { overflow: visible; }
  figure img, figure input:checked + .scroll img { width: 100%; min-width: 0; }
  figcaption a { display: none; }
  details::details-content { content-visibility: visible; block-size: auto; }
  .verdicts td { min-width: 0 !important; }
  tr { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  table { font-size: 6.5pt; width: 100%; }
  th, td { white-space: normal; padding-right: 0.3rem; }
  td.name { white-space: nowrap; }
  pre { white-space: pre-wrap; font-size: 7pt; }
  figure, tr { break-inside: avoid; }
  h2, summary { break-after: avoid; }
  details { border-top: 0; }
}
"""
HEAD = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">"""
NAMES = ("task", "agent", "curriculum")
HYPHENATED = re.compile(r"(?<!\S)(?=\S{1,30}(?!\S))(?:--)?\w+(?:-\w+)+")  # ppo-lag stays on one line


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        heading: its title.
        body: HTML from the functions below.
        folded: whether only the heading shows until it is opened.
    """

    heading: str
    body: str
    folded: bool = False

    @property
    def html(self) -> str:
        """The part with its heading."""
        heading = f"<h2>{escape(self.heading)}</h2>"
        if self.folded:
            return f"<details><summary>{heading}</summary>\n{self.body}\n</details>"
        return f"<section>{heading}\n{self.body}\n</section>"


def page(
    title: str,
    opening: str,
    sections: Sequence[Section],
    *,
    made: str = "",
    reload_seconds: int | None = None,
) -> str:
    """Return the whole page.

    Args:
        title: of the page.
        made: version and date of the results, below the title; or empty.
        opening: HTML below it.
        sections: its other parts.
        reload_seconds: interval at which an open page reloads; None if nothing will change.
    """
    reload = f'<meta http-equiv="refresh" content="{reload_seconds}">' if reload_seconds else ""
    return "\n".join(
        [
            f"{HEAD}{reload}",
            f"<title>{escape(title)}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>",
            f"<h1>{escape(title)}</h1>\n"
            + (f'<p class="notes">{escape(made)}</p>\n' if made else "")
            + opening,
            *(it.html for it in sections),
            "</body>\n</html>",
        ]
    )


def is_ours(page: Path) -> bool:
    """Return whether a file begins as the pages that recrl writes."""
    try:
        with page.open("rb") as file:
            return file.read(len(HEAD)) == HEAD.encode()
    except OSError:
        return False


def figure(png: Path, caption: str, file: str) -> str:
    """Return an embedded PNG, as wide as the page but never too small to read; a click magnifies it.

    Args:
        png: the image.
        caption: text below it.
        file: name of the file for the link in the caption.
    """
    data = base64.b64encode(png.read_bytes()).decode()
    text, name = escape(caption), escape(file)
    return (
        f'<figure><label><input type="checkbox" aria-label="magnify"><div class="scroll">'
        f'<img src="data:image/png;base64,{data}" alt="{text}"></div></label>'
        f'<figcaption>{text}. <a href="{name}">{name}</a></figcaption></figure>'
    )


def table(frame: pd.DataFrame, note: str = "", kinds: Sequence[str] = ()) -> str:
    """Return a table of finished text with a note below it.

    Args:
        frame: finished text.
        note: a sentence, or empty.
        kinds: the class of each row, or empty; without any, no row has one.
    """
    below = f'\n<p class="notes">{escape(note)}</p>' if note else ""
    of_rows = [f' class="{kind}"' if kind else "" for kind in kinds or [""] * len(frame)]
    return _table(frame, of_rows, "") + below


def verdict_table(frame: pd.DataFrame, kinds: Sequence[str]) -> str:
    """Return a table with rows coloured by their verdict.

    Args:
        frame: finished text, with a column ``verdict``.
        kinds: the class of each row, with spaces as hyphens.
    """
    return _table(frame, [f' class="{kind.replace(" ", "-")}"' for kind in kinds], ' class="verdicts"')


def _table(frame: pd.DataFrame, of_rows: Sequence[str], of_table: str) -> str:
    columns = [str(name) for name in frame]
    classes = {"verdict": ' class="verdict"' if of_table else "", **dict.fromkeys(NAMES, ' class="name"')}
    marks = [classes.get(name, "") for name in columns]
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    rows = []
    for kind, row in zip(of_rows, frame.to_numpy().tolist(), strict=True):
        cells = [escape(str(cell)) for cell in row]
        if of_table and columns[:3] == list(NAMES):  # a phone shows all three names in one column
            cells[2] = f"<small>{cells[0]} {cells[1]}</small>{cells[2]}"
        rows.append(f"<tr{kind}>" + "".join(map("<td{}>{}</td>".format, marks, cells)) + "</tr>")
    return (
        f'<div class="scroll"><table{of_table}><thead><tr>{head}</tr></thead>\n<tbody>'
        + "\n".join(rows)
        + "</tbody></table></div>"
    )


def items(sentences: Sequence[str], *, kind: str = "plain") -> str:
    """Return a list of sentences.

    Args:
        sentences: its items.
        kind: ``plain``, ``answers``, ``notes`` or ``failed``.
    """
    texts = (HYPHENATED.sub(r'<span class="name">\g<0></span>', escape(sentence)) for sentence in sentences)
    return f'<ul class="{kind}">' + "".join(f"<li>{text}</li>" for text in texts) + "</ul>"


def verbatim(text: str) -> str:
    """Return text verbatim."""
    return f"<pre>{escape(text)}</pre>"
