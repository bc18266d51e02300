"""Lateral resolution by a chirp: the period of which half the height is left, along x and along y."""

from collections.abc import Callable, Iterator

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.lateral_resolution import height_transfer, lateral_period_limit, whole_cycles
from greenough.scenes.chirp import LENGTH_MM, WIDTH_MM, period

from ..setup import Setup
from .artefacts import Artefact, Treated, measure
from .relief_transfer import relief_transfer
from .rows import Row, row

TURNED_DEG = {"x": 0.0, "y": 90.0}
NAMES = tuple(f"lateral_period_limit_{axis}{suffix}" for axis in TURNED_DEG for suffix in ("", "_filtered"))

TOLERANCE = 0.05
"""By how much the measured period may exceed the predicted one, as a share: chosen, not derived."""

_STRIP_MM = 0.25  # across the relief: noise is not correlated over so much, with the filter neither
_FROM_SIDES_MM = 0.1


def resolution_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the chirp along both axes and judge the finest relief that is seen at half its height."""
    for axis, turned in TURNED_DEG.items():
        chirp = measure(setup, Placement("chirp", pose_mm_deg=(0.0, 0.0, 0.0, 0.0, 0.0, turned)))
        advance(1)
        yield from rows_of_chirp(setup, axis, chirp)


def rows_of_chirp(setup: Setup, axis: str, chirp: Artefact) -> Iterator[Row]:
    """Lateral period limits along one axis, without and with the filter."""
    optics = setup.bench.settings.optics
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    for treated in chirp.treated:
        where = _on_relief(chirp, treated)
        found = lateral_period_limit(height_transfer(*_relief(chirp, treated, where)))
        transfer = relief_transfer(setup, chirp.phase_map, where, filtered=treated.suffix != "")
        predicted = pixel * transfer.limit_px(axis)
        yield row(
            setup, f"lateral_period_limit_{axis}{treated.suffix}", found.period, "mm", found.n,
            "period of which half the height is left; peer: by the calibration's point spread, the shading of slopes, "
            "and the filter; what must keep to the limit, a chosen tolerance, is the ratio's excess over 1",
            limit=TOLERANCE, judged=max(found.period / predicted - 1, 0.0), peer=predicted, u=found.sd,
            filter=treated.filter,
        )  # fmt: skip


def _on_relief(chirp: Artefact, treated: Treated) -> np.ndarray:
    """Pixels that see the chirp and have a point, (rows, cols) bool."""
    x, y = np.moveaxis(chirp.in_part(chirp.truth.xyz_world)[..., :2], -1, 0)
    on_relief = (np.abs(x) < LENGTH_MM / 2) & (np.abs(y) < WIDTH_MM / 2 - _FROM_SIDES_MM)
    return on_relief & chirp.truth.lit_and_seen & treated.points.valid


def _relief(chirp: Artefact, treated: Treated, where: np.ndarray) -> tuple[np.ndarray, ...]:
    """Groups, periods, true and measured heights, and strips, all (n,), of the pixels ``where``."""
    along, across, true = chirp.in_part(chirp.truth.xyz_world[where]).T
    local = period(along)
    strips = np.floor(across / _STRIP_MM).astype(int)
    return whole_cycles(along, local), local, true, chirp.in_part(treated.points.xyz[where])[:, 2], strips
