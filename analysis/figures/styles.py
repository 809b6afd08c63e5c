"""Common style of figures: colour, dashes and marker of each method, print sizes, reproducible files.

Most colours are Okabe and Ito's (2008), distinguishable with all common forms of colour blindness; those of
``cooling``, ``unconstrained`` and most spare styles are ours. Dashes and markers differ in greyscale, too. A
known method has the same style in every figure of every sweep; others take the spare styles in order of their
names. Matplotlib's global state does not change: ``context`` applies to a ``with`` block.
"""

from __future__ import annotations

import io
import re
import string
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.text import Text

from recrl.analysis.data.labels import METHOD_ORDER, ordered
from recrl.orchestrator.files.atomic_files import write_atomically

if TYPE_CHECKING:
    from recrl.analysis.data.sweep_data import Sweep

# Formulas in figures: ours, and matplotlib's for numbers on an axis.
OUR_FORMULAS = re.compile(r"\$(?:d_d|J\^\*\(d(?:_d)?\)|\\mathdefault\{[^$]*\})\$")
TEXT_WIDTH = 7.0  # inches, of a page with two columns
PNG_DPI = 200
LIMIT_COLOUR = "#00b7c7"
IN_FORCE_COLOUR = "#5c5c5c"  # of the limits in force; LIMIT_COLOUR, dashed, is the deployment limit only
OPTIMUM_COLOUR = "#8a8a8a"


@dataclass(frozen=True)
class MethodStyle:
    """Style of a method's line.

    Attributes:
        colour: hexadecimal.
        dashes: matplotlib's on/off pattern in points; empty for a solid line.
        marker: matplotlib's marker.
        width: of the line, points.
    """

    colour: str
    dashes: tuple[float, ...]
    marker: str
    width: float = 1.1

    @property
    def linestyle(self) -> Literal["-"] | tuple[float, Sequence[float]]:
        """Return the line style for matplotlib."""
        return (0.0, self.dashes) if self.dashes else "-"

    @property
    def line(self) -> dict[str, Any]:
        """Return the line's keywords of ``Axes.plot``, without the marker."""
        return {"color": self.colour, "linestyle": self.linestyle, "linewidth": self.width}


STYLES = {
    "none": MethodStyle("#000000", (), "o"),
    "linear": MethodStyle("#e69f00", (5.0, 1.5), "s"),
    "cosine": MethodStyle("#0072b2", (5.0, 1.5, 1.2, 1.5), "^"),
    "exponential": MethodStyle("#009e73", (1.4, 1.2), "v"),
    "dynamic": MethodStyle("#d55e00", (), "D", 1.5),
    "cooling": MethodStyle("#44aa99", (4.0, 1.0, 1.0, 1.0), ">"),
    "step": MethodStyle("#cc79a7", (8.0, 2.0), "P"),
    "unconstrained": MethodStyle("#7a7a7a", (3.0, 1.2, 1.0, 1.2, 1.0, 1.2), "X"),
}
SPARE_STYLES = (
    MethodStyle("#aa4499", (6.0, 1.2, 3.0, 1.2), "H"),
    MethodStyle("#56b4e9", (2.5, 1.0), "p"),
    MethodStyle("#117733", (7.0, 1.5, 1.2, 1.5, 1.2, 1.5), "d"),
    MethodStyle("#b8a800", (1.0, 0.8), "h"),
    MethodStyle("#332288", (4.0, 2.5), "*"),
)


def method_styles(methods: Sequence[str]) -> dict[str, MethodStyle]:
    """Return the style of every method, in the order of METHOD_ORDER, then of the names.

    >>> list(method_styles(["mine", "dynamic", "none"]))
    ['none', 'dynamic', 'mine']
    """
    spare = [method for method in ordered(methods, METHOD_ORDER) if method not in STYLES]
    taken = {method: _spare_style(index) for index, method in enumerate(spare)}
    return {method: STYLES.get(method) or taken[method] for method in ordered(methods, METHOD_ORDER)}


def styles_of(sweep: Sweep) -> dict[str, MethodStyle]:
    """Return the style of every method of a sweep."""
    return method_styles(list(sweep.trials["method"].cat.categories))


def _spare_style(index: int) -> MethodStyle:
    """Return the style of the index-th method without one of its own; after the colours the rest varies."""
    again, position = divmod(index, len(SPARE_STYLES))
    style = SPARE_STYLES[position]
    if not again:
        return style
    other = SPARE_STYLES[(position + again) % len(SPARE_STYLES)]
    marker = f"${string.ascii_lowercase[index % 26]}$"
    return replace(style, dashes=other.dashes, marker=marker, width=style.width + 0.4 * again)


def context() -> AbstractContextManager[None]:
    """Use matplotlib's defaults with our sizes for a ``with`` block, independent of the user's settings."""
    settings = dict(mpl.rcParamsDefault)
    settings.pop("backend", None)  # setting it would load a user interface
    settings |= {
        "font.family": "DejaVu Sans",
        "font.size": 7.0,
        "axes.titlesize": 7.0,
        "axes.labelsize": 7.0,
        "xtick.labelsize": 6.0,
        "ytick.labelsize": 6.0,
        "legend.fontsize": 7.0,
        "axes.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": False,
        "axes.ymargin": 0.09,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "lines.markersize": 3.0,
        "legend.frameon": False,
        "pdf.fonttype": 42,  # TrueType: text stays text, as publishers require
        "figure.dpi": 100,
    }
    return mpl.rc_context(settings)


def save(figure: Figure, folder: Path, stem: str) -> list[Path]:
    """Write a figure as PDF (vector) and PNG (200 dpi); equal figures give equal bytes.

    Args:
        figure: made within ``context``.
        folder: created if necessary.
        stem: of the two file names.
    """
    pdf, png = folder / f"{stem}.pdf", save_png(figure, folder / f"{stem}.png")
    blank = {"Creator": "recrl", "Producer": None, "CreationDate": None}
    with context():  # ticks exist only now
        figure.set_layout_engine("none")  # keep the places just found: the layout takes a second
        _write(figure, pdf, metadata=blank)
    return [pdf, png]


def remove(folder: Path, stem: str) -> None:
    """Remove the files of ``save``, if they are there."""
    for suffix in (".pdf", ".png"):
        (folder / f"{stem}{suffix}").unlink(missing_ok=True)


def save_png(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG; equal figures give equal bytes.

    Args:
        figure: made within ``context``.
        path: of the file; its folder is created if necessary.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _show_dollars(figure)
    with context():
        _write(figure, path, dpi=PNG_DPI, metadata={"Software": None})
    return path


def _write(figure: Figure, path: Path, **options: Any) -> None:
    """Write a figure in the format of the path's suffix; in place of a link, and not through it."""
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix.removeprefix("."), **options)
    write_atomically(path, picture.getvalue())


def _show_dollars(figure: Figure) -> None:
    """Escape dollar signs in a label, which would start TeX."""
    for text in figure.findobj(Text):
        if isinstance(text, Text) and "$" in OUR_FORMULAS.sub("", text.get_text()):
            text.set_parse_math(False)
