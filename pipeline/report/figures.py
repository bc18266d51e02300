"""Single panels in one style, as SVG that follows the reader's light or dark page, and as PNG for papers.

Graphs are one pair of axes of matplotlib each; for maps see ``map_panels``.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator, NullLocator

from .tables import text_of

WIDTH_IN = 4.4
LEFT_IN, TOP_IN, BOTTOM_IN = 0.62, 0.30, 0.44
"""Width of every panel, and what surrounds its axes."""

PAPER_DPI = 200
_RIGHT_IN = 0.12

INK, FAINT, GRID, FIRST, SECOND, THIRD, FOURTH, ACCENT = (
    "#202124", "#5f6369", "#dcdee1", "#0b6bb0", "#c8590a", "#16805c", "#8a4fa3", "#e6007d",
)  # fmt: skip
"""Colours of a panel. On a dark page others take their places."""

_DARK = dict(
    zip(
        (INK, FAINT, GRID, FIRST, SECOND, THIRD, FOURTH, ACCENT),
        ("#e8eaed", "#a3a8ae", "#3c4044", "#6cb6f0", "#f0965a", "#5ac8a0", "#c79be0", "#ff5cad"),
        strict=True,
    )
)
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans", "font.size": 8.5, "axes.titlesize": 9, "axes.labelsize": 8.5, "legend.fontsize": 8,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "text.parse_math": False, "svg.fonttype": "none",
    "svg.hashsalt": "greenough", "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": FAINT,
    "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelcolor": INK, "ytick.labelcolor": INK, "grid.color": GRID,
    "grid.linewidth": 0.6, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.major.size": 2.5, "ytick.major.size": 2.5, "axes.axisbelow": True, "lines.linewidth": 1.1,
    "figure.facecolor": "none", "axes.facecolor": "none", "legend.frameon": False, "axes.spines.top": False,
    "axes.spines.right": False, "path.simplify_threshold": 0.3, "axes.unicode_minus": True,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of a figure.

    Parameters
    ----------
    name : str
        Of its file, without ending.
    alt : str
        What is in it, for those who do not see it.
    svg : str
    png : bytes or None
        The same for papers, where it was asked for.
    """

    name: str
    alt: str
    svg: str
    png: bytes | None = None

    @property
    def uri(self) -> str:
        """The SVG as data URI."""
        text = self.svg  # most of it is base64 already: only what means something in an URI is written otherwise
        for character, code in (("%", "%25"), ("#", "%23"), ('"', "'"), ("<", "%3C"), (">", "%3E"), ("\n", " ")):
            text = text.replace(character, code)
        return f"data:image/svg+xml,{text}"


@contextmanager
def graph(
    into: list[Panel], name: str, title: str, x: str, y: str, alt: str, for_papers: bool, height_in: float = 3.2
) -> Iterator[Axes]:
    """Axes to draw on; at the end the panel is added to ``into``, with its PNG if that is ``for_papers``."""
    with matplotlib.rc_context(_STYLE):
        canvas = Canvas(figsize=(WIDTH_IN, height_in))
        width, height = 1 - (LEFT_IN + _RIGHT_IN) / WIDTH_IN, 1 - (BOTTOM_IN + TOP_IN) / height_in
        axes = canvas.add_axes((LEFT_IN / WIDTH_IN, BOTTOM_IN / height_in, width, height))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(6))
        axes.text(0, 1 + 5 / (72 * height_in * height), title, transform=axes.transAxes, fontsize=9)
        axes.set(xlabel=x, ylabel=y)
        axes.grid(True)
        yield axes
        into.append(Panel(name, alt, _svg(canvas), _png(canvas) if for_papers else None))


def histogram(axes: Axes, samples: Sequence[tuple[str, np.ndarray, str]], reach: float, unit: str) -> None:
    """Labelled samples over one and a half times ``reach`` to both sides; tails show on a logarithmic scale."""
    most = 1.0
    for label, values, colour in samples:
        seen = values[np.isfinite(values)]
        beyond = float(np.mean(np.abs(seen) > 1.5 * reach)) if len(seen) else 0.0
        label = f"{label}, n = {text_of(len(seen))}" + (f", {100 * beyond:.2g} % beyond" if beyond else "")
        counts, edges = np.histogram(seen, bins=100, range=(-1.5 * reach, 1.5 * reach))
        axes.stairs(np.maximum(counts, 0.5), edges, color=colour, label=label, baseline=0.5)
        most = max(most, float(np.max(counts)))
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, position: text_of(int(value)) if value >= 1 else "")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set(xlim=(-1.5 * reach, 1.5 * reach), ylim=(0.8, 60 * most), xlabel=unit, ylabel="pixels")
    axes.legend(loc="upper left")


def themed(svg: str) -> str:
    """An SVG whose colours are variables: those of a light or of a dark page, as the reader's is."""
    light = "".join(f"--c{k}:{colour};" for k, colour in enumerate(_DARK))
    dark = "".join(f"--c{k}:{colour};" for k, colour in enumerate(_DARK.values()))
    for k, colour in enumerate(_DARK):
        svg = svg.replace(colour, f"var(--c{k})")
    style = f"svg{{{light}}}@media screen and (prefers-color-scheme:dark){{svg{{{dark}}}}}"
    head = svg.index(">") + 1
    return f"{svg[:head]}<style>{style}</style>{svg[head:]}"


def _svg(canvas: Canvas) -> str:
    text = io.StringIO()
    canvas.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    return themed(svg[svg.index("<svg") :].replace("'DejaVu Sans'", "system-ui, sans-serif"))


def _png(canvas: Canvas) -> bytes:
    """The panel for papers, on white."""
    png = io.BytesIO()
    canvas.savefig(png, format="png", dpi=PAPER_DPI, facecolor="white", pil_kwargs={"compress_level": 1})
    return png.getvalue()
