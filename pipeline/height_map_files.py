"""Height maps as programs for surface texture read them, in metres.

Gwyddion counts y downwards, and so do its files: their y is ours with the other sign, and the picture is the part as
seen from above. ISO 25178-72 has a right-handed frame with the first row lowest: x and y in an x3p file are ours.
Programs that do not mind the frame, Gwyddion among them, show such a file mirrored, its first row uppermost.
"""

from pathlib import Path

import numpy as np
import x3pio
from gwyfile.objects import GwyContainer, GwyDataField

from greenough.instrument.files import atomic_path

from .height_map import HeightMap
from .plain_text import plain_text

_M = 1e-3
_TITLE = "Height"


def write_gwy(heights: HeightMap, path: str | Path) -> None:
    """Write Gwyddion's own format, double precision, with voids as a mask; under it lies the mean height."""
    place = {
        "xreal": _M * heights.pitch * heights.z.shape[1],
        "yreal": _M * heights.pitch * heights.z.shape[0],
        **_offsets(heights),
        "si_unit_xy": "m",
    }
    voids = heights.voids
    filled = _M * np.where(voids, np.nanmean(heights.z), heights.z)
    known = {key: plain_text(value) for key, value in heights.facts.items()}
    container = GwyContainer(
        {
            "/0/data": GwyDataField(filled, si_unit_z="m", **place),
            "/0/data/title": _TITLE,
            "/0/meta": GwyContainer(known, typecodes=dict.fromkeys(known, "s")),
        }
    )
    if voids.any():
        container["/0/mask"] = GwyDataField(voids.astype(float), **place)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        container.tofile(file)


def write_gsf(heights: HeightMap, path: str | Path) -> None:
    """Write a Gwyddion Simple Field: lines of text, then single precision, with NaN for voids."""
    rows, cols = heights.z.shape
    offsets = _offsets(heights)
    lines = {
        "XRes": cols,
        "YRes": rows,
        "XReal": _M * heights.pitch * cols,
        "YReal": _M * heights.pitch * rows,
        "XOffset": offsets["xoff"],
        "YOffset": offsets["yoff"],
        "XYUnits": "m",
        "ZUnits": "m",
        "Title": _TITLE,
    }
    known = {key: plain_text(value) for key, value in heights.facts.items() if key.isidentifier() and key not in lines}
    text = "Gwyddion Simple Field 1.0\n" + "".join(f"{key} = {value}\n" for key, value in (lines | known).items())
    header = text.encode()
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(header + bytes(4 - len(header) % 4))  # the numbers begin at a multiple of 4, after one zero at least
        file.write((_M * heights.z).astype("<f4").data)


def write_x3p(heights: HeightMap, path: str | Path) -> None:
    """Write an x3p file of ISO 25178-72, double precision, with NaN for voids."""
    facts = {key: plain_text(value) for key, value in heights.facts.items()}
    metadata = x3pio.Metadata(
        instrument=x3pio.Instrument("unknown", facts.get("rig", "unknown"), "", "greenough"),
        probing_system=x3pio.ProbingSystem(x3pio.ProbingType.NON_CONTACTING, "fringe projection"),
        comment="\n".join(f"{key}={value}" for key, value in facts.items()),
    )
    with atomic_path(path) as temporary:
        x3pio.write(
            temporary,
            _M * heights.z[::-1],
            x_scale=_M * heights.pitch,
            y_scale=_M * heights.pitch,
            metadata=metadata,
            placement=x3pio.Placement.translation(_M * heights.left, _M * heights.bottom, 0.0),
            coordinate_system=x3pio.CoordinateSystem.VIEW,
        )


def _offsets(heights: HeightMap) -> dict[str, float]:
    """Upper left corner of the first node's square in Gwyddion's frame, m."""
    return {
        "xoff": _M * (heights.left - heights.pitch / 2),
        "yoff": -_M * (heights.top + heights.pitch / 2),
    }
