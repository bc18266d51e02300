"""Mapping deviation and amplification of x and y by a grating, after ISO 25178-600."""

from collections.abc import Callable, Iterator

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.cross_grating import MappingDeviation, in_plane, mapping_deviation
from greenough.pipeline.propagation import propagate
from greenough.pipeline.spot_points import spot_points
from greenough.pipeline.spots import BoardNotFound, Spots, detect_spots
from greenough.scenes.cross_grating import DRAWING

from ..setup import Setup
from .artefacts import Artefact, measure
from .rows import COVERAGE, Row, expected_range, row

NAMES = ("mapping_dx", "mapping_dy", "mapping_dx_rms", "mapping_dy_rms", "alpha_x", "alpha_y", "squareness_xy")

MARK_SD_UM = 1.1 / np.sqrt(2)
"""Of a mark's place along an axis: the paper measures distances of two with 1.1 um."""

SIMILARITY = "similarity between certified and measured marks"
AFFINE = "affine map between certified and measured marks"
FILTER = "phase averaged over each mark"


def mapping_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the cross grating under the lenses and judge where its marks seem to be."""
    grating = measure(setup, Placement("cross-grating"))
    advance(1)
    try:
        spots = detect_spots(grating.phase_map.background, DRAWING)
    except BoardNotFound as error:
        raise InputError(f"the marks of the cross grating were not found as those of a board are: {error}") from error
    yield from rows_of_marks(setup, grating, spots)


def rows_of_marks(setup: Setup, grating: Artefact, spots: Spots) -> Iterator[Row]:
    """Deviations of marks that lie at ``spots`` of the grating's picture."""
    marks = spot_points(grating.phase_map, spots, setup.calibration)
    certified = in_plane(grating.specimen.as_built["centres_mm"])
    found = mapping_deviation(in_plane(marks), certified)
    largest_sds = expected_range(found.n) / 2
    for k, axis in enumerate("xy"):
        deviation = 1e3 * found.deviations[np.isfinite(found.deviations[:, k]), k]
        yield row(
            setup, f"mapping_d{axis}", deviation[np.argmax(np.abs(deviation))], "um", found.n,
            f"the deviation of the largest magnitude along {axis}, of {found.of} marks; limit: what is expected of the "
            "largest of N normal deviates with the paper's scatter of a mark's place",
            limit=MARK_SD_UM * largest_sds, filter=FILTER, alignment=SIMILARITY,
        )  # fmt: skip
        yield row(
            setup, f"mapping_d{axis}_rms", float(np.sqrt(np.mean(deviation**2))), "um", found.n,
            f"root mean square deviation along {axis}; limit: the paper's scatter of a mark's place",
            limit=MARK_SD_UM, filter=FILTER, alignment=SIMILARITY,
        )  # fmt: skip
    for name, field, ideal in (
        ("alpha_x", "alpha_x", 1.0),
        ("alpha_y", "alpha_y", 1.0),
        ("squareness_xy", "squareness", 0.0),
    ):
        value = getattr(found, field)
        u = _standard_uncertainty(field, grating, marks, spots, certified, found)
        what = "measured over certified lengths" if ideal else "angle of the axes less a right one"
        against = "; peer: 1; its difference from 1 must keep to the limit" if ideal else "; limit"
        yield row(
            setup, name, value, "1" if ideal else "rad", found.n,
            f"{what}{against}: {COVERAGE:g} standard uncertainties, those of the board's pitch among them",
            limit=COVERAGE * u, judged=value - ideal, peer=ideal or None, u=u, filter=FILTER, alignment=AFFINE,
        )  # fmt: skip


def _standard_uncertainty(
    field: str, grating: Artefact, marks: np.ndarray, spots: Spots, certified: np.ndarray, found: MappingDeviation
) -> float:
    """Of one ``field`` of the mapping: by the calibration, and by the scatter of the marks about the affine map."""
    seen = np.isfinite(marks).all(axis=1)
    uncertainty = grating.raw.uncertainty
    by_calibration = 0.0
    if uncertainty is not None:
        by_calibration = propagate(
            lambda xyz: getattr(mapping_deviation(in_plane(xyz), certified[seen]), field),
            marks[seen], spots.centres_px[seen], uncertainty, None, np.random.default_rng(0),
        ).calibration_sd  # fmt: skip
    return float(np.hypot(by_calibration, getattr(found, f"{field}_sd")))
