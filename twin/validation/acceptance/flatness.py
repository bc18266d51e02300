"""Flatness error of a plane at six places of the volume, after VDI/VDE 2634-2."""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.flatness import flatness

from ..setup import Setup
from ..volume import TILTS_DEG
from .artefacts import Artefact, each_treated, expected_width, measure
from .rows import CLAIM, CLAIM_UM, Row, range_limit_um, row

Pose = tuple[float, float, float, float, float, float]

PLACES: Mapping[str, Pose] = MappingProxyType(
    {f"{name}": (0.0, 0.0, z, 0.0, 0.0, 0.0) for name, z in (("low", -1.2), ("middle", 0.0), ("high", 1.2))}
    | {f"tilted_{k}": (0.0, 0.0, 0.0, *tilt, 0.0) for k, tilt in enumerate(TILTS_DEG, start=1)}
)
"""Where the plane is put: at three heights, and tilted about x, about y, and about both."""

NAMES = tuple(
    f"flatness_{share}_{place}{suffix}"
    for place in (*PLACES, "largest")
    for suffix in ("", "_filtered")
    for share in ("95", "all")
)


def flatness_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the plane at every place and judge how flat it seems."""
    planes = {}
    for place, pose in PLACES.items():
        planes[place] = measure(setup, Placement("plane", pose_mm_deg=pose))
        advance(1)
    yield from rows_of_planes(setup, planes)


def rows_of_planes(setup: Setup, planes: Mapping[str, Artefact]) -> Iterator[Row]:
    """Flatness at each place, by 95 % and by all points, and the largest of each."""
    found = [row for place, plane in planes.items() for row in _rows(setup, place, plane)]
    yield from found
    for suffix in ("", "_filtered"):
        for share in ("95", "all"):
            of = [each for place in planes for each in found if each.name == f"flatness_{share}_{place}{suffix}"]
            worst = max(of, key=lambda each: each.value)
            yield row(
                setup, f"flatness_{share}_largest{suffix}", worst.value, "um", worst.n,
                f"largest at {len(of)} places; {worst.criterion}", limit=worst.limit, peer=worst.peer,
                filter=worst.filter, alignment=worst.alignment,
            )  # fmt: skip


def _rows(setup: Setup, place: str, plane: Artefact) -> Iterator[Row]:
    for treated, where in each_treated(plane):
        result = flatness(treated.points.xyz[where])
        form, normals = result.form, np.broadcast_to(result.plane.normal, (result.form.n, 3))
        yield row(
            setup, f"flatness_95_{place}{treated.suffix}", 1e3 * form.range_95, "um", form.n,
            f"width of 95 % of the points about their best plane; peer: by noise alone; limit: twice {CLAIM}",
            limit=2 * CLAIM_UM, peer=1e3 * expected_width(treated.points, where, normals),
            filter=treated.filter, alignment="best plane",
        )  # fmt: skip
        yield row(
            setup, f"flatness_all_{place}{treated.suffix}", 1e3 * form.range_all, "um", form.n,
            "width of all N points, which grows with N, about their best plane; limit: twice "
            f"{CLAIM} of 95 %, for N points",
            limit=range_limit_um(form.n), filter=treated.filter, alignment="best plane",
        )  # fmt: skip
