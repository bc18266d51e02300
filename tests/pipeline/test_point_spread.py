import cv2
import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.camera_calibration import CameraCalibration
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.point_spread import PointSpread, estimate_point_spread
from greenough.pipeline.spot_fit import fit_spots
from greenough.pipeline.spots import Spots

SHAPE = (960, 1280)
PX_PER_MM = 101.0
FOCUS = (0.12, 8e-4, -2e-4, 3e-7)  # mm, mm/px, mm/px, mm/px²
TILE, FINE = 72, 4
WHITE_DN, INK_DN = 110.0, 11.0
SPOTS_PER_POSTURE = 16


def calibration(world_from_board: np.ndarray) -> CameraCalibration:
    """A camera that looks straight down at known postures; nothing else of it matters here."""
    camera = CameraModel(22683.0, 22683.0, 0.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, SHAPE)
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[2, 3] = 224.56
    poses = np.concatenate([camera_from_world @ world_from_board, camera_from_world[None]])
    return CameraCalibration(camera, poses, len(poses) - 1, np.zeros((1, 1, 2)), 0.0, 0.0, np.zeros((0, 0)))


def tilted(degrees: float, towards: float) -> np.ndarray:
    pose = np.eye(4)
    axis = np.radians(degrees) * np.array([np.cos(towards), np.sin(towards), 0.0])
    pose[:3, :3] = cv2.Rodrigues(axis)[0]
    return pose


def photographed(board, blurred, rng, cutoff, slope, tilts=(18.0,) * 8, noise_dn=0.0):
    """Spots of a board in tilted postures, each a picture of its own, blurred in space by its own defocus."""
    poses = np.array([tilted(tilt, 2 * np.pi * k / len(tilts)) for k, tilt in enumerate(tilts)])
    nominal = np.column_stack([board.centres(), np.zeros(len(board.centres()))])
    observed = []
    for pose in [*poses, np.eye(4)]:
        xyz = nominal @ pose[:3, :3].T + pose[:3, 3]
        u, v = (np.array(SHAPE[::-1]) - 1)[:, None] / 2 + PX_PER_MM * xyz[:, :2].T * [[1.0], [-1.0]]
        spots = Spots(*(np.full((len(nominal), *more), np.nan) for more in ((2,), (2,), (), ())))
        for k in rng.permutation(len(nominal))[:SPOTS_PER_POSTURE]:
            x, y = u[k] - 639.5, v[k] - 479.5
            surface = FOCUS[0] + FOCUS[1] * x + FOCUS[2] * y + FOCUS[3] * (x * x + y * y)
            radius = board.diameters()[k] / 2 * PX_PER_MM
            middle = TILE / 2 + rng.uniform(-0.5, 0.5, 2)
            at = (np.arange(TILE * FINE) + 0.5) / FINE - 0.5
            inside = np.hypot(at - middle[0], at[:, None] - middle[1]) < radius
            light = np.where(inside, WHITE_DN, INK_DN)
            picture = INK_DN + blurred(light - INK_DN, FINE, cutoff, slope * abs(xyz[k, 2] - surface))
            picture += noise_dn * rng.standard_normal(picture.shape)
            fit = fit_spots(picture, middle[None], np.full((1, 2), radius))
            spots.centres_px[k], spots.axes_px[k] = (u[k], v[k]), fit.axes_px[0]
            spots.sigma_px[k], spots.blur_px[k] = fit.sigma_px[0], fit.blur_px[0]
        observed.append(spots)
    return observed, calibration(poses)


@pytest.mark.slow
@pytest.mark.parametrize(("cutoff", "slope"), [(0.57, 1.5), (0.4, 1.0)])
def test_lens_and_surface_in_focus_are_found_from_spots_blurred_in_space(spot_board, blurred, cutoff, slope):
    spots, camera = photographed(spot_board, blurred, np.random.default_rng(1), cutoff, slope)
    found = estimate_point_spread(spots, camera, spot_board)
    assert found.cutoff_per_px == pytest.approx(cutoff, rel=0.02)
    assert found.defocus_px_per_mm == pytest.approx(slope, rel=0.02)
    places = np.stack(np.meshgrid([100.0, 639.5, 1180.0], [100.0, 479.5, 860.0]), axis=-1)
    truth = PointSpread(cutoff, slope, FOCUS, SHAPE)
    for height in (-1.4, 0.0, 1.4):
        np.testing.assert_allclose(
            found.disc_radius_px(places, height), truth.disc_radius_px(places, height), atol=0.12
        )


@pytest.mark.slow
def test_camera_noise_hardly_moves_the_estimate(spot_board, blurred):
    clean, noisy = (
        estimate_point_spread(
            *photographed(spot_board, blurred, np.random.default_rng(2), 0.57, 1.5, noise_dn=noise), spot_board
        )
        for noise in (0.0, 1.0)
    )
    assert noisy.cutoff_per_px == pytest.approx(clean.cutoff_per_px, rel=0.02)
    assert noisy.defocus_px_per_mm == pytest.approx(clean.defocus_px_per_mm, rel=0.02)


@pytest.mark.slow
def test_a_board_that_always_lies_flat_does_not_tell_defocus(spot_board, blurred):
    spots, camera = photographed(spot_board, blurred, np.random.default_rng(3), 0.57, 0.0, tilts=(0.0,) * 4)
    with pytest.raises(InputError, match="tilt the board"):
        estimate_point_spread(spots, camera, spot_board)


def test_too_few_spots_are_refused(spot_board, blurred):
    spots, camera = photographed(spot_board, blurred, np.random.default_rng(4), 0.57, 1.5, tilts=(10.0, 10.0))
    with pytest.raises(InputError, match="from 48 spots: at least 60"):
        estimate_point_spread(spots, camera, spot_board)
    without_blur = [Spots(each.centres_px, each.axes_px, each.sigma_px) for each in spots]
    with pytest.raises(InputError, match="from 0 spots"):
        estimate_point_spread(without_blur, camera, spot_board)


def test_the_transfer_function_in_closed_form():
    """Along u at half the cut-off: (2/π)(π/3 - √3/4) of the pupils' overlap, 2/π of a box of 1 px at 0.5 cycles."""
    rows, cols = 8, 12
    transfer = PointSpread(1.0, 1.5, (0.0, 0.0, 0.0, 0.0), (rows, cols)).transfer((rows, cols), 0.0)
    assert transfer.shape == (rows, cols)
    assert transfer[0, 0] == 1.0
    assert transfer[0, cols // 2] == pytest.approx(2 / np.pi * (np.pi / 3 - np.sqrt(3) / 4) * 2 / np.pi, rel=1e-6)
    # A disc's transform falls to zero where its argument is the first zero of J1.
    zero = 3.8317059702 / (2 * np.pi * 0.5)
    dark = PointSpread(1.0, 1.5, (0.0, 0.0, 0.0, 0.0), (rows, cols)).transfer((rows, cols), zero)
    assert abs(dark[0, cols // 2]) < 1e-6


def test_defocus_is_the_distance_from_the_tilted_surface_in_focus():
    spread = PointSpread(0.5, 2.0, (0.1, 0.001, 0.0, 0.0), (101, 201))
    pixels = np.array([[100.0, 50.0], [200.0, 50.0], [100.0, 50.0]])
    np.testing.assert_allclose(spread.disc_radius_px(pixels, np.array([0.1, 0.1, -0.4])), [0.0, 0.2, 1.0], atol=1e-12)
