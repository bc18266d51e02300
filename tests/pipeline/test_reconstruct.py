from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.point_kernel import PointKernel
from greenough.pipeline.rays import Rays, rays_of_camera
from greenough.pipeline.reconstruct import PointMap, reconstruct

SHAPE = (24, 32)


def camera(shape=SHAPE):
    """The paper's Table 2, its picture thinned to a few pixels of 400 µm."""
    return CameraModel(567.1, 569.0, -0.3, 15.8, 13.0, -0.09531, 0.02512, -0.00869, -0.00273, shape)


def pose(tilt_deg=6.0):
    """Looking down on the board: +x to the right, +y upwards in the picture, tilted about y."""
    rotation = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = [0.3, -0.2, 224.56]
    return camera_from_world


def calibration(z_low=-1.45, z_high=1.45):
    """Phase in rad is 10 z for every pixel: what is tested here lies behind the phase-height relation."""
    coefficients = np.zeros((*SHAPE, 4), dtype=np.float32)
    coefficients[..., 0] = 1.45
    nothing = np.full(SHAPE, np.nan, dtype=np.float32)
    return Calibration(
        method="paper",
        camera=camera(),
        camera_from_world=pose(),
        rays=rays_of_camera(camera(), pose()),
        phase_height=PhaseHeight(
            coefficients=coefficients,
            phase_centre=np.zeros(SHAPE, dtype=np.float32),
            phase_half_range=np.full(SHAPE, 14.5, dtype=np.float32),
            z_range=np.tile(np.float32([z_low, z_high]), (*SHAPE, 1)),
            valid=np.ones(SHAPE, dtype=bool),
        ),
        identity=RigIdentity("rig", "1", "2", "0" * 64),
        board=SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5))),
        procedure=Procedure((608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12), 16, 30, 0.1, 0.8),
        known=KnownUncertainty(3e-5, 5e-4, 5e-5),
        run="test",
        exposures=0,
        figures={},
        residuals=Residuals(nothing[None], nothing[None], nothing, nothing[None], nothing),
        uncertainty=CalibrationUncertainty(
            np.array([-1.45, 1.45]),
            *(np.array([0.0, n - 1.0]) for n in SHAPE),
            np.zeros((1, 2, 2, 2, 3), np.float32),
            np.zeros(2),
        ),
    )


def phase_map(absolute):
    flat = np.zeros(absolute.shape, dtype=np.float32)
    return PhaseMap(absolute, flat + 80, flat + 100, np.isfinite(absolute), flat, flat + 0.01)


def test_points_lie_on_their_pixels_rays_at_their_heights():
    rng = np.random.default_rng(8)
    z = rng.uniform(-1.4, 1.4, SHAPE)
    xyz = reconstruct(phase_map(10 * z), calibration()).xyz
    np.testing.assert_allclose(xyz[..., 2], z, atol=1e-6)  # coefficients are float32
    seen = camera().project(xyz @ pose()[:3, :3].T + pose()[:3, 3])
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    assert np.abs(seen - np.stack([u, v], axis=-1)).max() < 1e-5  # rays are float32: half a nanometre


def test_a_point_is_as_bright_as_its_pixel():
    measured = phase_map(np.zeros(SHAPE))
    measured.background[:] = np.arange(measured.background.size).reshape(SHAPE)
    np.testing.assert_array_equal(reconstruct(measured, calibration()).intensity, measured.background)


@pytest.mark.parametrize("seed", range(3))
def test_single_precision_is_as_good_as_double(seed):
    """Phases up to 300 rad over the whole volume: a hundredth of a micrometre would be 1e-5 mm."""
    here, rng = calibration(), np.random.default_rng(seed)
    relation = here.phase_height
    relation.coefficients[...] = rng.uniform([1.3, -0.1, -0.02, -1e-3], [1.6, 0.1, 0.02, 1e-3], (*SHAPE, 4))
    relation.phase_centre[...] = rng.uniform(20, 300, SHAPE)
    relation.phase_half_range[...] = rng.uniform(8, 10, SHAPE)
    centre, half_range, origin, slope = (
        values.astype(np.float64)
        for values in (relation.phase_centre, relation.phase_half_range, here.rays.origin, here.rays.slope)
    )
    phase = (centre + half_range * rng.uniform(-1, 1, SHAPE)).astype(np.float32)

    def height(phase):
        t = (phase - centre) / half_range
        m1, m0, n1, r3 = np.moveaxis(relation.coefficients.astype(np.float64), -1, 0)
        w = (m1 * t + m0) / (n1 * t + 1)
        return w + r3 * w**3

    points = reconstruct(phase_map(phase), here)
    phase, step = phase.astype(np.float64), 1e-4
    z, rise = height(phase), (height(phase + step) - height(phase - step)) / (2 * step)
    assert np.abs(points.xyz[..., 2] - z).max() < 1e-6
    assert np.abs(points.xyz[..., :2] - origin - slope * z[..., None]).max() < 1e-6
    along = np.concatenate([slope, np.ones((*SHAPE, 1))], axis=-1)
    np.testing.assert_allclose(points.noise_mm, 0.01 * rise[..., None] * along, rtol=1e-5)


def test_a_picture_of_any_size_is_reconstructed_to_its_last_pixel():
    """Dr.Jit computes 4, 8 or 16 pixels at once."""
    here = calibration()
    for rows in range(1, 6):
        for cols in (1, 3, 7):
            window = slice(rows), slice(cols)
            rays = Rays(here.rays.origin[window], here.rays.slope[window])
            kernel = PointKernel.of(here.phase_height.of_pixels(window), rays, 0.05)
            z = np.linspace(-1, 1, rows * cols).reshape(rows, cols)
            xyz, noise = kernel.points(10 * z, np.full((rows, cols), 0.01), np.ones((rows, cols), bool))
            np.testing.assert_allclose(xyz, rays.points(z), atol=1e-6)
            np.testing.assert_allclose(noise[..., 2], 1e-3, rtol=1e-5)


def test_a_pixel_without_a_ray_has_no_point():
    here = calibration()
    here.rays.origin[4, 5] = np.nan
    points = reconstruct(phase_map(np.zeros(SHAPE)), here)
    assert np.isnan(points.xyz[4, 5]).all()
    assert np.isnan(points.noise_mm[4, 5]).all()
    assert points.valid.sum() == points.valid.size - 1


def test_heights_beyond_half_a_step_outside_the_calibrated_range_are_invalid():
    z = np.zeros(SHAPE)
    z[0, :4] = [1.499, 1.501, -1.499, -1.501]
    valid = reconstruct(phase_map(10 * z), calibration()).valid
    np.testing.assert_array_equal(valid[0, :4], [True, False, True, False])
    assert valid.sum() == valid.size - 2


def test_a_phase_far_outside_gives_no_point_even_where_the_relation_comes_back_into_range():
    here = calibration()
    here.phase_height.coefficients[..., :3] = [0.6, -0.6, 0.5]  # a pole at t = -2, that is at a phase of -29 rad
    phase = np.zeros(SHAPE)
    phase[2, 3] = -100.0
    assert 0 < here.phase_height.height(phase)[2, 3] < 2.0
    phase[2, 3] = -1000.0
    assert 0 < here.phase_height.height(phase)[2, 3] < 1.45
    assert not reconstruct(phase_map(phase), here).valid[2, 3]


def test_the_range_is_each_pixels_own():
    here = calibration()
    relation = here.phase_height  # pixel (3, 4) was seen from -1.45 to 0.15 mm
    relation.z_range[3, 4] = [-1.45, 0.15]
    relation.phase_centre[3, 4], relation.phase_half_range[3, 4] = -6.5, 8.0
    relation.coefficients[3, 4, :2] = [0.8, -0.65]
    z = np.full(SHAPE, 0.15)
    assert reconstruct(phase_map(10 * z), here).xyz[3, 4, 2] == pytest.approx(0.15, abs=1e-6)
    z = np.full(SHAPE, 0.5)
    valid = reconstruct(phase_map(10 * z), here).valid
    assert not valid[3, 4]
    assert valid.sum() == valid.size - 1


def test_invalid_phase_and_uncalibrated_pixels_give_no_point():
    here = calibration()
    here.phase_height.valid[5, 6] = False
    phase = np.zeros(SHAPE)
    phase[7, 8] = np.nan
    points = reconstruct(phase_map(phase), here)
    assert np.isnan(points.xyz[5, 6]).all()
    assert np.isnan(points.xyz[7, 8]).all()
    assert points.valid.sum() == points.valid.size - 2


def test_noise_moves_a_point_along_its_ray_as_repeated_measurements_scatter():
    """400 draws of the phase's noise: their covariance, of rank one, is known to 14 % (2 sd) of its largest entry."""
    here, rng = calibration(), np.random.default_rng(4)
    phase = 10 * rng.uniform(-1.4, 1.4, SHAPE)
    stated = reconstruct(phase_map(phase), here)
    draws = [reconstruct(phase_map(phase + 0.01 * rng.standard_normal(SHAPE)), here).xyz for _ in range(400)]
    scatter = np.einsum("drci,drcj->rcij", draws - stated.xyz, draws - stated.xyz) / len(draws)
    largest = stated.noise_covariance[..., 2, 2]
    departure = np.abs(scatter - stated.noise_covariance) / largest[..., None, None]
    assert np.quantile(departure, 0.95) < 0.14
    assert np.abs(np.mean(scatter[..., 2, 2] / largest) - 1) < 5 * np.sqrt(2 / (400 * largest.size))
    np.testing.assert_allclose(stated.sigma_noise[..., 2], 1e-3, rtol=1e-5)  # 0.01 rad at 10 rad/mm


def test_drifts_grow_with_the_run_and_add_to_noise_as_squares():
    """A quarter of a calibration: half of the path's 0.05 µm.

    Fringes of 50 rad/mm whose phase rises by 10 rad per mm of height turn a shift into five times as much of height.
    """
    here = calibration()
    here.phase_height.phase_centre[:] = 50 * here.rays.origin[..., 0]
    seen = phase_map(here.phase_height.phase_centre.astype(float))
    early, late = (reconstruct(replace(seen, exposures=n), here) for n in (0, 276))
    np.testing.assert_array_equal(early.sigma, early.sigma_noise)
    height = 5 * 0.025e-3
    np.testing.assert_allclose(late.sigma_calibration[..., 2], height, rtol=1e-3)
    np.testing.assert_allclose(late.sigma[..., 2], np.hypot(late.sigma_noise[..., 2], height), rtol=1e-3)
    along = np.broadcast_to(np.abs(here.rays.slope[11, 15]) * height, (*SHAPE, 2))
    np.testing.assert_allclose(late.sigma_calibration[..., :2], along, rtol=1e-3)


def test_a_map_without_uncertainties_says_so():
    with pytest.raises(ValueError, match="made without uncertainties"):
        assert PointMap(np.zeros((2, 2, 3))).sigma


def test_a_phase_map_of_another_size_is_refused():
    with pytest.raises(InputError, match="camera of 32 x 24 pixels, the picture has 30 x 20"):
        reconstruct(phase_map(np.zeros((20, 30))), calibration())
