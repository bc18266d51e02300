"""Probing error on a sphere, and the error of two spheres' distance at seven places, after VDI/VDE 2634-2.

What counts of a sphere is its cap up to `CAP_DEG` of slope against the calibrated frame's z, decided by truth.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.sphere import Sphere, fit_sphere, probing_error, spacing_error

from ..setup import Setup
from .artefacts import Artefact, Measurand, Treated, calibration_sd, expected_width, measure
from .rows import CLAIM, CLAIM_UM, Row, range_limit_um, row

CAP_DEG = 60.0

SPACING_PLACES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "x": (0.0, 0.0),
        "y": (0.0, 90.0),
        "steep": (33.0, 0.0),
        "diagonal_1": (16.7, 36.9),
        "diagonal_2": (16.7, -36.9),
        "diagonal_3": (16.7, 143.1),
        "diagonal_4": (16.7, -143.1),
    }
)
"""Elevation and azimuth of the ball bar, degrees: along the axes, as steep as the range of heights allows, and along
the diagonals of 8 x 6 x 3 mm."""

FORM_NAMES = tuple(f"sphere_form_{share}{suffix}" for suffix in ("", "_filtered") for share in ("95", "all"))
SIZE_NAMES = ("sphere_size_95", "sphere_size_all")
PROBING_NAMES = FORM_NAMES + SIZE_NAMES
SPACING_NAMES = (*(f"sphere_spacing_{place}" for place in SPACING_PLACES), "sphere_spacing_largest")

_ON_SURFACE_MM = 1e-3  # facets depart from the sphere by less


def probing_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the sphere under the lenses and judge its form and size."""
    ball = measure(setup, Placement("sphere"))
    advance(1)
    yield from rows_of_sphere(setup, ball)


def spacing_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the two spheres at every place and judge their distance."""
    bars = {}
    for place, (elevation, azimuth) in SPACING_PLACES.items():
        bars[place] = measure(setup, Placement("two-spheres", pose_mm_deg=(0, 0, 0, 0, -elevation, azimuth)))
        advance(1)
    yield from rows_of_bars(setup, bars)


def cap(artefact: Artefact, ball: int, treated: Treated) -> np.ndarray:
    """Where the cap of one ball is judged and measured, (rows, cols) bool."""
    centre, radius = _certified(artefact, ball)
    offset = artefact.truth.xyz_world - centre
    distance = np.linalg.norm(offset, axis=-1)
    on_ball = np.abs(distance - radius) < _ON_SURFACE_MM
    return on_ball & (offset[..., 2] > np.cos(np.radians(CAP_DEG)) * distance) & artefact.judged & treated.points.valid


def rows_of_sphere(setup: Setup, artefact: Artefact) -> Iterator[Row]:
    """Probing errors of one measured sphere."""
    centre, radius = _certified(artefact, 0)
    what = f"Gauss sphere over the cap up to {CAP_DEG:g} degrees"
    for treated in artefact.treated:
        where = cap(artefact, 0, treated)
        found = probing_error(treated.points.xyz[where], 2 * radius)
        outwards = (artefact.truth.xyz_world[where] - centre) / radius
        predicted = 1e3 * expected_width(treated.points, where, outwards)
        yield row(
            setup, f"sphere_form_95{treated.suffix}", 1e3 * found.form.range_95, "um", found.form.n,
            f"shell of 95 % of the points about the {what}; peer: by noise alone; limit: twice {CLAIM}",
            limit=2 * CLAIM_UM, peer=predicted, filter=treated.filter,
        )  # fmt: skip
        yield row(
            setup, f"sphere_form_all{treated.suffix}", 1e3 * found.form.range_all, "um", found.form.n,
            f"shell of all N points, which grows with N, about the {what}; limit: twice {CLAIM} of 95 %, for N points",
            limit=range_limit_um(found.form.n), filter=treated.filter,
        )  # fmt: skip
    where = cap(artefact, 0, artefact.treated[0])
    points = artefact.raw.xyz[where]
    all_points = fit_sphere(points, radial_noise(artefact, 0, where))
    low, high = np.quantile(all_points.residuals, [0.025, 0.975])
    central = (all_points.residuals >= low) & (all_points.residuals <= high)
    by_calibration = calibration_sd(lambda xyz, _: fit_sphere(xyz).diameter, artefact.raw, where)
    for share, sphere in (("95", fit_sphere(points[central])), ("all", all_points)):
        yield row(
            setup, f"sphere_size_{share}", 1e3 * (sphere.diameter - 2 * radius), "um", sphere.n,
            f"diameter of the Gauss sphere of {share if share == 'all' else '95 %'} of the points, a cap of "
            f"{sphere.cap_half_angle_deg:.0f} degrees, less the certified one of {2 * radius:.5f} mm; limit: {CLAIM}",
            limit=CLAIM_UM, u=1e3 * float(np.hypot(all_points.diameter_sd, by_calibration)),
        )  # fmt: skip


def rows_of_bars(setup: Setup, bars: Mapping[str, Artefact]) -> Iterator[Row]:
    """Errors of the two spheres' distance, at each place and the largest of all."""
    errors, counts = [], []
    for place, bar in bars.items():
        caps = [cap(bar, ball, bar.treated[0]) for ball in (0, 1)]
        spheres = [fit_sphere(bar.raw.xyz[where], radial_noise(bar, k, where)) for k, where in enumerate(caps)]
        found = spacing_error(spheres[0], spheres[1], float(bar.specimen.as_built["spacing_mm"]))
        by_calibration = calibration_sd(_distance(caps), bar.raw, caps[0] | caps[1])
        errors.append(1e3 * found.error)
        counts.append(sum(found.n))
        elevation, azimuth = SPACING_PLACES[place]
        yield row(
            setup, f"sphere_spacing_{place}", errors[-1], "um", counts[-1],
            f"distance of the centres of two Gauss spheres less the certified one, bar raised by {elevation:g} and "
            f"turned by {azimuth:g} degrees; limit: {CLAIM}",
            limit=CLAIM_UM, u=1e3 * float(np.hypot(found.sd, by_calibration)),
        )  # fmt: skip
    largest = errors[int(np.argmax(np.abs(errors)))]
    yield row(
        setup, "sphere_spacing_largest", largest, "um", len(errors),
        f"the error of the largest magnitude at {len(errors)} places; limit: {CLAIM}", limit=CLAIM_UM,
    )  # fmt: skip


def radial_noise(artefact: Artefact, ball: int, where: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) of the raw points ``where`` (rows, cols) along the radius, mm."""
    centre, radius = _certified(artefact, ball)
    outwards = (artefact.truth.xyz_world[where] - centre) / radius
    return np.abs(np.sum(np.asarray(artefact.raw.noise_mm)[where] * outwards, axis=-1))


def _certified(artefact: Artefact, ball: int) -> tuple[np.ndarray, float]:
    """Where a ball's centre is, (3,) in the calibrated frame, and its radius; mm."""
    built = artefact.specimen.as_built
    return artefact.in_world(built["sphere_centres_mm"][ball]), float(built["sphere_diameters_mm"][ball]) / 2


def _distance(caps: Sequence[np.ndarray]) -> Measurand:
    """Distance of two spheres' centres, from points of both and the flat indices of their pixels."""
    of_first = caps[0].ravel()

    def distance(xyz: np.ndarray, pixels: np.ndarray) -> float:
        first = of_first[pixels]
        spheres: list[Sphere] = [fit_sphere(xyz[first]), fit_sphere(xyz[~first])]
        return float(np.linalg.norm(spheres[1].centre - spheres[0].centre))

    return distance
