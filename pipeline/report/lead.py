"""What a page opens with: the verdict as a table, and one picture of what was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import colours
from .figures import ACCENT, FAINT, FIRST, GRID, INK, SECOND, Panel, graph
from .map_panels import map_panel
from .page import Figure, Lead
from .tables import text_of
from .verdict_table import VERDICT_TEXT, counted_table, is_number, measured_text, verdict_table

_SPECIMENS = {"bga": "ball grid array"}
_REACH = 1.5  # times the limit: as far as bars go


def verdict_lead(lines: Sequence[Mapping[str, Any]], figure: Figure | None = None, for_papers: bool = False) -> Lead:
    """The verdict of a demo beside a figure; without one, beside how far each figure goes towards its limit."""
    return Lead(verdict_table(lines), VERDICT_TEXT, figure or limits_figure(lines, for_papers))


def acceptance_lead(lines: Sequence[Mapping[str, Any]], for_papers: bool = False) -> Lead:
    """The verdict of an acceptance, artefact by artefact, beside how many rows hold."""
    return Lead(counted_table(lines), "", counts_figure(lines, for_papers))


def relief_figure(
    stem: str, what: str, xyz: np.ndarray, origin: tuple[int, int], note: str, for_papers: bool
) -> Figure | None:
    """The height map of a specimen with a scale in mm and a colour bar.

    Parameters
    ----------
    stem : str
        How the panel's name begins.
    what : str
        The specimen.
    xyz : (rows, cols, 3) float
        Points on the camera's pixels, mm; NaN where there is none. None is drawn if that is everywhere.
    origin : (int, int)
        Row and column of the first pixel in the camera's picture.
    note : str
        What was done to the points.
    """
    height, what = xyz[..., 2], _SPECIMENS.get(what, what)
    if not np.isfinite(height).any():
        return None
    panels: list[Panel] = []
    low, high = colours.ends(height)
    apart = np.abs(np.diff(xyz[..., 0], axis=1))
    apart = apart[np.isfinite(apart)]
    map_panel(
        panels, f"{stem}-relief", f"{what}, measured height", height, "z (mm)", colours.HEIGHT, low, high, for_papers,
        origin=origin, mm_per_px=float(np.median(apart)) if len(apart) else None,
    )  # fmt: skip
    count = text_of(int(np.isfinite(height).sum()))
    return Figure(panels, f"{what[:1].upper()}{what[1:]} as it was measured: {count} points. {note}")


def limits_figure(lines: Sequence[Mapping[str, Any]], for_papers: bool) -> Figure | None:
    """Bars from zero to each figure as a share of its limit; where a limit must be reached, the limit's share of it."""
    shares = [(str(line.get("claim")), *share) for line in lines if (share := _share(line)) is not None]
    if not shares:
        return None
    panels: list[Panel] = []
    with graph(
        panels, "verdict-limits", "measured over limit", "share of the limit", "", "Figures as shares of their limits",
        for_papers, height_in=0.8 + 0.3 * len(shares),
    ) as axes:  # fmt: skip
        for k, (claim, share, spread) in enumerate(shares):
            axes.barh(k + 0.22, min(share, _REACH), height=0.3, color=FIRST if share <= 1 else SECOND, linewidth=0)
            if spread > 0 and share < _REACH:
                axes.plot([share - spread, min(share + spread, _REACH)], [k + 0.22, k + 0.22], color=INK, linewidth=1)
            beyond = "" if share <= _REACH else f": {measured_text(share, None)} times the limit"
            axes.text(0.01, k - 0.06, claim + beyond, fontsize=7.5, va="bottom")
        axes.axvline(1, color=ACCENT, linewidth=1)
        axes.set(xlim=(0, _REACH), ylim=(len(shares) - 0.4, -0.6), yticks=[])
        axes.grid(False, axis="y")
    return Figure(panels, "A figure keeps to its limit where its bar ends before the line at 1.")


def counts_figure(lines: Sequence[Mapping[str, Any]], for_papers: bool) -> Figure | None:
    """For each artefact, how many rows hold, do not hold or are missing, and only report."""
    counted = [line for line in lines if all(is_number(line.get(name)) for name in ("hold", "fail", "missing"))]
    if not counted:
        return None
    panels: list[Panel] = []
    parts = (
        ("hold", "hold", FIRST),
        ("fail", "fail", SECOND),
        ("missing", "missing", ACCENT),
        ("no_limit", "no limit", GRID),
    )
    with graph(
        panels, "verdict-rows", "rows of each artefact", "rows", "", "Rows that hold, fail or are missing", for_papers,
        height_in=1.1 + 0.34 * len(counted),
    ) as axes:  # fmt: skip
        done = np.zeros(len(counted))
        for name, label, colour in parts:
            n = np.array([float(line.get(name) or 0) for line in counted])
            axes.barh(np.arange(len(counted)) + 0.22, n, left=done, height=0.34, color=colour, label=label, linewidth=0)
            done += n
        for k, line in enumerate(counted):
            axes.text(0, k - 0.02, str(line.get("artefact")), fontsize=7.5, va="bottom")
        axes.set(xlim=(0, 1.05 * max(done.max(), 1)), ylim=(len(counted) - 0.4, -1.3), yticks=[])
        axes.grid(False, axis="y")
        axes.legend(loc="upper right", ncols=4, labelcolor=FAINT)
    return Figure(panels, "Rows without a limit only report.")


def _share(line: Mapping[str, Any]) -> tuple[float, float] | None:
    """A figure and its uncertainty over its limit, or the other way round where the limit must be reached."""
    measured, limit, spread = line.get("measured"), line.get("limit"), line.get("uncertainty")
    if not is_number(measured) or not is_number(limit) or limit <= 0 or measured == 0:
        return None
    if line.get("bound") == "about nominal":
        return None
    spread = abs(spread) if is_number(spread) else 0.0
    if line.get("bound") == "at least":
        return (limit / measured, limit / measured * (spread / measured)) if measured > 0 else None
    return abs(measured) / limit, spread / limit
