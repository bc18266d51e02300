import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import BLANK, Placement
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.bundle_data import measure_spot_phases
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.spots import detect_spots
from greenough.scenes.board import blank_height, ceramic_height
from greenough.twin.settings import twin_settings
from greenough.twin.validation.observations import Surface, build, ellipse_centres, phase_of, point_spread, spot_centres

# A part of the field on the camera's own pixels.
PART = ["camera.rows=400", "camera.cols=480", "camera.bits=0", "twin.board.ink_thickness_um=0", "twin.light.ambient=0"]
STILL = [f"twin.stability.{name}=0" for name in ("flicker", "vibration_um", "table_drift_um", "path_drift_um")]
NOISELESS = ["shot_noise=false", "read_noise_e=0", "prnu=0", "dsnu_e=0"]
QUIET = [*PART, *STILL, *(f"twin.camera.{setting}" for setting in NOISELESS)]
GREY_PER_RADIANCE = 600.0  # a white Lambertian plane has 1 / pi


def instrument(overrides, run="observations"):
    rig_file = load_rig_file("twin", overrides)
    return build(rig_file, twin_settings(rig_file), run)


def test_points_of_a_conic_have_its_centre():
    rng = np.random.default_rng(1)
    camera = CameraModel(22683.0, 22683.0, 0.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0, (960, 1280))
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * [1, 1, 1]
    pose[:3, 3] = [1.0, -2.0, 224.0]
    centres, radius = rng.uniform(-3, 3, (5, 2)), 0.2
    angle = 2 * np.pi * np.arange(8) / 8
    rims = centres[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    imaged = camera.project(rims @ pose[:3, :2].T + pose[:3, 3])
    expected = camera.project_circles(centres, np.full(5, radius), pose)
    np.testing.assert_allclose(ellipse_centres(imaged), expected, atol=1e-8)


def test_pinholes_see_what_a_pinhole_camera_projects():
    ideal = instrument(
        [*QUIET, "twin.optics.glass=false", "twin.optics.finite_aperture=false", "twin.board.bow_sd_um=0"]
    )
    bench = ideal.workbench
    bench.place(Placement("board", posture=0))
    board, pose = bench.printed_board("board"), bench.twin_from_part()
    sine, cosine = np.sin(np.radians(6.0)), np.cos(np.radians(6.0))
    camera_from_twin = np.eye(4)
    camera_from_twin[:3, :3] = [[cosine, 0, sine], [0, -1, 0], [sine, 0, -cosine]]
    camera_from_twin[2, 3] = 224.56
    camera = CameraModel(22683.0, 22683.0, 0.0, 239.5, 199.5, 0.0, 0.0, 0.0, 0.0, (400, 480))
    expected = camera.project_circles(board.centres, board.nominal.diameters() / 2, camera_from_twin @ pose)
    np.testing.assert_allclose(spot_centres(ideal, board, pose, ideal.chief), expected, atol=1e-6)


def test_ideal_lenses_blur_by_their_aperture_and_focus_across_their_axis():
    px_per_mm = 22683.0 / 224.56
    found = point_spread(instrument([*QUIET, "twin.optics.glass=false"]))
    # The camera leans by 6 degrees: level planes cut its pencils longer, along u twice so, and its focus leans along.
    cosine = np.cos(np.radians(6.0))
    longer = np.sqrt((1 / cosine**2 + 1 / cosine**4) / 2)
    assert found.defocus_px_per_mm == pytest.approx(0.015 * px_per_mm * longer, rel=5e-4)
    height, along_u, along_v, curvature = found.focus_mm
    assert height == pytest.approx(0.0, abs=2e-3)
    assert abs(along_u) == pytest.approx(np.tan(np.radians(6.0)) / px_per_mm, rel=2e-2)
    assert abs(along_v) < 1e-2 * abs(along_u)
    assert abs(curvature) * 240**2 < 2e-3
    pinhole = point_spread(instrument([*QUIET, "twin.optics.finite_aperture=false"]))
    assert pinhole.disc_radius_px(np.zeros((1, 2)), np.ones(1)) == 0.0


@pytest.fixture(scope="module")
def rendered():
    rig, _ = gt.open("twin", QUIET, run="observations")
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    patterns = fringes.patterns(*rig.projector.shape)

    def capture(placement):
        rig.operator.place(placement)
        return decode((GREY_PER_RADIANCE * rig.irradiance(patterns)).astype(np.float32), fringes)

    return capture


@pytest.fixture(scope="module")
def glass():
    return instrument(QUIET)


@pytest.mark.slow
@pytest.mark.parametrize("posture", [4])
def test_spots_and_their_phases_are_those_of_rendered_pictures(rendered, glass, posture):
    """Rendered spots scatter by the few paths that each pixel has; a real effect is smooth, and shifts many alike."""
    placement = Placement("board", posture=posture)
    phase_map = rendered(placement)
    bench = glass.workbench
    bench.place(placement)
    board = bench.printed_board("board")
    found = detect_spots(phase_map.background, board.nominal)
    centres = spot_centres(glass, board, bench.twin_from_part(), glass.edge_nodes)
    missed = (found.centres_px - centres)[found.seen]
    assert np.abs(missed.mean(axis=0)).max() < 3e-3
    assert missed.std(axis=0).max() < 8e-3

    surface = Surface(bench.twin_from_part(), lambda xy: ceramic_height(board, xy))
    measured = measure_spot_phases(phase_map, found)
    seen = np.isfinite(measured.phase_rad)
    expected = phase_of(glass, surface, found.centres_px[seen], glass.flat_nodes)
    difference = measured.phase_rad[seen] - expected
    assert np.abs(difference.mean()) < 1e-3
    assert difference.std() < 1e-3


@pytest.mark.slow
def test_phases_of_the_blank_side_are_those_of_rendered_pictures(rendered, glass):
    placement = Placement("board", face=BLANK)
    phase = rendered(placement).absolute
    bench = glass.workbench
    bench.place(placement)
    board = bench.printed_board("board")
    surface = Surface(bench.twin_from_part(), lambda xy: blank_height(board, xy))
    side = 16
    blocks = phase[: phase.shape[0] // side * side, : phase.shape[1] // side * side]
    blocks = blocks.reshape(-1, side, blocks.shape[1] // side, side).mean(axis=(1, 3))
    v, u = np.indices(blocks.shape) * side + (side - 1) / 2
    expected = phase_of(glass, surface, np.stack([u.ravel(), v.ravel()], axis=-1), glass.flat_nodes)
    difference = blocks.ravel() - expected
    assert np.isfinite(difference).sum() > 500
    assert np.nanmax(np.abs(difference)) < 5e-4
