"""An artefact as it was measured, beside the truth of each pixel."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import deconvolved, measure_phase
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
from greenough.pipeline.propagation import propagate
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.parts import Specimen

from ...bench import Truth
from ..evaluation import smooth
from ..measured import noise_quantile
from ..setup import NO_FILTER, Setup

Measurand = Callable[[np.ndarray, np.ndarray], float]
"""Of points (n, 3) and the flat indices (n,) of their pixels."""

_POINTS = 1500  # that stand for all when the calibration's uncertainty is propagated


@dataclass(frozen=True, eq=False)
class Treated:
    """Points after one treatment of the phase, and how names of rows about them end."""

    filter: str
    suffix: str
    points: PointMap


@dataclass(frozen=True, eq=False)
class Artefact:
    """One artefact, measured once.

    Parameters
    ----------
    specimen : Specimen
        As built: its certificate.
    world_from_part : (4, 4)
        Where it lay.
    truth : Truth
    phase_map : PhaseMap
        Unfiltered, deconvolved if that was asked for.
    treated : tuple of Treated
        First as measured, then with the one filter.
    judged : (rows, cols) bool
        Lit, seen and smooth, by truth alone.
    """

    specimen: Specimen
    world_from_part: np.ndarray
    truth: Truth
    phase_map: PhaseMap
    treated: tuple[Treated, ...]
    judged: np.ndarray

    @property
    def raw(self) -> PointMap:
        """Points without any filter."""
        return self.treated[0].points

    def in_part(self, xyz_world: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the calibrated frame in the part's own."""
        return (xyz_world - self.world_from_part[:3, 3]) @ self.world_from_part[:3, :3]

    def in_world(self, xyz_part: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the part's frame in the calibrated one."""
        return xyz_part @ self.world_from_part[:3, :3].T + self.world_from_part[:3, 3]


def measure(
    setup: Setup, placement: Placement, brackets: Sequence[float] = (1.0,), deconvolve: bool = False
) -> Artefact:
    """Lay an artefact under the lenses and measure it, as `greenough measure` does."""
    phase_map = measure_phase(setup.rig, setup.calibration, placement, brackets)
    truth = setup.bench.truth()
    done = NO_FILTER
    if deconvolve and setup.calibration.point_spread is not None:
        phase_map = deconvolved(phase_map, setup.calibration)
        done = "deconvolved"
    filtered = filter_phasors(phase_map, setup.filter_fwhm_px)
    also = setup.filter_name if done == NO_FILTER else f"{done}, {setup.filter_name}"
    return Artefact(
        specimen=setup.bench.specimen,
        world_from_part=setup.bench.world_from_part,
        truth=truth,
        phase_map=phase_map,
        treated=(
            Treated(done, "", setup.points(phase_map)),
            Treated(also, "_filtered", setup.points(filtered)),
        ),
        judged=truth.lit_and_seen & smooth(truth, setup.airy_radius_px),
    )


def expected_width(points: PointMap, where: np.ndarray, normals: np.ndarray) -> float:
    """What the central 95 % of the points ``where`` (rows, cols) span along their ``normals`` (n, 3) by noise, mm."""
    noise = np.asarray(points.noise_mm)[where]
    return 2 * noise_quantile(np.abs(np.sum(noise * normals, axis=-1)))


def calibration_sd(measurand: Measurand, points: PointMap, where: np.ndarray) -> float:
    """Standard uncertainty by the calibration of a measurand of the points ``where`` (rows, cols), mm or what it is in.

    Some points stand for all: the calibration's errors are smooth. NaN if the calibration states none.
    """
    if points.uncertainty is None:
        return float("nan")
    chosen = np.flatnonzero(where)
    chosen = chosen[:: max(1, len(chosen) // _POINTS)]
    v, u = np.unravel_index(chosen, where.shape)
    estimate = propagate(
        lambda xyz: measurand(xyz, chosen),
        points.xyz.reshape(-1, 3)[chosen],
        np.stack([u, v], axis=-1),
        points.uncertainty,
        None,
        np.random.default_rng(0),
    )
    return estimate.calibration_sd


def each_treated(artefact: Artefact) -> Iterator[tuple[Treated, np.ndarray]]:
    """Each treatment's points, and where they are measured and judged."""
    for treated in artefact.treated:
        yield treated, artefact.judged & treated.points.valid
