"""Switching glass and its assembly errors on moves what pixels see by the amount that is predicted here."""

from functools import lru_cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import j1

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.twin.glass.aberrations import chief_rays
from greenough.twin.glass.as_built import AssembledPath
from greenough.twin.glass.placed import PathErrors
from greenough.twin.glass.prescription import Prescription
from greenough.twin.rig import fringe_patterns
from greenough.twin.scene import assembled
from greenough.twin.settings import AssemblySettings

LEAN = {"camera": -np.radians(6), "projector": np.radians(6)}
DISTANCE, PIXEL, COLUMN, NA = 224.56, 224.56 / 22683, 17.835e-3, 0.015
SEED = 1
ALIGNED = AssemblySettings(decentre_um=0, tilt_deg=0, image_tilt_deg=0, focus_um=0, axis_deg=0, pointing_um=0)
INDEX = {"air": 1.0, "N-BK7": 1.519868, "N-SF5": 1.680658, "N-BAF10": 1.675456, "N-SF6": 1.817282}  # at 525 nm


def path(name: str, **sizes: float) -> AssembledPath:
    """A path of the instrument with no other assembly errors than these."""
    return assembled(name, LEAN[name], ALIGNED.model_copy(update=sizes), SEED)


@lru_cache
def twin(rows: int, cols: int, focal_px: float = 22683.0, glass: bool = True, **sizes: float):
    """A rig and its bench with no other mechanical errors than these of the assembly, and a plane mounted."""
    assembly = (f"twin.assembly.{name}={size}" for name, size in (ALIGNED.model_dump() | sizes).items())
    stage = ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")
    rig, bench = gt.open(
        "twin",
        [
            f"camera.rows={rows}",
            f"camera.cols={cols}",
            f"twin.optics.camera_focal_px={focal_px}",
            f"twin.optics.glass={str(glass).lower()}",
            f"twin.seed={SEED}",
            *assembly,
            *(f"twin.stage.{name}=0" for name in stage),
        ],
    )
    rig.operator.place(Placement("plane"))
    return rig, bench


def seen(z: float, **twins) -> gt.Truth:
    """What the pixels of a twin meet on a plane at ``z``."""
    rig, bench = twin(**twins)
    rig.stage.move_to_mm(z)
    return bench.truth()


@pytest.mark.slow
def test_glass_distorts_the_picture_as_it_was_designed_to():
    """By design a point at 7.9 mm is seen 0.31 % too near to the middle, and others in proportion to their square."""
    field = {"rows": 61, "cols": 81, "focal_px": 22683 / 16}
    ideal, glass = (seen(0.0, glass=on, **field).xyz for on in (False, True))
    v, u = np.indices(ideal.shape[:2]) - np.array([30, 40])[:, None, None]
    focused = np.hypot(u, v) * 16 * PIXEL
    right = np.array([np.cos(LEAN["camera"]), 0, -np.sin(LEAN["camera"])])
    forward = np.array([-np.sin(LEAN["camera"]), 0, -np.cos(LEAN["camera"])])

    def radius(points: np.ndarray) -> np.ndarray:
        """Through the middle of the pupil, in the plane across the axis."""
        away = points + DISTANCE * forward
        return DISTANCE * np.hypot(away @ right, away[..., 1]) / (away @ forward)

    inside = np.isfinite(ideal[..., 0]) & np.isfinite(glass[..., 0]) & (focused > 3) & (focused < 6)
    assert inside.sum() > 500
    assert_allclose(radius(ideal)[inside], focused[inside], rtol=1e-5)
    grown = radius(glass)[inside] / focused[inside] - 1
    assert_allclose(grown, 0.0031 * (focused[inside] / 7.9) ** 2, rtol=0.03, atol=5e-6)


@pytest.mark.parametrize("name", ["camera", "projector"])
@pytest.mark.parametrize("effect", ["decentre_um", "tilt_deg"])
def test_decentred_and_tilted_lenses_bend_the_middle_ray_as_first_order_optics_says(name, effect):
    """Before the path is pointed at the specimen; where that ray comes from, the angle between the paths follows."""
    built = path(name, **{effect: {"decentre_um": 30.0, "tilt_deg": 0.05}[effect]})
    ray = chief_rays(built.path, np.zeros((1, 2)))
    found = np.array([ray.at_zero[0, 0], ray.slope[0, 0]])
    expected = np.array([middle_ray(built.path.prescription, built.errors, axis) for axis in (0, 1)]).T
    assert np.linalg.norm(expected[0]) > 1e-3
    assert np.linalg.norm(expected[1]) > 1e-6
    for measured, predicted in zip(found, expected, strict=True):
        assert_allclose(measured, predicted, atol=0.02 * np.linalg.norm(predicted))


def middle_ray(prescription: Prescription, errors: PathErrors, axis: int) -> np.ndarray:
    """(height, slope) at z = 0 of the ray through the middles of stop and image: 3 x 3 matrices of (y, u, 1)."""
    vertices = prescription.vertices
    z, ray, stop = 0.0, np.eye(3), None
    for k, (surface, (before, behind)) in enumerate(zip(prescription.surfaces, prescription.glasses, strict=True)):
        ray = np.array([[1, vertices[k] - z, 0], [0, 1, 0], [0, 0, 1]]) @ ray
        z = vertices[k]
        if surface.is_stop:
            stop = ray
            continue
        numbers = prescription.elements[surface.element]
        pivot = (vertices[numbers[0]] + vertices[numbers[-1]]) / 2
        about_x, about_y = errors.tilts[surface.element]
        tilt = (about_y, -about_x)[axis]
        vertex = errors.decentres[surface.element][axis] + tilt * (z - pivot)
        n, n_behind = INDEX[before], INDEX[behind]
        curvature = 1 / surface.radius if surface.radius else 0.0
        # n' u' = n u - (n' - n) (curvature (y - vertex) - tilt)
        step = (n_behind - n) / n_behind
        ray = (
            np.array([[1, 0, 0], [-step * curvature, n / n_behind, step * (curvature * vertex + tilt)], [0, 0, 1]])
            @ ray
        )
    image = np.array([[1, vertices[-1] - z, 0], [0, 1, 0], [0, 0, 1]]) @ ray
    ends = np.stack([stop[0], image[0]])
    return np.linalg.solve(ends[:, :2], -ends[:, 2])


def test_axes_that_lean_wrongly_change_how_columns_pass_with_height():
    """dPhi/dz is the tangent that a camera ray makes with the projector's, from the two axes as they were built."""
    size = 1.0

    def columns_per_mm(**sizes: float) -> float:
        low, high = (seen(z, rows=5, cols=5, **sizes).column[2, 2] for z in (-1.0, 1.0))
        return (high - low) / 2

    camera, projector = (path(name, axis_deg=size).twin_from_path[:3, :3] for name in LEAN)
    ray = camera[:, 2] / camera[2, 2]
    expected = -projector[:, 0] @ ray / COLUMN
    straight = 2 * np.sin(LEAN["projector"]) / COLUMN
    assert abs(expected / straight - 1) > 0.01
    assert abs(columns_per_mm()) == pytest.approx(straight, rel=2e-3)
    assert columns_per_mm(axis_deg=size) / columns_per_mm() == pytest.approx(abs(expected) / straight, rel=1e-3)


def test_pointing_errors_move_the_middle_of_the_picture_and_grow_with_their_size():
    """Their standard deviation over many instruments is tested in test_as_built.py."""
    at = np.array([seen(0.0, rows=5, cols=5, pointing_um=size).xyz[2, 2, :2] for size in (0, 40, 80)])
    assert_allclose(at[0], 0, atol=1e-4)
    moved = at[1] - at[0]
    assert 2e-3 < np.linalg.norm(moved) < 0.2
    assert_allclose(at[2] - at[0], 2 * moved, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 600.0])
def test_focus_errors_move_the_height_where_fringes_are_sharpest(size):
    """Contrast against that at z = 0: discs of light of radius NA times the distance from either sharp plane.

    The designs' best focus on the axis lies at 0.250 mm (camera) and 0.254 mm (projector) along the path.
    """
    rig, _ = twin(rows=16, cols=24, focus_um=size)
    poses = [path(name, focus_um=size).twin_from_path for name in LEAN]
    moved = [pose[:3, 2] @ pose[:3, 3] for pose in poses]
    heights = np.array([-1.3, 0.0, 1.3])
    contrasts = []
    for z in heights:
        rig.stage.move_to_mm(z)
        lines = rig.irradiance(fringe_patterns(rig)[-12:]).astype(float)
        turn = np.exp(-2j * np.pi * np.arange(12) / 12)
        contrasts.append((2 * np.abs(np.tensordot(turn, lines, axes=1)) / lines.sum(axis=0)).mean())
    expected = np.ones(3)
    for sharp, error in zip((0.250, 0.254), moved, strict=True):
        x = 2 * np.pi / (12 * COLUMN) * NA * (heights * np.cos(LEAN["camera"]) - sharp - error)
        expected *= 2 * j1(x) / x
    assert_allclose(np.array(contrasts) / contrasts[1], expected / expected[1], rtol=5e-3)
