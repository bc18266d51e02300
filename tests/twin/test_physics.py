"""Switching an effect on moves a named observable by the amount that is predicted here, by other means.

``docs/physics.md`` lists all effects; those that are not here have their tests beside the code that makes them. All
pictures are free of noise unless the test is about it.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation
from scipy.special import gamma as gamma_function
from scipy.stats import chi2

from greenough.instrument.contract import Placement
from greenough.scenes.board import BoardErrors, print_board
from greenough.scenes.parts import Part
from greenough.twin.randomness import instrument_rng
from greenough.twin.renderer import mi
from greenough.twin.rig import TwinRig, fringe_patterns
from greenough.twin.scene import specimen_dict
from greenough.twin.settings import RenderSettings, StageSettings
from greenough.twin.stage import build_stage

PIXEL = 224.56 / 22683  # mm at the specimen
NA, WAVELENGTH = 0.015, 0.525e-3
HALF_ANGLE = np.radians(6)
COLUMN, PERIOD, STEPS = 17.835e-3, 12, 12
FRINGE = 1 / (PERIOD * COLUMN)  # 1/mm across either axis: the plane leans against both by the same angle
RAD_PER_COLUMN = 2 * np.pi / PERIOD
ONE_LARGE = "board.big=[[4, 5], [0, 0], [8, 10]]"  # that of number 49 near the middle, 9 x 11 in all
RAD_PER_MM = -RAD_PER_COLUMN * 2 * np.sin(HALF_ANGLE) / COLUMN  # of the densest fringe, raised by a mm, on the axes


def middle(rows: int, cols: int) -> tuple[str, ...]:
    """The middle of the picture in real pixels."""
    return f"camera.rows={rows}", f"camera.cols={cols}", "twin.optics.camera_focal_px=22683"


def mounted(
    small, *overrides: str, part: str | Placement = "plane", size=(24, 36), z: float = 0.0, noiseless: bool = False
) -> TwinRig:
    """A rig with ideal lenses and no mechanical errors but those of ``overrides``, looking at ``part``."""
    rig, _ = small(*middle(*size), *overrides, perfect=True, noiseless=noiseless)
    rig.operator.place(Placement(part) if isinstance(part, str) else part)
    rig.stage.move_to_mm(z)
    return rig


def phasor(rig: TwinRig, patterns: np.ndarray | None = None, harmonic: int = 1) -> np.ndarray:
    """Of the densest fringes, or of others of as many steps as there are ``patterns``: (rows, cols)."""
    patterns = fringe_patterns(rig)[-STEPS:] if patterns is None else patterns
    n = len(patterns)
    turn = np.exp(-2j * np.pi * harmonic * np.arange(n) / n)
    return np.tensordot(turn, rig.irradiance(patterns).astype(float), axes=1) * 2 / n


def contrast(rig: TwinRig) -> float:
    """Of the densest fringes, mean over the picture."""
    patterns = fringe_patterns(rig)[-STEPS:]
    return float(np.mean(np.abs(phasor(rig)) / rig.irradiance(patterns).mean(axis=0)))


def turned(rig: TwinRig, other: TwinRig) -> np.ndarray:
    """By how much the phase of ``rig`` is ahead of that of ``other``, (rows, cols) rad."""
    return np.angle(phasor(rig) * phasor(other).conj())


def slopes(image: np.ndarray) -> tuple[float, float, float]:
    """Mean and gradient over columns and rows of an image, by its best plane."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    terms = np.stack([np.ones(image.size), u.ravel() - u.mean(), v.ravel() - v.mean()], axis=1)
    mean, along_u, along_v = np.linalg.lstsq(terms, image.ravel(), rcond=None)[0]
    return mean, along_u, along_v


def middle_spot(rig: TwinRig) -> np.ndarray:
    """(column, row) of the centroid of the only large spot near the middle, whose radius is 20 pixels."""
    picture = rig.irradiance(np.full((1, *rig.projector.shape), 255, np.uint8))[0].astype(float)
    row, column = np.unravel_index(uniform_filter(picture, 41).argmax(), picture.shape)
    window = np.s_[row - 30 : row + 31, column - 30 : column + 31]
    light = picture[window] - np.median(picture[window][[0, -1]])
    v, u = np.indices(light.shape)
    return np.array([(u * light).sum(), (v * light).sum()]) / light.sum() + [column - 30, row - 30]


def focused_transfer(frequency: float) -> float:
    """Of an aberration-free circular pupil: the overlap of two discs (Goodman, Introduction to Fourier Optics, 6.3)."""
    q = frequency * WAVELENGTH / (2 * NA)
    return 2 / np.pi * (np.arccos(q) - q * np.sqrt(1 - q * q))


def disc_transfer(frequency: float, defocus: float) -> float:
    """Of a uniform disc of radius NA times defocus: its transform, by quadrature over chords."""
    x = (np.arange(2000) + 0.5) / 1000 - 1
    chord = np.sqrt(1 - x * x)
    return float((chord * np.cos(2 * np.pi * frequency * NA * defocus * x)).sum() / chord.sum())


# Lenses


def test_without_diffraction_the_camera_sees_fringes_with_the_contrast_of_the_overlap_of_two_pupils_more(small):
    with_it, without = mounted(small), mounted(small, "twin.optics.camera_diffraction=false")
    assert contrast(with_it) / contrast(without) == pytest.approx(focused_transfer(FRINGE), rel=1e-3)


def test_an_open_stop_blurs_fringes_out_of_focus_over_two_discs(small):
    z = 1.5
    lens, pinhole = (mounted(small, f"twin.optics.finite_aperture={open}", z=z) for open in ("true", "false"))
    # Where the camera's axis meets the plane: from the middle along that axis, and along the projector's. Nearer to the
    # pupils the fringes are narrower.
    seen, projected = z / np.cos(HALF_ANGLE), z * np.cos(2 * HALF_ANGLE) / np.cos(HALF_ANGLE)
    expected = np.prod([disc_transfer(FRINGE / (1 - defocus / 224.56), defocus) for defocus in (seen, projected)])
    assert contrast(lens) / contrast(pinhole) == pytest.approx(expected, rel=2.5e-3)


@pytest.mark.parametrize("angle_deg", [11.0, 12.5])
def test_columns_pass_with_height_as_the_angle_between_the_paths_says(small, angle_deg):
    def columns_per_mm(*overrides: str) -> float:
        low, high = (phasor(mounted(small, *overrides, size=(4, 4), z=z)) for z in (-0.1, 0.1))
        return float(np.mean(np.angle(high * low.conj()))) / RAD_PER_COLUMN / 0.2

    turn = columns_per_mm(f"twin.optics.convergence_deg={angle_deg}")
    assert turn == pytest.approx(-2 * np.sin(np.radians(angle_deg / 2)) / COLUMN, rel=2e-3)


# Mirrors


def test_light_of_mirrors_that_are_off_takes_contrast(small):
    grey = fringe_patterns(mounted(small))[-STEPS:, 0].mean() / 255
    off = 0.05
    ratio = contrast(mounted(small, f"twin.optics.off_state={off}")) / contrast(
        mounted(small, "twin.optics.off_state=0")
    )
    assert ratio == pytest.approx((1 - off) * grey / (off + (1 - off) * grey), rel=1e-3)
    assert ratio < 0.96


def test_smaller_mirrors_blur_less(small):
    """A diamond of the diagonal d is the product of two sinc of half of it, along the fringe's direction."""
    large, little = (np.sinc(FRINGE * np.sqrt(fill) * COLUMN / 2) ** 2 for fill in (1.0, 0.25))
    ratio = contrast(mounted(small, "twin.optics.mirror_fill=1")) / contrast(
        mounted(small, "twin.optics.mirror_fill=0.25")
    )
    assert 1 - ratio == pytest.approx(1 - large / little, rel=0.01)


def harmonics(exponent: float, count: int) -> np.ndarray:
    """Fourier coefficients 0 to ``count`` of ((1 + cos x) / 2)^exponent = cos^(2 exponent)(x / 2)."""
    k = np.arange(count + 1)
    return gamma_function(2 * exponent + 1) / (
        4**exponent * gamma_function(exponent + k + 1) * gamma_function(exponent - k + 1)
    )


def steps_of(period: int, cols: int, rows: int) -> np.ndarray:
    """Twelve steps of a fringe in whole grey values, (12, rows, cols)."""
    angle = 2 * np.pi * (np.arange(cols) / period + np.arange(STEPS)[:, None] / STEPS)
    lines = np.rint(127.5 * (1 + np.cos(angle))).astype(np.uint8)
    return np.repeat(lines[:, None], rows, axis=1)


def test_a_gamma_makes_the_harmonics_of_its_power(small):
    """Of one wide fringe, which no blur weakens."""
    exponent = 1.2
    bent, linear = mounted(small, f"twin.optics.gamma={exponent}"), mounted(small)
    patterns = steps_of(608, *bent.projector.shape[::-1])
    zero, first, second, third = harmonics(exponent, 3)
    assert second / first == pytest.approx((exponent - 1) / (exponent + 2))
    fundamental = phasor(bent, patterns)
    # Grey values are rounded, by 0.3 of them: over the fundamental's 120 and 12 steps some 1e-3.
    assert_allclose(np.abs(phasor(bent, patterns, 2) / fundamental), second / first, atol=2e-3)
    assert_allclose(np.abs(phasor(bent, patterns, 3) / fundamental), abs(third / first), atol=2e-3)
    assert_allclose(
        bent.irradiance(patterns).mean(axis=0) / linear.irradiance(patterns).mean(axis=0), zero / 0.5, rtol=3e-3
    )
    assert_allclose(np.abs(phasor(linear, patterns, 2) / phasor(linear, patterns)), 0, atol=2e-3)


def test_three_steps_feel_a_gamma_as_its_harmonics_predict_and_twelve_do_not(small):
    """With N steps the harmonics 1 - N and 1 + N, 1 - 2 N, ... are taken for the fundamental."""
    exponent = 1.2
    bent, linear = mounted(small, f"twin.optics.gamma={exponent}"), mounted(small)
    patterns = steps_of(608, *bent.projector.shape[::-1])
    true = np.angle(phasor(linear, patterns))
    twelve = np.angle(phasor(bent, patterns) * np.exp(-1j * true))
    assert np.abs(twelve).max() < 2e-3
    coefficient = harmonics(exponent, 8)
    k = np.array([-8, -5, -2, 1, 4, 7])
    errors = []
    for first in range(4):  # three of the twelve steps, from four of them: the fringe turned by 30 degrees
        angle = true + 2 * np.pi * first / STEPS
        three = np.angle(phasor(bent, patterns[first::4]) * np.exp(-1j * angle))
        series = (coefficient[np.abs(k)] * np.exp(1j * (k - 1) * angle[..., None])).sum(axis=-1)
        assert_allclose(three, np.angle(series), atol=4e-3)
        errors.append(three)
    assert np.sqrt(2 * np.mean(np.square(errors))) == pytest.approx(
        (coefficient[2] - coefficient[4]) / coefficient[1], rel=0.05
    )


# Camera


@pytest.mark.parametrize("efficiency", [0.5, 1.0])
def test_electrons_are_the_share_of_photons_that_is_counted_and_their_variance_their_mean(small, efficiency):
    """Chance refuses a sound camera once in a thousand times."""
    counting = ("camera.bits=0", "twin.camera.read_noise_e=0", "twin.camera.prnu=0", "twin.camera.dsnu_e=0")
    rig = mounted(small, *counting, f"twin.camera.quantum_efficiency={efficiency}", size=(60, 90))
    rig.camera.exposure_us = 20_000
    white = np.full((2, *rig.projector.shape), 255, np.uint8)
    first, second = (rig.capture(white).stack - rig.camera.black_level_dn) * rig.camera.noise.electrons_per_dn
    # 150 photons per ms from a white surface that faces the light; ceramic reflects 0.85 and leans by 6 degrees.
    expected = efficiency * 150 * 20 * 0.85 * np.cos(HALF_ANGLE)
    assert np.mean((first + second) / 2) == pytest.approx(expected, rel=4e-3)
    n = first.size
    low, high = chi2.ppf([5e-4, 1 - 5e-4], n - 1) / n
    assert low < np.var(first - second) / 2 / np.mean((first + second) / 2) < high


def test_a_sensors_responsivities_scatter_a_flat_frame(small):
    """The relative variance over the pixels is that of their responsivity; chance refuses once in a thousand times."""
    prnu = 0.02
    flat = [mounted(small, f"twin.camera.prnu={size}", size=(60, 90), noiseless=True) for size in (prnu, 0)]
    white = np.full((1, *flat[0].projector.shape), 255, np.uint8)
    scattered, even = (rig.capture(white).stack[0] - rig.camera.black_level_dn for rig in flat)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], even.size - 1) / even.size
    assert low < np.var(scattered / even) / prnu**2 < high


# Stage


def test_a_stage_that_misses_its_height_turns_the_phase(small):
    z, sd = 0.37, 20.0
    error = build_stage(StageSettings(position_sd_um=sd), seed=1).height(z)
    assert abs(error) > 2e-3
    off, on = (mounted(small, f"twin.stage.position_sd_um={size}", size=(4, 4), z=z) for size in (0, sd))
    # The angle between the rays grows by 1 / 224 per mm.
    assert np.mean(turned(on, off)) == pytest.approx(RAD_PER_MM * error, rel=0.01)


@pytest.mark.slow
def test_a_stage_that_is_not_straight_shifts_the_picture(small):
    z, name, sd = -0.2, "straightness_sd_um", 30.0
    stage = build_stage(StageSettings(straightness_sd_um=sd), seed=1)
    straight, crooked = (
        middle_spot(mounted(small, ONE_LARGE, f"twin.stage.{name}={size}", part="board", size=(120, 120), z=z))
        for size in (0, sd)
    )
    expected = np.array([stage.straight_x(z) * np.cos(HALF_ANGLE), -stage.straight_y(z)]) / PIXEL
    assert np.linalg.norm(expected) > 1
    assert_allclose(crooked - straight, expected, atol=0.02 * np.linalg.norm(expected))


@pytest.mark.parametrize("setting", ["pitch_roll_sd_urad=3000", "axis_sd_deg=0.2"])
def test_a_stage_that_pitches_and_rolls_or_leans_tilts_a_plane(small, setting):
    """A table turned by (a, b) about x and y raises the point (x, y) by a y - b x."""
    z = 0.15
    name, size = setting.split("=")
    stage = build_stage(StageSettings(**{name: float(size)}), seed=1)
    about_x, about_y = stage.axis_tilt if "axis" in name else (stage.pitch(z), stage.roll(z))
    assert np.hypot(about_x, about_y) > 1e-3
    off, on = (mounted(small, f"twin.stage.{s}", z=z) for s in (f"{name}=0", setting))
    _, along_row, along_column = slopes(turned(on, off) / RAD_PER_MM)  # mm per pixel
    # A pixel is PIXEL / cos 6 wide on the plane, and y points up.
    tilt = np.array([-about_y * PIXEL / np.cos(HALF_ANGLE), -about_x * PIXEL])
    assert_allclose([along_row, along_column], tilt, atol=0.02 * np.linalg.norm(tilt))


# Board


@pytest.mark.parametrize("thickness_um", [1.0, 20.0])
def test_ink_lifts_the_blank_face_of_the_board_that_lies_on_it(small, thickness_um):
    blank = Placement("board", face="blank")
    off, on = (
        mounted(small, f"twin.board.ink_thickness_um={size}", part=blank, size=(4, 4)) for size in (0, thickness_um)
    )
    assert np.mean(turned(on, off)) == pytest.approx(RAD_PER_MM * thickness_um * 1e-3, rel=0.01)


def test_a_wedge_tilts_the_blank_face(small):
    blank = Placement("board", face="blank")
    sd = 2000.0
    off, on = (mounted(small, f"twin.board.wedge_sd_urad={size}", part=blank) for size in (0, sd))
    _, along_row, along_column = slopes(turned(on, off) / RAD_PER_MM)  # mm per pixel
    wedge = print_board(on.board, BoardErrors(0, 0, 0, sd, 0), instrument_rng(1, "board")).wedge
    # Turned over about y, a thickness that grew along x falls; hands turn the board by up to some degrees.
    expected = -wedge * PIXEL / [np.cos(HALF_ANGLE), 1]
    assert np.linalg.norm(wedge) > 1e-3
    assert_allclose([along_row, along_column], expected, atol=0.08 * np.linalg.norm(expected))


def test_a_spot_is_seen_where_it_was_printed(small):
    sd = 20.0
    off, on = (
        mounted(small, ONE_LARGE, f"twin.board.print_sd_um={size}", part="board", size=(120, 120)) for size in (0, sd)
    )
    printed = print_board(on.board, BoardErrors(sd, 0, 0, 0, 0), instrument_rng(1, "board")).centres[49]
    x, y = printed - on.board.centres()[49]
    assert np.hypot(x, y) > 5e-3
    expected = np.array([x * np.cos(HALF_ANGLE), -y]) / PIXEL
    # Hands turn the board by up to some degrees.
    assert_allclose(middle_spot(on) - middle_spot(off), expected, atol=0.08 * np.linalg.norm(expected))


# Surfaces


@pytest.mark.parametrize(("material", "alpha"), [("metal", 0.25), ("solder", 0.2)])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0])
def test_metal_reflects_by_its_microfacets(small, material, alpha, tilt_deg):
    """Against a matt surface of the same reflectance rho, whose radiance is rho / pi: pi D G / (4 cos_in cos_out).

    D and G of Walter et al., Microfacet Models for Refraction through Rough Surfaces (2007), for GGX.
    """
    rig = mounted(small, size=(4, 4))
    parts = rig.scene_dict(np.full((1, *rig.projector.shape), 255, np.uint8))
    tilt = np.radians(tilt_deg)
    corners = (
        6
        * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        @ Rotation.from_rotvec([0, tilt, 0]).as_matrix().T
    )
    plane = Part(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, material)
    bright = []
    for matt in (True, False):
        scene = mi.load_dict(parts | specimen_dict([plane], RenderSettings(diffuse_only=matt)))
        bright.append(float(np.mean(np.array(mi.render(scene)))))
    normal, camera, projector = (np.array([np.sin(a), 0, np.cos(a)]) for a in (tilt, -HALF_ANGLE, HALF_ANGLE))
    cos_out, cos_in = normal @ camera, normal @ projector
    cos_half = normal[2]  # halfway between the two paths is upwards
    facets = alpha**2 / (np.pi * (1 + cos_half**2 * (alpha**2 - 1)) ** 2)
    unshadowed = [2 / (1 + np.sqrt(1 + alpha**2 * (1 / c**2 - 1))) for c in (cos_in, cos_out)]
    expected = np.pi * facets * np.prod(unshadowed) / (4 * cos_in * cos_out)
    # The pupils are 1.7 degrees wide, over which D is a little curved.
    assert bright[1] / bright[0] == pytest.approx(expected, rel=5e-3)
    assert bright[1] / bright[0] > 1.5
