"""Balls of a synthetic package, each of its own size, measured from points and drawing alone."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.ball_grid import BallGridMeasurement, measure_ball_grid
from greenough.pipeline.metrology.coplanarity import coplanarity, regression_plane, seating_planes
from greenough.pipeline.metrology.package_pose import BallGridDrawing, rigid_motion
from greenough.pipeline.reconstruct import PointMap

DRAWING = BallGridDrawing.rectangular(4, 5, 0.8, 0.5, 0.4, 0.05)
CENTRE = np.zeros(2)
LIES = Rotation.from_rotvec([0.02, -0.03, 0.0]) * Rotation.from_euler("z", 12.0, degrees=True)
SHIFT = np.array([0.3, -0.2, 0.5])


@dataclass(frozen=True)
class Package:
    """Balls as made, (balls,) each, and how the substrate is bowed."""

    radii: np.ndarray
    heights: np.ndarray  # above the substrate at the ball's place
    offsets: np.ndarray  # (balls, 2)
    bow: float = 0.0  # substrate at x, y is bow * (x² + y²)

    @classmethod
    def drawn(cls, rng: np.random.Generator, bow: float = 0.0) -> "Package":
        n = len(DRAWING.places)
        return cls(
            0.25 + 0.005 * rng.standard_normal(n), 0.4 + 0.01 * rng.standard_normal(n),
            0.005 * rng.standard_normal((n, 2)), bow,
        )  # fmt: skip

    @property
    def centres(self) -> np.ndarray:
        """In the drawing's frame, (balls, 3)."""
        places = DRAWING.places + self.offsets
        return np.column_stack([places, self.bow * np.sum(places**2, axis=1) + self.heights - self.radii])

    def seen(self, rng: np.random.Generator, noise: float = 0.5e-3, missing: tuple[int, ...] = ()) -> PointMap:
        """Every 10 um from above, with noise in z; no flank steeper than 60 degrees is seen, and its foot is dark."""
        x, y = np.meshgrid(np.arange(-2.1, 2.1, 0.01), np.arange(-1.7, 1.7, 0.01))
        z = self.bow * (x * x + y * y)
        for k, (centre, radius) in enumerate(zip(self.centres, self.radii, strict=True)):
            if k in missing:
                continue
            aside = np.hypot(x - centre[0], y - centre[1])
            cap = aside < radius * np.sin(np.radians(60))
            z[cap] = centre[2] + np.sqrt(radius**2 - aside[cap] ** 2)
            z[~cap & (aside < radius + 0.02)] = np.nan
        xyz = np.stack([x, y, z + noise * rng.standard_normal(z.shape)], axis=-1)
        return PointMap(LIES.apply(xyz.reshape(-1, 3)).reshape(xyz.shape) + SHIFT)


def normalised(found: BallGridMeasurement, package: Package) -> tuple[np.ndarray, np.ndarray]:
    """Errors of height and diameter over their stated sd."""
    return (found.height - package.heights) / found.height_sd, (
        (found.diameter - 2 * package.radii) / found.diameter_sd
    )


@pytest.mark.slow
def test_heights_diameters_and_places_are_those_made_within_their_sd():
    """Of 5 packages of 20 balls: mean within 4.5 and variance of standardised errors within 5 of their sd (1e-6 each).

    A paraboloid over 15 degrees is above a ball's own apex by some hundredths of a micrometre, which is a part of the
    sd of a height: its bias is held to 0.05 um instead.
    """
    rng, height, diameter = np.random.default_rng(1), [], []
    for _ in range(5):
        package = Package.drawn(rng)
        found = measure_ball_grid(package.seen(rng), DRAWING)
        assert found.measured.all()
        assert not (found.missing | found.unseen).any()
        np.testing.assert_array_equal(found.low, found.height < 0.35)
        a, b = normalised(found, package)
        height.extend((a - np.mean(a)).tolist())
        diameter.extend(b.tolist())
        assert abs(np.mean(found.height - package.heights)) < 0.05e-3 + 4.5 * np.mean(found.height_sd) / np.sqrt(20)
        np.testing.assert_allclose(found.cap_half_angle_deg, 60, atol=2)
        # The grid is fitted to the balls: of their offsets a common motion is lost, as in any fit.
        turn, shift = rigid_motion(DRAWING.places, DRAWING.places + package.offsets)
        made = (DRAWING.places + package.offsets - shift) @ turn - DRAWING.places
        np.testing.assert_allclose(found.offset, made, atol=1e-4)
    assert 1 - 5 * np.sqrt(2 / 100) < np.var(height) < 1 + 5 * np.sqrt(2 / 100)
    assert abs(np.mean(diameter)) < 4.5 / np.sqrt(100)
    assert 1 - 5 * np.sqrt(2 / 100) < np.var(diameter) < 1 + 5 * np.sqrt(2 / 100)


def test_the_pose_is_that_in_which_the_package_lies():
    rng = np.random.default_rng(2)
    pose = measure_ball_grid(Package.drawn(rng).seen(rng), DRAWING).pose
    true = np.eye(4)
    true[:3, :3] = LIES.as_matrix()
    true[:3, 3] = SHIFT
    moved = pose.drawing_from_world @ true
    np.testing.assert_allclose(moved[:3, 3], 0, atol=0.005)
    np.testing.assert_allclose(moved[:3, :3], np.eye(3), atol=0.005)


def test_missing_and_low_balls_are_flagged_and_no_others():
    rng = np.random.default_rng(3)
    package = Package.drawn(rng)
    package.heights[7] = 0.3
    found = measure_ball_grid(package.seen(rng, missing=(4, 12)), DRAWING)
    np.testing.assert_array_equal(np.flatnonzero(found.missing), [4, 12])
    np.testing.assert_array_equal(np.flatnonzero(found.low), [7])
    assert not found.unseen.any()
    assert np.isnan(found.height[[4, 12]]).all()
    assert found.height[7] == pytest.approx(0.3, abs=1e-3)
    there = np.delete(np.arange(20), [4, 12])
    apexes = package.centres[there] + package.radii[there, None] * [0, 0, 1]
    assert found.seating_coplanarity == pytest.approx(coplanarity(apexes, seating_planes(apexes, CENTRE)), abs=1.5e-3)


def test_a_ball_that_nothing_is_known_of_is_unseen_and_leaves_coplanarity_unknown():
    rng = np.random.default_rng(4)
    package = Package.drawn(rng)
    points = package.seen(rng)
    local = LIES.inv().apply(points.xyz.reshape(-1, 3) - SHIFT).reshape(points.xyz.shape)
    points.xyz[np.hypot(local[..., 0] - DRAWING.places[3, 0], local[..., 1] - DRAWING.places[3, 1]) < 0.3] = np.nan
    found = measure_ball_grid(points, DRAWING)
    np.testing.assert_array_equal(np.flatnonzero(found.unseen), [3])
    assert not found.missing.any()
    assert np.isnan([found.seating_coplanarity, found.regression_coplanarity]).all()
    assert found.n_apex[3] == 0


def test_heights_are_over_the_local_substrate_and_coplanarity_has_the_bow():
    """A bow of 60 um from middle to corner: heights do not feel it, both coplanarities do."""
    rng = np.random.default_rng(5)
    package = Package.drawn(rng, bow=-0.01)
    found = measure_ball_grid(package.seen(rng), DRAWING)
    # Around a ball at the rim the substrate is bowed, too: by 0.01 mm⁻¹ times the square of 0.4 mm at most.
    np.testing.assert_allclose(found.height, package.heights, atol=2.5e-3)
    assert np.std(found.height - package.heights) < 0.5e-3
    apexes = package.centres + package.radii[:, None] * [0, 0, 1]
    for measured, planes in (
        (found.seating_coplanarity, seating_planes(apexes, CENTRE)),
        (found.regression_coplanarity, regression_plane(apexes)[None]),
    ):
        assert measured == pytest.approx(coplanarity(apexes, planes), abs=1.5e-3)
    flat = np.column_stack([apexes[:, :2], package.heights])
    assert found.seating_coplanarity > coplanarity(flat, seating_planes(flat, CENTRE)) + 0.01


def test_strays_are_left_out_and_counted():
    rng = np.random.default_rng(6)
    package = Package.drawn(rng)
    points = package.seen(rng)
    stray = rng.uniform(size=points.xyz.shape[:2]) < 0.01
    points.xyz[stray, 2] += 0.1 * rng.standard_normal(int(stray.sum()))
    found = measure_ball_grid(points, DRAWING)
    assert 0.005 < found.stray.sum() / found.n_sphere.sum() < 0.015
    assert np.std(found.height - package.heights) < 0.2e-3
    assert np.std(found.diameter - 2 * package.radii) < 0.4e-3


def test_a_small_cap_says_so_by_its_angle_and_its_sd():
    """Only 25 degrees seen: the diameter's sd is tens of times that of 60 degrees, and the heights' hardly changes."""
    rng = np.random.default_rng(7)
    package = Package.drawn(rng)
    points = package.seen(rng)
    whole = measure_ball_grid(points, DRAWING)
    local = LIES.inv().apply(points.xyz.reshape(-1, 3) - SHIFT).reshape(points.xyz.shape)
    for centre, radius in zip(package.centres, package.radii, strict=True):
        aside = np.hypot(local[..., 0] - centre[0], local[..., 1] - centre[1])
        points.xyz[(aside > radius * np.sin(np.radians(25))) & (aside < radius)] = np.nan
    cap = measure_ball_grid(points, DRAWING)
    np.testing.assert_allclose(cap.cap_half_angle_deg, 25, atol=2)
    assert 10 < np.median(cap.diameter_sd / whole.diameter_sd) < 100
    np.testing.assert_allclose(cap.height, whole.height, atol=5e-4)


def test_points_without_a_package_are_told():
    with pytest.raises(InputError, match="balls were seen"):
        measure_ball_grid(PointMap(np.random.default_rng(8).uniform(-1, 1, (60, 60, 3)) * [1, 1, 1e-4]), DRAWING)
