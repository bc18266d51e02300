"""Claims about the volume, on planes whose errors are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.point_kernel import PointKernel
from greenough.pipeline.rays import Rays
from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation import volume as volume_module
from greenough.twin.validation.mechanics import calibration_noise_share
from greenough.twin.validation.volume import (
    VOLUME_HEIGHTS_MM,
    MeasuredPlane,
    _block_means,
    measure_volume,
    share_lost,
    volume_claims,
    without_motion,
)

TILTS = ((0.3, 0.0), (0.0, -0.28), (-0.2, 0.17))


def motion(height: float, tilt: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [*tilt, 0.3]).as_matrix()
    matrix[2, 3] = height
    return matrix


def plane(world_from_plane: np.ndarray, error=lambda xyz: np.zeros(xyz.shape[:2]), seed: int = 1) -> MeasuredPlane:
    """What a plane gives whose points have vertical errors of ``error`` and noise of 1.6 um."""
    x, y = np.meshgrid(np.linspace(-4, 4, 320), np.linspace(3, -3, 240))
    normal, origin = world_from_plane[:3, 2], world_from_plane[:3, 3]
    z = origin[2] - ((x - origin[0]) * normal[0] + (y - origin[1]) * normal[1]) / normal[2]
    xyz = np.stack([x, y, z], axis=-1)
    errors = error(xyz) + np.random.default_rng(seed).normal(0, 1.6e-3, z.shape)
    return MeasuredPlane(
        tilted=bool(abs(normal[2]) < 0.999),
        stage_position=float(origin[2]),
        world_from_plane=world_from_plane,
        errors=errors.ravel(),
        blocks=_block_means(
            PointMap(xyz + errors[..., None] * [0, 0, 1]), errors, np.full((*z.shape, 2), [-1.45, 1.45])
        ),
        span=np.array([[-4.0, -3.0], [4.0, 3.0]]),
        noise=1.6e-3,
        filtered_noise=1.6e-3,
        exposures=0,
    )


def volume(error) -> list[MeasuredPlane]:
    motions = [motion(height) for height in VOLUME_HEIGHTS_MM] + [motion(0.0, tilt) for tilt in TILTS]
    return [plane(at, error, seed) for seed, at in enumerate(motions)]


def rows_of(setup, planes: list[MeasuredPlane]) -> dict:
    return {row.claim: row for row in volume_claims(setup, planes)}


def test_planes_beyond_the_calibrated_heights_are_left_out_and_named_by_their_own_stage_position(monkeypatch, analytic):
    stage = SimpleNamespace(position_mm=0.0)
    stage.move_to_mm = lambda position: setattr(stage, "position_mm", position)
    double = SimpleNamespace(
        rig=SimpleNamespace(stage=stage),
        filter_fwhm_px=1.0,
        place=lambda placement, position=0.0: stage.move_to_mm(position),
        frames=lambda: SimpleNamespace(serials=[0]),
        decoded=lambda frames: stage.position_mm,
    )
    monkeypatch.setattr(volume_module, "share_lost", lambda setup, height: 0.02 if abs(height) > 1.45 else 0.005)
    monkeypatch.setattr(volume_module, "filter_phasors", lambda phase_map, fwhm_px: phase_map)
    monkeypatch.setattr(volume_module, "_measured", lambda setup, placement, *maps: (placement, stage.position_mm))
    (found,) = measure_volume([double], lambda steps: None)
    flat = [height for placement, height in found if not any(placement.pose_mm_deg)]
    assert flat == [height for height in VOLUME_HEIGHTS_MM if abs(height) < 1.45]
    planes = [plane(motion(height)) for height in flat] + [plane(motion(0.0, tilt)) for tilt in TILTS]
    rows = rows_of(analytic(), planes)
    assert {name for name in rows if name.startswith("depth_bias_at")} == {f"depth_bias_at_{z:+.1f}mm" for z in flat}
    assert not rows["z_range"].holds
    assert "-1.00, -0.50, +0.00, +0.50, +1.00 mm" in rows["depth_p95_volume"].criterion
    assert "8 measured" in rows["depth_systematic_p99"].criterion
    for name in ("depth_p95_volume", "depth_systematic_rms", "depth_tilted_systematic_p99"):
        assert np.isnan(rows[name].measured)
        assert (rows[name].holds, rows[name].expected_to_hold) == (False, True)
    assert rows["depth_tilted_p95"].holds


def test_without_any_plane_no_row_has_a_figure_and_none_holds(analytic):
    for method in ("bundle", "paper"):
        rows = rows_of(analytic(method=method), [])
        assert all(np.isnan(row.measured) and not row.holds for row in rows.values())
        assert {"depth_p95_volume", "depth_systematic_p99", "volume_x", "z_range"} <= rows.keys()


def test_planes_without_a_whole_block_are_predicted_nothing(analytic):
    planes = [replace(plane, blocks=np.empty((0, 6))) for plane in volume(lambda xyz: np.zeros(xyz.shape[:2]))]
    rows = rows_of(analytic(), planes)
    assert np.isnan(rows["depth_systematic_p99"].measured)
    assert rows["depth_p95_volume"].predicted is None


@pytest.mark.parametrize(("height", "error", "lost"), [(1.48, 0.01, 0.0), (1.48, 0.03, 0.25), (1.46, 0.03, 0.0)])
def test_points_are_lost_where_the_error_leads_out_of_the_calibrated_heights(analytic, height, error, lost):
    """Known are -1.45 to 1.45 mm and half a step of 0.1 mm; a quarter of the field errs upwards, an eighth is dark,
    and an eighth knows the lower half alone, where no error counts."""
    z = np.full((16, 16), height)
    z[:, :4] += error
    valid = np.ones(z.shape, bool)
    valid[:, 12:14] = False
    valid[:, :4] = True
    known = np.full((16, 16, 2), [-1.45, 1.45])
    known[:, 14:, 1] = 0.0
    setup = analytic(motion(height))
    image = np.zeros(z.shape)

    upright = np.zeros((*z.shape, 2), np.float32)
    middle, half = known.mean(axis=-1), np.ptp(known, axis=-1) / 2
    coefficients = np.stack([half, middle, 0 * z, 0 * z], axis=-1)  # such that the phase is the height
    relation = PhaseHeight(coefficients, middle, half, known, np.ones(z.shape, bool))
    setup.calibration.rays = Rays(upright, upright)
    setup.calibration.phase_height = relation
    setup.calibration.point_kernel = PointKernel.of(relation, setup.calibration.rays, margin_mm=0.05)
    setup.calibration.uncertainty_after = lambda exposures: None
    setup.calibration.check_shape = lambda shape: None
    found = share_lost(setup, PhaseMap(z, image, image, valid, image, image))
    assert found == pytest.approx(lost * 16 / 12)
    assert share_lost(setup, PhaseMap(z, image, image, image > 0, image, image)) == 1


@pytest.mark.slow
def test_noise_that_blocks_leave_is_predicted_too(analytic):
    """On a perfect stage all there is: 1.6 um / 16, and 2.58 times that for 99 %."""
    setup = analytic()
    rows = rows_of(setup, volume(lambda xyz: np.zeros(xyz.shape[:2])))
    noise = 0.1 * np.hypot(1, calibration_noise_share(setup, np.array([*VOLUME_HEIGHTS_MM, 0, 0, 0])))
    assert rows["depth_systematic_rms"].predicted == pytest.approx(noise, rel=0.01)
    assert rows["depth_systematic_p99"].predicted == pytest.approx(2.576 * noise, rel=0.1)


def test_places_and_slope_are_those_of_the_true_plane():
    tilted = plane(motion(0.4, (0.2, -0.1)), lambda xyz: 0.1 * np.ones(xyz.shape[:2]))
    on_part = (tilted.places - [0, 0, 0.4]) @ tilted.world_from_plane[:3, :3]
    np.testing.assert_allclose(on_part[:, 2], 0, atol=1e-12)
    assert len(tilted.places) == 23
    x, y, z = tilted.places.T
    np.testing.assert_allclose(z - 0.4, tilted.slope @ [x, y], atol=1e-12)


def test_a_small_rigid_motion_of_everything_is_no_error():
    """Flat and tilted planes moved by micrometres and microradians: what is left is of second order."""
    turn, shift = Rotation.from_rotvec([3e-6, -2e-6, 5e-6]), np.array([2e-3, -1e-3, 3e-3])
    planes = [plane(motion(height, tilt)) for height, tilt in ((-1.0, (0, 0)), (0.5, (0, 0)), *((0, t) for t in TILTS))]
    points = [p.places for p in planes]
    error = []
    for xyz, p in zip(points, planes, strict=True):
        moved = turn.apply(xyz) + shift
        error.append((moved - p.world_from_plane[:3, 3]) @ p.world_from_plane[:3, 2] / p.world_from_plane[2, 2])
    left = without_motion(points, planes, np.concatenate(error))
    assert np.abs(np.concatenate(error)).max() > 3e-3
    np.testing.assert_allclose(left, 0, atol=1e-9)


def test_a_wrong_scale_of_depth_is_not_taken_for_a_motion():
    planes = volume(lambda xyz: 1e-3 * xyz[..., 2])
    left = without_motion([p.blocks[:, :3] for p in planes], planes, np.concatenate([p.blocks[:, 3] for p in planes]))
    depth = np.concatenate([p.blocks[:, 2] for p in planes])
    assert np.polyfit(depth, left, 1)[0] == pytest.approx(1e-3, rel=0.05)


def test_systematic_rows_average_noise_away_and_leave_height_and_tilt_aside(analytic):
    """Blocks of 256 normal deviates of 1.6 um: their means have 0.1 um, and an RMS of thousands is within 5 %."""

    def error(xyz: np.ndarray) -> np.ndarray:
        wave = 0.4e-3 * np.sqrt(2) * np.sin(np.pi * xyz[..., 0])  # 2 mm long
        return 3e-3 + 1e-3 * xyz[..., 0] - 0.5e-3 * xyz[..., 1] + wave

    rows = rows_of(analytic(), volume(error))
    assert rows["depth_origin"].measured == pytest.approx(3.0, abs=0.05)
    wave = 0.4 * np.sinc(16 * 8 / 319 / 2)  # what blocks leave of it
    for part, count in (("", 10), ("_tilted", 3)):
        row = rows[f"depth{part}_systematic_rms"]
        assert row.measured == pytest.approx(np.hypot(0.1, wave), rel=0.08)
        assert row.holds
        assert row.n == count * 15 * 20
        assert rows[f"depth{part}_systematic_p99"].measured < 1.5


@pytest.mark.slow
def test_each_kind_of_plane_has_its_own_percentile(analytic):
    """Errors of 2 um on slopes alone: |2 + noise of 1.6| has its 95 % at 2 + 1.645 * 1.6."""
    rows = rows_of(analytic(), volume(lambda xyz: 2e-3 * (np.ptp(xyz[..., 2]) > 0.1) * np.ones(xyz.shape[:2])))
    assert rows["depth_p95_volume"].measured == pytest.approx(1.96 * 1.6, rel=0.02)
    assert rows["depth_tilted_p95"].measured == pytest.approx(2 + 1.645 * 1.6, rel=0.02)
    # The prediction knows of the frames' noise and of the calibration's.
    share = calibration_noise_share(analytic(), np.array(VOLUME_HEIGHTS_MM))
    assert rows["depth_p95_volume"].predicted == pytest.approx(1.96 * 1.6 * np.hypot(1, share), rel=0.03)


@pytest.mark.slow
def test_a_stage_that_goes_too_far_is_predicted_in_every_row_of_the_paper_s_method(analytic):
    def too_far(reading: float, xy: np.ndarray) -> np.ndarray:
        return np.full(len(xy), 1.004 * reading)

    setup = analytic(blank_face_height=too_far)
    rows = rows_of(setup, volume(lambda xyz: (1 / 1.004 - 1) * xyz[..., 2]))
    for name in ("depth_systematic_rms", "depth_tilted_systematic_rms", "depth_systematic_p99", "depth_p95_volume"):
        assert rows[name].predicted == pytest.approx(rows[name].measured, rel=0.08), name
        assert rows[name].expected_to_hold is rows[name].holds is False
    for height in VOLUME_HEIGHTS_MM:
        row = rows[f"depth_bias_at_{height:+.1f}mm"]
        assert row.predicted == pytest.approx(1e3 * (1 / 1.004 - 1) * height, abs=1e-3)
