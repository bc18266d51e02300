"""Maps with axes and a colour bar, drawn by ourselves: a byte per pixel, in a hundredth of a plotting library's time.

A sheet holds lines, texts and pictures in points; it becomes SVG for the page and PNG for papers.
"""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw, ImageFont

from . import colours
from .figures import ACCENT, BOTTOM_IN, FAINT, INK, LEFT_IN, PAPER_DPI, TOP_IN, WIDTH_IN, Panel, themed

_POINTS = 72.0  # per inch
_LEFT, _TOP, _BOTTOM = _POINTS * LEFT_IN, _POINTS * TOP_IN, _POINTS * BOTTOM_IN
_WIDTH, _WIDE = _POINTS * WIDTH_IN, _POINTS * WIDTH_IN - _POINTS * LEFT_IN - 60.0
_GAP, _BAR = 8.0, 9.0  # between map and bar, and the bar's width
_TICK, _SMALL, _SIZE, _TITLE = 2.5, 8.0, 8.5, 9.0
_ACROSS_PX = 480  # a map on the page has at most so many pixels; the surfaces have them all
_COARSE = 64  # levels of colour on the page where neighbouring pixels differ by noise


@dataclass(frozen=True)
class _Line:
    x: tuple[float, float]
    y: tuple[float, float]
    colour: str
    width: float = 0.6
    dashed: bool = False


@dataclass(frozen=True)
class _Text:
    x: float
    y: float  # of the baseline
    text: str
    size: float
    anchor: str = "start"
    upright: bool = False
    colour: str = INK


@dataclass(frozen=True, eq=False)
class _Picture:
    x: float
    y: float
    width: float
    height: float
    values: np.ndarray
    palette: str
    low: float
    high: float
    counts: np.ndarray | None = None
    levels: int = 256


@dataclass(eq=False)
class _Sheet:
    height: float
    items: list[_Line | _Text | _Picture] = field(default_factory=list)


def map_panel(
    into: list[Panel],
    name: str,
    title: str,
    values: np.ndarray,
    unit: str,
    palette: str,
    low: float,
    high: float,
    for_papers: bool,
    *,
    counts: np.ndarray | None = None,
    origin: tuple[int, int] = (0, 0),
    step: int = 1,
    rows: Sequence[int] = (),
    spots: np.ndarray | None = None,
    mm_per_px: float | None = None,
) -> None:
    """A map with its colour bar, as a panel that is added to ``into``.

    Parameters
    ----------
    values : (rows, cols) float
        NaN stays empty; margins without any value are cut off.
    unit : str
        With what it is, for the bar.
    counts : (rows, cols) bool, optional
        Where it is False, colours are faded.
    origin : (int, int)
        Row and column of the first pixel in the camera's picture, to which the axes belong.
    step : int
        Camera pixels from one value to the next.
    rows : sequence of int
        Of the camera's picture, marked by dashed lines.
    spots : (n, 2) float, optional
        Column and row of points to mark.
    mm_per_px : float, optional
        Of the camera's pixels on the specimen: a bar below the map then shows a round length.
    """
    seen = _window(np.isfinite(values))
    values, counts = values[seen], None if counts is None else counts[seen]
    origin = origin[0] + step * seen[0].start, origin[1] + step * seen[1].start
    down, across = (step * n for n in values.shape)
    scale = min(_WIDE / across, 300.0 / down)
    width, height = scale * across, scale * down
    sheet = _Sheet(height + _TOP + _BOTTOM)
    right, bottom = _LEFT + width, _TOP + height

    def x_of(col: float) -> float:
        return _LEFT + scale * (col - origin[1] + 0.5)

    def y_of(row: float) -> float:
        return _TOP + scale * (row - origin[0] + 0.5)

    levels = 256 if palette in (colours.HEIGHT, colours.LIGHT) else _COARSE
    sheet.items.append(_Picture(_LEFT, _TOP, width, height, values, palette, low, high, counts, levels))
    sheet.items.append(_Text(_LEFT, _TOP - 6, title, _TITLE))
    for x, y in (((_LEFT, _LEFT), (_TOP, bottom)), ((_LEFT, right), (bottom, bottom))):
        sheet.items.append(_Line(x, y, FAINT))
    for col, label in _ticks(origin[1], origin[1] + across - 1, integer=True):
        sheet.items.append(_Line((x_of(col), x_of(col)), (bottom, bottom + _TICK), FAINT))
        sheet.items.append(_Text(x_of(col), bottom + 11, label, _SMALL, "middle"))
    for row, label in _ticks(origin[0], origin[0] + down - 1, integer=True):
        sheet.items.append(_Line((_LEFT - _TICK, _LEFT), (y_of(row), y_of(row)), FAINT))
        sheet.items.append(_Text(_LEFT - 5, y_of(row) + 3, label, _SMALL, "end"))
    sheet.items.append(_Text(_LEFT + width / 2, bottom + 23, "column (px)", _SIZE, "middle"))
    sheet.items.append(_Text(_LEFT - 32, _TOP + height / 2, "row (px)", _SIZE, "middle", upright=True))
    for row in rows:
        sheet.items.append(_Line((_LEFT, right), (y_of(row), y_of(row)), INK, 0.7, dashed=True))
    for col, row in () if spots is None else spots:
        x, y = x_of(col), y_of(row)
        sheet.items.append(_Line((x - 2, x + 2), (y, y), ACCENT, 0.8))
        sheet.items.append(_Line((x, x), (y - 2, y + 2), ACCENT, 0.8))
    if mm_per_px is not None and mm_per_px > 0:
        _scale_bar(sheet, right, bottom, scale / mm_per_px, width)
    _bar(sheet, right + _GAP, height, unit, palette, low, high)
    into.append(Panel(name, title, themed(_svg(sheet)), _png(sheet) if for_papers else None))


def _window(seen: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold everything seen; all where nothing is."""
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if len(rows) == 0:
        return slice(0, seen.shape[0]), slice(0, seen.shape[1])
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def _scale_bar(sheet: _Sheet, right: float, bottom: float, points_per_mm: float, width: float) -> None:
    """A round length below the map's right end: the longest of 1, 2 and 5 that takes at most a quarter of its width."""
    power = 10.0 ** math.floor(math.log10(width / 4 / points_per_mm))
    length = max(power * step for step in (1, 2, 5) if power * step * points_per_mm <= width / 4)
    left, y = right - length * points_per_mm, bottom + 20
    sheet.items.append(_Line((left, right), (y, y), INK, 1.6))
    label = f"{length:g} mm" if length >= 0.1 else f"{1e3 * length:g} µm"
    sheet.items.append(_Text(left - 4, y + 3, label, _SIZE, "end"))


def _bar(sheet: _Sheet, left: float, height: float, unit: str, palette: str, low: float, high: float) -> None:
    ramp = np.linspace(high, low, 256)[:, None]
    sheet.items.append(_Picture(left, _TOP, _BAR, height, ramp, palette, low, high))
    right, longest = left + _BAR, 0
    for value, label in _ticks(low, high):
        y = _TOP + height * (high - value) / (high - low)
        sheet.items.append(_Line((right, right + _TICK), (y, y), FAINT))
        sheet.items.append(_Text(right + 4, y + 3, label, _SMALL))
        longest = max(longest, len(label))
    sheet.items.append(_Text(right + 15 + 4.6 * longest, _TOP + height / 2, unit, _SIZE, "middle", upright=True))


def _ticks(low: float, high: float, integer: bool = False) -> list[tuple[float, str]]:
    """About five round numbers between two, and how they are written."""
    values = MaxNLocator(5, integer=integer, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    step = float(values[1] - values[0]) if len(values) > 1 else 1.0
    digits = next(k for k in range(10) if abs(step * 10**k - round(step * 10**k)) < 1e-6 or k == 9)
    inside = [float(value) for value in values if low - 1e-9 * step <= value <= high + 1e-9 * step]
    return [(value, f"{value + 0.0:.{digits}f}".replace("-", "−")) for value in inside]


def _svg(sheet: _Sheet) -> str:
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH:.1f}pt" height="{sheet.height:.1f}pt" '
        f'viewBox="0 0 {_WIDTH:.1f} {sheet.height:.1f}" font-family="system-ui, sans-serif">'
    ]
    for item in sheet.items:
        if isinstance(item, _Picture):
            step = 1 if item.values.shape[1] == 1 else -(-item.values.shape[1] // _ACROSS_PX)
            counts = None if item.counts is None else item.counts[::step, ::step]
            values = item.values[::step, ::step]  # not averaged, which would show less noise than there is
            png = colours.png_of(values, item.palette, item.low, item.high, counts, levels=item.levels)
            parts.append(
                f'<image x="{item.x:.2f}" y="{item.y:.2f}" width="{item.width:.2f}" height="{item.height:.2f}" '
                f'preserveAspectRatio="none" image-rendering="{"auto" if step == 1 else "pixelated"}" '
                f'href="data:image/png;base64,{base64.b64encode(png).decode("ascii")}"/>'
            )
        elif isinstance(item, _Line):
            dash = ' stroke-dasharray="3 2.2"' if item.dashed else ""
            parts.append(
                f'<path d="M{item.x[0]:.2f} {item.y[0]:.2f}L{item.x[1]:.2f} {item.y[1]:.2f}" '
                f'style="stroke:{item.colour}" stroke-width="{item.width}"{dash}/>'
            )
        else:
            at = f"translate({item.x:.2f} {item.y:.2f})" + (" rotate(-90)" if item.upright else "")
            parts.append(
                f'<text transform="{at}" font-size="{item.size}" text-anchor="{item.anchor}" '
                f'style="fill:{item.colour}">{escape(item.text)}</text>'
            )
    return "".join([*parts, "</svg>"])


def _png(sheet: _Sheet) -> bytes:
    scale = PAPER_DPI / _POINTS
    image = Image.new("RGB", (round(scale * _WIDTH), round(scale * sheet.height)), "white")
    draw = ImageDraw.Draw(image)
    for item in sheet.items:
        if isinstance(item, _Picture):
            png = colours.png_of(item.values, item.palette, item.low, item.high, item.counts, 0)
            size = round(scale * item.width), round(scale * item.height)
            shown = Image.open(io.BytesIO(png)).convert("RGBA").resize(size, Image.Resampling.NEAREST)
            image.paste(shown, (round(scale * item.x), round(scale * item.y)), shown)
        elif isinstance(item, _Line):
            _draw_line(draw, item, scale)
        else:
            _draw_text(image, draw, item, scale)
    png = io.BytesIO()
    image.save(png, format="png", dpi=(PAPER_DPI, PAPER_DPI), compress_level=1)
    return png.getvalue()


def _draw_line(draw: ImageDraw.ImageDraw, line: _Line, scale: float) -> None:
    (x0, x1), (y0, y1) = line.x, line.y
    length = max(abs(x1 - x0), abs(y1 - y0))
    pieces = [(k, min(k + 3.0, length)) for k in np.arange(0, length, 5.2)] if line.dashed else [(0.0, length)]
    for start, end in pieces:
        ends = [(scale * (x0 + (x1 - x0) * t), scale * (y0 + (y1 - y0) * t)) for t in (start / length, end / length)]
        draw.line(ends, fill=line.colour, width=max(1, round(scale * line.width)))


def _draw_text(image: Image.Image, draw: ImageDraw.ImageDraw, text: _Text, scale: float) -> None:
    font = _font(round(scale * text.size))
    anchor = {"start": "ls", "middle": "ms", "end": "rs"}[text.anchor]
    if not text.upright:
        draw.text((scale * text.x, scale * text.y), text.text, fill=text.colour, font=font, anchor=anchor)
        return
    left, top, right, bottom = (int(edge) for edge in font.getbbox(text.text, anchor="ls"))
    mask = Image.new("L", (right - left + 2, bottom - top + 2), 0)
    ImageDraw.Draw(mask).text((-left, -top), text.text, fill=255, font=font, anchor="ls")
    mask = mask.rotate(90, expand=True)
    corner = round(scale * text.x) + top, round(scale * text.y) - mask.height // 2
    image.paste(text.colour, (*corner, corner[0] + mask.width, corner[1] + mask.height), mask)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)
