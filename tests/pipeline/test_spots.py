from dataclasses import replace

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.spots import BoardNotFound, detect_spots

NOISE_DN = 2.0


@pytest.fixture(scope="module")
def postures(paint, poses, spot_board):
    """16 postures in the lit field with their detections."""
    rng = np.random.default_rng(11)
    painted = [paint(spot_board, pose, rng, noise_dn=NOISE_DN) for pose in poses(rng)]
    return [(posture, detect_spots(posture.picture, spot_board)) for posture in painted]


def whole(posture) -> np.ndarray:
    """Spots in the light, a big spot's radius away from its edge."""
    return beyond_edge(posture) < -30.0


def beyond_edge(posture) -> np.ndarray:
    """How far each spot's centre lies beyond the edge of the light, px; negative inside."""
    return np.max(np.abs(posture.ellipse_centres - [645.0, 470.0]) - np.array([10.84, 6.1]) * 101 / 2, axis=1)


def test_every_lit_spot_of_every_posture_is_found_at_its_own_place(postures):
    for posture, spots in postures:
        lit = whole(posture)
        assert spots.seen[lit].mean() > 0.97
        assert np.nanmax(np.abs(spots.centres_px - posture.ellipse_centres)) < 0.15


def test_centres_are_unbiased_and_scatter_as_predicted(postures):
    """Pooled over about 1400 spots: mean error within 4 standard errors, normalised errors of unit variance."""
    errors = np.concatenate([(spots.centres_px - posture.ellipse_centres)[spots.seen] for posture, spots in postures])
    sigma = np.concatenate([spots.sigma_px[spots.seen] for _, spots in postures])
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(len(errors)))
    assert np.sqrt(np.mean((errors / sigma[:, None]) ** 2)) == pytest.approx(1.0, abs=0.08)


def test_scatter_is_near_the_bound_for_a_known_even_light(postures, spot_board):
    """Var >= 2 s σ² / (√π R K²) for radius R, blur s, contrast K.

    Taking the mean of an edge within 3 s to either side costs √(6 s / 2√π s) = 1.3 times that in a straight edge, and
    more where the inner pixels of a small spot lie closer together; besides the light's gradient is free.
    """
    big = spot_board.diameters() > 0.3
    for kind, radius in ((big, 20.0), (~big, 8.75)):
        errors = np.concatenate([(spots.centres_px - posture.ellipse_centres)[kind] for posture, spots in postures])
        bound = np.sqrt(2 * 1.3 / (np.sqrt(np.pi) * radius)) * NOISE_DN / (0.9 * 110.0)
        assert bound < np.nanstd(errors) < 2.0 * bound


def test_blur_is_that_of_the_optics_and_of_the_pixels_box(postures):
    """Variances add: 1.3² px² of the painted blur, 1/12 px² of the box."""
    blur = np.concatenate([spots.blur_px[spots.seen] for _, spots in postures])
    assert np.median(blur) == pytest.approx(np.sqrt(1.3**2 + 1 / 12), rel=0.02)


def test_semi_axes_are_those_of_the_projected_circles_less_what_blur_takes(postures, spot_board):
    """Blurring a disc moves the level of half its contrast inwards by blur² / 2R."""
    flat, spots = postures[-1]
    assert np.array_equal(flat.camera_from_board[:3, 3], [0.0, 0.0, 224.56])
    for diameter in np.unique(spot_board.diameters()):
        drawn = diameter / 2 * 22683.0 / 224.56 * np.array([1.0, np.cos(np.radians(6.0))])
        axes = np.nanmedian(spots.axes_px[spot_board.diameters() == diameter], axis=0)
        assert axes == pytest.approx(drawn - 1.3**2 / (2 * drawn[0]), abs=0.03)


@pytest.mark.parametrize("blur_px", [0.8, 1.5, 2.5])
def test_light_that_changes_by_half_a_percent_per_px_moves_no_centre(paint, pose, spot_board, blur_px):
    """The naive centre moves by 0.1-0.3 px; a model that multiplies after blurring would by blur² times 0.005."""
    gradient = (0.004, -0.003)
    posture = paint(
        spot_board,
        pose(15.0, 30.0, 37.0, (0.3, 0.2)),
        np.random.default_rng(2),
        gradient=gradient,
        blur_px=blur_px,
        noise_dn=0.02,
        lit_field=False,
    )
    spots = detect_spots(posture.picture, spot_board)
    errors = spots.centres_px - posture.ellipse_centres
    assert spots.seen.sum() > 80
    for kind in (spot_board.diameters() > 0.3, spot_board.diameters() < 0.3):
        assert np.all(np.abs(np.nanmean(errors[kind], axis=0)) < 0.002)
    assert np.nanmax(np.abs(errors)) < 0.01


@pytest.mark.slow
def test_spots_cut_by_the_edge_of_the_light_are_left_out(paint, pose, spot_board):
    """A board shifted so that the edge runs through one row after the other, with little noise to hide behind."""
    for shift in (0.55, 0.65, 0.75):
        posture = paint(spot_board, pose(0.0, 0.0, 3.0, (0.0, shift)), np.random.default_rng(3), noise_dn=0.3)
        spots = detect_spots(posture.picture, spot_board)
        assert (np.abs(beyond_edge(posture)) < 20.0).any()
        assert not spots.seen[beyond_edge(posture) > -9.0].any()
        assert np.nanmax(np.abs(spots.centres_px - posture.ellipse_centres)) < 0.06


def test_a_board_partly_outside_the_picture_is_still_ordered(paint, pose, spot_board):
    posture = paint(spot_board, pose(12.0, 80.0, 130.0, (4.0, 1.0)), np.random.default_rng(4), lit_field=False)
    spots = detect_spots(posture.picture, spot_board)
    assert 40 < spots.seen.sum() < 90
    assert np.nanmax(np.abs(spots.centres_px - posture.ellipse_centres)) < 0.15


def test_a_smaller_camera_sees_the_board_as_well(paint, pose, spot_board):
    half = (11341.5, 11350.0, -0.5, 322.0, 235.0, -1.0, 0.0, -0.004, 0.003)
    posture = paint(
        spot_board,
        pose(20.0, 10.0, 250.0, (0.2, 0.1)),
        np.random.default_rng(6),
        shape=(480, 640),
        intrinsics=half,
        blur_px=0.8,
        lit_field=False,
    )
    spots = detect_spots(posture.picture, spot_board)
    assert spots.seen.sum() == 99
    assert np.nanmax(np.abs(spots.centres_px - posture.ellipse_centres)) < 0.15


def test_eight_bit_pictures_serve(postures, spot_board):
    posture, from_float = postures[-1]
    spots = detect_spots(np.clip(np.rint(posture.picture), 0, 255).astype(np.uint8), spot_board)
    assert np.nanmax(np.abs(spots.centres_px - from_float.centres_px)) < 0.05


def test_a_picture_without_a_board_is_refused_with_the_number_of_spots_seen(spot_board):
    noise = np.random.default_rng(8).normal(0.0, NOISE_DN, (960, 1280))
    for picture in (noise, noise + 100.0, np.zeros((960, 1280))):
        with pytest.raises(BoardNotFound, match=r"calibration board not found: \d+ spots of a grid were seen"):
            detect_spots(picture, spot_board)


def test_a_picture_that_is_none_is_refused(spot_board):
    with pytest.raises(InputError, match=r"shape \(3, 960, 1280\)"):
        detect_spots(np.zeros((3, 960, 1280)), spot_board)
    with pytest.raises(InputError, match="not finite"):
        detect_spots(np.full((960, 1280), np.nan), spot_board)


def test_a_skewed_blur_moves_a_centre_by_little_more_than_its_mean(paint, pose, spot_board):
    """Blur of two unequal parts, as coma makes it out of focus.

    A symmetric edge of blur b that fits it best lies m / 12 b² beside its mean, with m the third central moment. Of
    that at most two thirds are left, for in the fit the light's gradient takes over a part of the skew.
    """
    posture = paint(
        spot_board, pose(10.0, 40.0, 20.0, (0.1, -0.1)), np.random.default_rng(5), blur_px=0.8, noise_dn=0.02,
        lit_field=False,
    )  # fmt: skip
    share, shift = 0.2, 1
    skewed = (1 - share) * posture.picture + share * np.roll(posture.picture, shift, axis=1)
    spots = detect_spots(skewed, spot_board)
    errors = spots.centres_px - posture.ellipse_centres - [share * shift, 0.0]
    moment = share * (1 - share) * (1 - 2 * share) * shift**3
    symmetric = -moment / (12 * np.nanmedian(spots.blur_px) ** 2)
    assert spots.seen.sum() > 80
    for kind in (spot_board.diameters() > 0.3, spot_board.diameters() < 0.3):
        along, across = np.nanmean(errors[kind], axis=0)
        assert 0 < along / symmetric < 2 / 3
        assert abs(across) < 0.001


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.8, 1.5])
def test_dark_spots_are_found_at_their_own_places(paint, pose, spot_board, blur_px):
    """The same board in other colours: black where it was white. Its spots need not be big anywhere, either."""
    plain = replace(spot_board, big=(), big_diameter_mm=0.3, small_diameter_mm=0.3, dark_spots=True)
    rng = np.random.default_rng(3)
    white = paint(plain, pose(12.0, 70.0, 10.0, (0.1, 0.0)), rng, blur_px=blur_px, noise_dn=0.0, lit_field=False)
    dark = 1.1 * 110.0 - white.picture + rng.normal(0.0, NOISE_DN, white.picture.shape)
    spots = detect_spots(dark, plain)
    assert spots.seen.mean() > 0.95
    errors = (spots.centres_px - white.ellipse_centres)[spots.seen]
    assert np.sqrt(np.mean((errors / spots.sigma_px[spots.seen, None]) ** 2)) == pytest.approx(1.0, abs=0.2)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(len(errors)))
    with pytest.raises(BoardNotFound):
        detect_spots(dark, replace(plain, dark_spots=False))
