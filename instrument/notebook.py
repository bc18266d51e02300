"""How a result shows itself in a notebook: small pictures and a table of facts, in HTML that stands alone.

Whatever comes from data is escaped, and pictures are part of the page. matplotlib is imported when a picture is drawn.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .contract import Frames

_LONGEST = 300  # characters of a fact
_DPI = 144
_CSS_DPI = 72  # half of it: sharp on fine displays
_LIMIT_PERCENTILES = (0.5, 99.5)
_SAMPLE = 200_000  # values that limits are found from
_UNKNOWN = "0.8"  # grey of pixels without a value
_FRAMES_SHOWN = 3
_LEFT = 'style="text-align:left"'  # notebooks align to the right


@dataclass(frozen=True)
class Picture:
    """A PNG file in memory, what it shows in words, and how wide it is to be shown, px."""

    png: bytes
    words: str
    width_px: int


def card(title: str, facts: Mapping[str, object], pictures: Sequence[Picture] = ()) -> str:
    """HTML of a title, pictures, and a table of facts: names with units to values. All text is escaped."""
    images = "".join(
        f'<img src="data:image/png;base64,{base64.b64encode(picture.png).decode("ascii")}" '
        f'alt="{escape(picture.words)}" width="{picture.width_px}" style="display:inline-block;margin:4px">'
        for picture in pictures
    )
    return f"<div><strong>{escape(title)}</strong><div>{images}</div>{table(list(facts.items()))}</div>"


def table(rows: Sequence[Sequence[object]], header: Sequence[str] = ()) -> str:
    """HTML of a table; all text is escaped, and numbers have four significant digits."""
    lines = [f"<tr>{''.join(f'<th {_LEFT}>{escape(name)}</th>' for name in header)}</tr>"] if header else []
    lines += [f"<tr>{''.join(f'<td {_LEFT}>{escape(_text(cell))}</td>' for cell in row)}</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def share(part: int, whole: int) -> str:
    """A count and its share of another."""
    return f"{part:,} of {whole:,}" + (f" ({part / whole:.1%})" if whole else "")


def span(values: np.ndarray) -> str:
    """Least and largest of the values that are finite."""
    finite = values[np.isfinite(values)]
    return f"{finite.min():.5g} to {finite.max():.5g}" if finite.size else "none"


def map_picture(
    values: np.ndarray,
    label: str,
    colours: str = "viridis",
    extent: tuple[float, float, float, float] | None = None,
    axes_labels: tuple[str, str] = ("column, px", "row, px"),
) -> Picture:
    """A map (rows, cols) with its scale.

    The colours span all values but the outermost hundredth; pixels without a value are grey.

    Parameters
    ----------
    values : (rows, cols)
    label : str
        Quantity and unit.
    colours : str
        One of matplotlib's colour maps.
    extent : 4 floats, optional
        Left, right, bottom and top, where the axes do not count pixels.
    axes_labels : (str, str)
    """
    figure, (axes,) = _figure(1)
    low, high = _limits(values)
    axes.set_facecolor(_UNKNOWN)
    image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, extent=extent)
    _name_axes(axes, axes_labels)
    figure.colorbar(image, ax=axes, label=label, extend="both", shrink=0.85)
    return to_picture(figure, f"map of {label}")


def frames_html(frames: "Frames") -> str:
    """A few of the frames, and how they were taken."""
    count = len(frames.stack)
    chosen = sorted({round(k * (count - 1) / (_FRAMES_SHOWN - 1)) for k in range(_FRAMES_SHOWN)}) if count else []
    facts = {
        "frames": count,
        "rows x columns": " x ".join(str(size) for size in frames.stack.shape[1:]),
        "type": str(frames.stack.dtype),
        "exposure, ms": frames.exposure_us / 1e3,
        "gain, dB": frames.gain_db,
        "black level, DN": frames.black_level_dn,
        "full scale, DN": frames.full_scale_dn,
        "stage position, mm": frames.stage_position_mm,
        "run": frames.run,
    }
    if not count:
        return card("Frames", facts)
    clipped = frames.stack.max(axis=0) >= frames.full_scale_dn
    facts["pixels saturated in any frame"] = share(int(clipped.sum()), clipped.size)
    facts["frame counter"] = f"{frames.serials[0]} to {frames.serials[-1]}"
    figure, every = _figure(len(chosen))
    low, high = _limits(frames.stack[chosen])
    for number, axes in zip(chosen, every, strict=True):
        image = axes.imshow(frames.stack[number], cmap="gray", vmin=low, vmax=high)
        axes.set_title(f"frame {number}", fontsize="small")
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(image, ax=every, label="grey value, DN", shrink=0.7)
    return card("Frames", facts, [to_picture(figure, f"frames {', '.join(map(str, chosen))}")])


def to_picture(figure: "Figure", words: str) -> Picture:
    """A figure drawn."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return Picture(buffer.getvalue(), words, round(figure.get_figwidth() * _CSS_DPI))


def _figure(columns: int) -> "tuple[Figure, list[Axes]]":
    """A small figure with axes beside each other."""
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(5.2 if columns == 1 else 2.6 * columns, 3.4 if columns == 1 else 2.2), layout="constrained"
    )
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def _name_axes(axes: "Axes", names: tuple[str, str]) -> None:
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Limits of a scale: the outermost hundredth does not decide, and they are never equal."""
    flat = values.ravel()
    sample = flat[:: max(1, flat.size // _SAMPLE)]
    sample = sample[np.isfinite(sample)]
    low, high = np.percentile(sample, _LIMIT_PERCENTILES) if sample.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def _text(value: Any) -> str:
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays
        value = value.tolist()
    if isinstance(value, bool):
        text = "yes" if value else "no"
    elif isinstance(value, int):
        text = f"{value:,}"
    elif isinstance(value, float):
        text = f"{value:.4g}" if math.isfinite(value) else str(value)
    elif isinstance(value, list | tuple):
        text = ", ".join(_text(item) for item in value) or "none"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"
