"""What `greenough check` says of a rig of images, before a calibration takes its time: a row for each place."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from greenough.instrument.errors import InputError
from greenough.instrument.frame_figures import saturated
from greenough.instrument.image_rig import ImageRig, Place

from .decode import PhaseMap
from .sequence import decode_sequence
from .spots import detect_spots

LEAST_VALID = 0.5
"""Share of the pixels with fringes whose order is beyond doubt: where it is less, the fringes do not fit together."""

LARGEST_SATURATED_SHARE = 0.01
"""Of the picture."""

_FRINGES = 0.05  # of the strongest modulation, from which a pixel counts as one with fringes


@dataclass(frozen=True)
class ImageCheck:
    """What the frames of one posture or plane hold.

    Parameters
    ----------
    place : str
    height_mm : float or None
        Of a plane.
    frames : int or None
        How many; None where they cannot be read.
    first, last : str
        Names of frames, in the order that was taken.
    order : str
        Why it was.
    spots : int or None
        Found and measured on a posture.
    valid_share : float or None
        Pixels whose fringe order is beyond doubt, over those with fringes.
    saturated_share : float or None
        Of the picture, in any frame.
    holds : bool
    remedy : str
        What is wrong and what to do.
    """

    place: str
    height_mm: float | None
    frames: int | None
    first: str
    last: str
    order: str
    spots: int | None
    valid_share: float | None
    saturated_share: float | None
    holds: bool
    remedy: str


def check_images(rig: ImageRig, advance: Callable[[float], None]) -> list[ImageCheck]:
    """Read, decode and search each place for what a calibration needs of it; ``advance`` is called after each."""
    rows: list[ImageCheck] = []
    for place in rig.places:
        rows.append(_check_place(rig, place))
        advance(1)
    same = [k for k in range(1, len(rows)) if rows[k].order and rows[k].order == rows[k - 1].order]
    return [replace(row, order="as above") if k in same else row for k, row in enumerate(rows)]


def _check_place(rig: ImageRig, place: Place) -> ImageCheck:
    wrong: list[str] = []
    count = spots = valid = clipped = None
    names, order = ("", ""), ""
    try:
        if place.kind == "posture" and not rig.procedure.fringes_on_postures:
            frames, order = rig.white(place), "white light"
            image = frames.stack[0] - np.float32(frames.black_level_dn)
        else:
            frames, names, order = rig.fringes(place)
            phase_map = decode_sequence(frames, rig.procedure)
            image, valid = phase_map.background, _valid_share(phase_map)
        count, clipped = len(frames.stack), float(saturated(frames).mean())
        if clipped > LARGEST_SATURATED_SHARE:
            wrong.append(f"{clipped:.0%} of the picture is saturated: expose less")
        if valid is not None and valid < LEAST_VALID:
            wrong.append(
                f"fringe orders are in doubt in {1 - valid:.0%} of the pixels with fringes: check the order of the "
                "frames, periods_px, steps, start_deg and sign"
            )
        if place.kind == "posture":
            spots = int(detect_spots(image, rig.board).seen.sum())
    except InputError as error:
        wrong.append(str(error))
    return ImageCheck(
        place=f"{place.kind} {place.name}",
        height_mm=place.height_mm if place.kind == "plane" else None,
        frames=count,
        first=names[0],
        last=names[-1],
        order=order,
        spots=spots,
        valid_share=valid,
        saturated_share=clipped,
        holds=not wrong,
        remedy="; ".join(wrong),
    )


def _valid_share(phase_map: PhaseMap) -> float | None:
    """None where there are no fringes."""
    fringes = phase_map.modulation > _FRINGES * np.percentile(phase_map.modulation, 99.5)
    return float(phase_map.valid[fringes].mean()) if fringes.any() else None
