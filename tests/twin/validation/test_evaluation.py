"""Claims about the rule that says where a surface is smooth, on surfaces whose departure is known."""

import numpy as np
import pytest

from greenough.twin import Truth
from greenough.twin.validation.evaluation import MAX_DEPARTURE_MM, smooth

PIXEL_MM = 0.01
RADIUS_PX = 4.3


def truth_of(z: np.ndarray, slope: tuple[np.ndarray, np.ndarray], lit: np.ndarray | None = None) -> Truth:
    """A surface z(x, y) on square pixels, seen from above."""
    rows, cols = z.shape
    x, y = np.meshgrid(np.arange(cols) * PIXEL_MM, -np.arange(rows) * PIXEL_MM)
    normal = np.stack([-slope[0], -slope[1], np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    nothing = np.zeros_like(z)
    seen = np.ones(z.shape, bool) if lit is None else lit
    return Truth(np.stack([x, y, z], axis=-1), normal, nothing, nothing, seen, np.eye(4))


def interior(shape: tuple[int, int], margin: int = 5) -> np.ndarray:
    inside = np.zeros(shape, bool)
    inside[margin:-margin, margin:-margin] = True
    return inside


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2), (-1.5, 2.0)])
def test_a_plane_is_smooth_wherever_the_disc_lies_in_the_picture(slope):
    rows, cols = 40, 50
    x, y = np.meshgrid(np.arange(cols) * PIXEL_MM, -np.arange(rows) * PIXEL_MM)
    truth = truth_of(slope[0] * x + slope[1] * y, (np.full(x.shape, slope[0]), np.full(x.shape, slope[1])))
    judged = smooth(truth, RADIUS_PX)
    assert judged[interior((rows, cols), 4)].all()
    assert not judged[:4].any()
    assert not judged[:, -4:].any()


@pytest.mark.parametrize("times", [0.8, 1.25])
def test_a_bowl_is_smooth_if_its_sagitta_over_the_disc_is_small(times):
    """z = k r²/2 departs from its best plane over a disc of radius a by k a²/4 at the middle and the rim."""
    rows = cols = 41
    reach = RADIUS_PX * PIXEL_MM
    grid = np.arange(-5, 6)
    du, dv = np.meshgrid(grid, grid)
    distance2 = (du**2 + dv**2)[du**2 + dv**2 <= RADIUS_PX**2] * PIXEL_MM**2
    share = np.abs(distance2 - distance2.mean()).max() / 2  # on pixels; reach²/4 for a full disc
    assert share == pytest.approx(reach**2 / 4, rel=0.15)
    curvature = times * MAX_DEPARTURE_MM / share
    x, y = np.meshgrid((np.arange(cols) - 20) * PIXEL_MM, (20 - np.arange(rows)) * PIXEL_MM)
    truth = truth_of(curvature * (x**2 + y**2) / 2, (curvature * x, curvature * y))
    assert smooth(truth, RADIUS_PX)[20, 20] == (times < 1)


def test_the_departure_counts_perpendicular_to_the_surface():
    """On a slope of 60 degrees a ripple departs vertically by twice what it departs perpendicularly."""
    rows, cols = 31, 31
    x, _ = np.meshgrid((np.arange(cols) - 15) * PIXEL_MM, np.arange(rows))
    steep = np.tan(np.radians(60))
    ripple = 1.4e-3 * np.sin(2 * np.pi * x / (40 * PIXEL_MM)) ** 2
    nothing = np.zeros((rows, cols))
    flat_slope, steep_slope = (nothing, nothing), (np.full((rows, cols), steep), nothing)
    radius = 10.2  # over half a period the ripple departs by about its amplitude
    assert smooth(truth_of(ripple, flat_slope), radius)[15, 15]
    assert not smooth(truth_of(2 * ripple, flat_slope), radius)[15, 15]
    assert smooth(truth_of(2 * ripple + steep * x, steep_slope), radius)[15, 15]


def test_a_step_is_not_smooth_within_the_disc_on_either_side():
    z = np.zeros((30, 40))
    z[:, 20:] = 0.05
    judged = smooth(truth_of(z, (np.zeros_like(z), np.zeros_like(z))), RADIUS_PX)
    assert not judged[:, 16:24].any()
    assert judged[5:-5, 5:16].all()
    assert judged[5:-5, 24:-5].all()


def test_a_shadow_within_the_disc_is_not_smooth():
    z = np.zeros((30, 40))
    lit = np.ones(z.shape, bool)
    lit[15, 20] = False
    judged = smooth(truth_of(z, (np.zeros_like(z), np.zeros_like(z)), lit), RADIUS_PX)
    v, u = np.indices(z.shape)
    near = (v - 15) ** 2 + (u - 20) ** 2 <= RADIUS_PX**2
    assert (judged == (interior(z.shape, 4) & ~near)).all()


def test_coarse_pixels_are_judged_by_their_next_neighbours():
    z = np.zeros((20, 20))
    z[:, 10:] = 0.05
    judged = smooth(truth_of(z, (np.zeros_like(z), np.zeros_like(z))), 0.5)
    assert judged[5:-5, 2:9].all()
    assert not judged[:, 9:11].any()
