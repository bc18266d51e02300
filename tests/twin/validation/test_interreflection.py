"""What interreflections do to a ball grid array, rendered with and without them."""

from functools import lru_cache

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.fringes import FringeSet
from greenough.twin.validation.balls import BallGridAsMounted

SETTINGS = ("camera.rows=160", "camera.cols=200", "twin.optics.glass=false", "twin.render.nodes=8")
UM_PER_RAD = 160.0  # nearly everywhere: fringes of 0.21 mm at 12 degrees


@lru_cache
def seen(bounces: int) -> tuple[PhaseMap, np.ndarray, np.ndarray]:
    """Without noise: phases, slope of the ball that each pixel sees (°), and whether it is lit and seen."""
    rig, bench = gt.open("twin", [*SETTINGS, f"twin.render.bounces={bounces}"])
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    rig.operator.place(Placement("bga"))
    stack = rig.irradiance(fringes.patterns(*rig.projector.shape))
    truth, grid = bench.truth(), BallGridAsMounted.of(bench)
    return decode(stack / stack.max(), fringes), grid.slope_deg(grid.in_part(truth.xyz_world)), truth.lit_and_seen


def change_um(slopes: tuple[float, float]) -> np.ndarray:
    """Height that interreflections add where both maps are valid and balls slope so."""
    (direct, slope, lit), (full, _, _) = seen(1), seen(2)
    where = lit & direct.valid & full.valid & (slope >= slopes[0]) & (slope < slopes[1])
    assert where.sum() > 300
    return UM_PER_RAD * (full.absolute - direct.absolute)[where]


@pytest.mark.slow
def test_caps_are_free_of_them_and_walls_are_not():
    """A cap of 15 degrees mirrors what is above it, a wall of 45 degrees its neighbour."""
    cap, wall = change_um((0, 15)), change_um((30, 45))
    assert np.sqrt(np.mean(cap**2)) < 0.5
    assert np.sqrt(np.mean(wall**2)) > 10.0


def test_without_them_every_wall_is_valid():
    (direct, slope, lit), (full, _, _) = seen(1), seen(2)
    walls = lit & (slope > 30) & (slope < 60)
    assert direct.valid[walls].mean() > 0.99
    assert full.valid[walls].mean() < 0.8
    assert full.valid[lit & (slope < 15)].all()
