"""The procedures against a small rig of plain geometry."""

import logging
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.pipeline import acquisition
from greenough.pipeline.acquisition import (
    METHODS,
    CalibrationMethod,
    calibrate,
    calibrate_by_methods,
    calibration_steps,
    measure,
    plane_heights,
)
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.unfinished import Unfinished
from plain_rig import BOARD, PROCEDURE, SHAPE, TABLE_FROM_FLAT, TABLETOP, Killed, PlainRig, pose_of, rays, scene


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "cal.h5"
    with PlainRig() as rig:
        calibration = calibrate(rig, out, run="run", method="paper")
    return calibration, out, rig


def assert_same(one: Calibration, other: Calibration):
    """To the last bit."""
    assert one.camera == other.camera
    assert one.figures == other.figures
    assert one.exposures == other.exposures
    np.testing.assert_array_equal(one.camera_from_world, other.camera_from_world)
    for group in ("rays", "phase_height", "residuals"):
        for field in fields(getattr(one, group)):
            arrays = (getattr(getattr(calibration, group), field.name) for calibration in (one, other))
            np.testing.assert_array_equal(*arrays)


@pytest.fixture(scope="module")
def all_methods(tmp_path_factory):
    """Calibrations by all methods from one acquisition on a bad stage, and the rig."""
    folder = tmp_path_factory.mktemp("all")
    with PlainRig(stage_error=bad_stage) as rig:
        return calibrate_by_methods(rig, {method: folder / f"{method}.h5" for method in METHODS}, "run"), rig


def bad_stage(reading):
    """True height (mm) of a stage whose scale is 5 per mille wrong and which errs by 10 µm from place to place."""
    return 1.005 * reading + 0.01 * np.sin(17 * reading)


def test_all_methods_come_from_one_acquisition(all_methods):
    calibrations, rig = all_methods
    assert len(rig.placed) == PROCEDURE.postures + 1
    assert {method: calibration.method for method, calibration in calibrations.items()} == {m: m for m in METHODS}
    for calibration in calibrations.values():
        assert np.array_equal(
            calibration.residuals.centres_px, calibrations["paper"].residuals.centres_px, equal_nan=True
        )


def test_only_the_papers_method_believes_the_stage(all_methods):
    """A step between two true heights: the paper's method repeats the stage's scale, the others have the board's."""
    steps = {}
    for method, calibration in all_methods[0].items():
        heights = []
        for reading in (-0.6, 0.6):
            with PlainRig(run=f"step {reading}", stage_error=lambda _, height=reading: height) as rig:
                heights.append(np.nanmedian(measure(rig, calibration, Placement("plane")).xyz[140:220, 200:280, 2]))
        steps[method] = heights[1] - heights[0]
    assert abs(steps.pop("paper") - 1.2) > 3e-3
    assert steps.keys() == {"bundle", "stage-free", "triangulation"}
    assert max(abs(step - 1.2) for step in steps.values()) < 1e-3


@pytest.fixture(scope="module")
def stage_free(tmp_path_factory):
    """Calibrated without planes on a stage too short for them, and the rig."""
    out = tmp_path_factory.mktemp("stage-free") / "cal.h5"
    steps: list[float] = []
    with PlainRig(limit=0.1) as rig:
        calibration = calibrate(rig, out, "run", steps.append, "stage-free")
    assert sum(steps) == calibration_steps(PROCEDURE, ["stage-free"]) == PROCEDURE.postures
    return calibration, rig


def test_without_planes_nothing_is_turned_over_moved_or_captured(stage_free):
    calibration, rig = stage_free
    assert len(rig.placed) == PROCEDURE.postures
    assert all(placement.face == "printed" for placement in rig.placed)
    assert set(rig.moves) == {0.0}
    assert rig.sequences == PROCEDURE.postures
    assert calibration.residuals.planes_um.shape[0] == 0
    assert np.isnan(calibration.residuals.pixels_um).all()


def test_planes_for_other_methods_change_nothing_for_those_without(stage_free, all_methods):
    assert_same(stage_free[0], all_methods[0]["stage-free"])


def test_a_calibration_without_planes_is_valid_where_postures_were_seen(stage_free):
    """Everywhere that spots with a phase were seen, at the heights that they had."""
    calibration = stage_free[0]
    relation, seen = calibration.phase_height, np.isfinite(calibration.residuals.spot_phases_rad)
    u, v = np.rint(calibration.residuals.centres_px[seen]).astype(int).T
    assert relation.valid[v, u].all()
    assert relation.valid.mean() < 0.6
    low, high = calibration.figures["z_low_mm"], calibration.figures["z_high_mm"]
    reach = BOARD.pitch_mm / 2
    assert np.nanmin(relation.z_range) == pytest.approx(low - reach, abs=0.01)
    assert np.nanmax(relation.z_range) == pytest.approx(high + reach, abs=0.01)


@pytest.mark.slow
@pytest.mark.essential
def test_a_killed_calibration_without_planes_goes_on_to_the_same_result(stage_free, tmp_path):
    out = tmp_path / "cal.h5"
    with pytest.raises(Killed), PlainRig(limit=0.1, dies_at=6) as rig:
        calibrate(rig, out, run="run", method="stage-free")
    steps: list[float] = []
    with PlainRig(limit=0.1, exposures_done=Unfinished.beside(out).exposures) as rig:
        assert_same(calibrate(rig, out, "run", steps.append, "stage-free"), stage_free[0])
    assert sum(steps) == PROCEDURE.postures
    assert rig.sequences == PROCEDURE.postures - 5


@pytest.mark.slow
def test_postures_that_a_method_refuses_are_shown_again(tmp_path, monkeypatch):
    def refuse(data):
        raise InputError("these postures say nothing")

    out = tmp_path / "cal.h5"
    with monkeypatch.context() as patched, PlainRig() as rig:
        patched.setitem(METHODS, "triangulation", CalibrationMethod(refuse, False, True))
        with pytest.raises(InputError, match="say nothing"):
            calibrate(rig, out, run="run", method="triangulation")
    assert list(Unfinished.beside(out).folder.glob("*.h5")) == []
    with PlainRig(exposures_done=Unfinished.beside(out).exposures) as rig:
        assert calibrate(rig, out, run="run", method="triangulation").method == "triangulation"


def test_the_board_is_shown_as_the_paper_shows_it(undisturbed):
    *tilted, flat, blank = undisturbed[2].placed
    assert tilted == [Placement("board", posture=k) for k in range(7)]
    assert flat == Placement("board")
    assert blank == Placement("board", face="blank")


def test_the_file_holds_the_calibration_and_nothing_is_left_beside_it(undisturbed):
    calibration, out, _ = undisturbed
    assert_same(Calibration.load(out), calibration)
    assert [path.name for path in out.parent.iterdir()] == ["cal.h5"]


def test_a_tilted_plane_is_measured_in_the_boards_frame(undisturbed):
    calibration = undisturbed[0]
    with PlainRig(run="other") as rig:
        points = measure(rig, calibration, Placement("tilted plane"))
    # Truth from the same geometry, in the frame of the flat board.
    origin, direction = rays()
    pose = pose_of(Placement("tilted plane"))
    hit = origin + direction * ((pose[:3, 3] - origin) @ pose[:3, 2] / (direction @ pose[:3, 2]))[..., None]
    truth = (hit - TABLE_FROM_FLAT[:3, 3]) @ np.linalg.inv(TABLE_FROM_FLAT[:3, :3]).T
    error = (points.xyz - truth)[points.valid]
    assert points.valid.mean() > 0.4
    # One exposure's phase noise, about 0.011 rad at 0.16 mm/rad, and the calibration's own share of it.
    assert np.abs(error[:, 2].mean()) < 0.3e-3
    assert error[:, 2].std() < 3.0e-3
    # 37.9 px/mm: a hundredth of a pixel is 0.26 µm, at the rim of the field some times that.
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("dies_at", [1, 5, 9, 14])
def test_a_killed_calibration_goes_on_to_the_same_result(undisturbed, tmp_path, dies_at):
    out = tmp_path / "cal.h5"
    with pytest.raises(Killed), PlainRig(dies_at=dies_at) as rig:
        calibrate(rig, out, run="run")
    assert not out.exists()
    steps: list[float] = []
    with PlainRig(exposures_done=Unfinished.beside(out).exposures) as rig:
        resumed = calibrate(rig, out, run="run", advance=steps.append, method="paper")
    assert_same(resumed, undisturbed[0])
    assert sum(steps) == PROCEDURE.postures + PROCEDURE.planes + 1
    tilted_again = [placement.posture for placement in rig.placed if placement.posture is not None]
    assert tilted_again == list(range(min(dies_at, 8) - 1, 7))


@pytest.mark.parametrize(
    ("other", "run", "reason"),
    [
        ({"seed": 2}, "run", "other settings of the rig .*its seed"),
        ({}, "tuesday", "another run"),
        ({"procedure": replace(PROCEDURE, planes=9)}, "run", "another procedure"),
    ],
)
def test_going_on_with_something_else_is_refused_with_the_reason(tmp_path, other, run, reason):
    out = tmp_path / "cal.h5"
    with pytest.raises(Killed), PlainRig(dies_at=2) as rig:
        calibrate(rig, out, run="run")
    with PlainRig(**other) as rig, pytest.raises(InputError, match=reason):
        calibrate(rig, out, run=run)
    assert rig.placed == []


@pytest.mark.slow
def test_a_board_not_found_is_named_and_the_rest_is_kept(tmp_path, caplog):
    with PlainRig(hidden=(3,)) as rig, caplog.at_level(logging.WARNING):
        calibration = calibrate(rig, tmp_path / "cal.h5", run="run")
    assert "posture 03" in caplog.text
    assert calibration.figures["postures_without_board"] == ("03",)
    assert calibration.figures["postures_used"] == 7


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [(0, 2, 5), (None,)])
def test_too_few_postures_are_refused_before_the_planes_and_can_be_laid_again(tmp_path, hidden):
    out = tmp_path / "cal.h5"
    names = ", ".join("flat" if k is None else f"{k:02d}" for k in hidden)
    with PlainRig(hidden=hidden) as rig, pytest.raises(InputError, match=f"not found in posture {names}:"):
        calibrate(rig, out, run="run")
    assert all(placement.face == "printed" for placement in rig.placed)
    with PlainRig(exposures_done=Unfinished.beside(out).exposures) as rig:
        calibrate(rig, out, run="run")
    assert [placement.posture for placement in rig.placed if placement.face == "printed"] == list(hidden)


@pytest.mark.slow
def test_too_few_phases_at_spots_are_refused_before_the_planes_and_only_by_the_bundle(tmp_path, monkeypatch):
    measured = acquisition.measure_spot_phases

    def mostly_dark(phase_map, spots, dark):
        phases = measured(phase_map, spots, dark)
        return replace(phases, sigma_rad=np.where(np.arange(len(phases.sigma_rad)) < 5, phases.sigma_rad, np.nan))

    monkeypatch.setattr(acquisition, "measure_spot_phases", mostly_dark)
    out = tmp_path / "cal.h5"
    with PlainRig() as rig, pytest.raises(InputError, match=r"from \d+ spots with a phase in 8 postures: at least 50"):
        calibrate(rig, out, run="run", method="bundle")
    assert all(placement.face == "printed" for placement in rig.placed)
    assert list(Unfinished.beside(out).folder.glob("posture-*")) == []
    with PlainRig() as rig:
        assert calibrate(rig, out, run="run", method="paper").method == "paper"


@pytest.mark.slow
def test_planes_stay_in_their_files(tmp_path, monkeypatch):
    def look(data):
        assert isinstance(data.phases, h5py.Dataset)
        assert data.phases.shape == (PROCEDURE.planes, *SHAPE)
        assert np.isfinite(data.phases).any(axis=(1, 2)).all()
        raise InputError("enough seen")

    out = tmp_path / "cal.h5"
    monkeypatch.setitem(METHODS, "paper", CalibrationMethod(look, True, False))
    with PlainRig() as rig, pytest.raises(InputError, match="enough seen"):
        calibrate(rig, out, run="run", method="paper")
    assert list(Unfinished.beside(out).folder.glob("plane-*")) == []


def test_planes_beyond_the_stage_are_refused_before_anything_moves(tmp_path):
    with PlainRig(limit=1.0) as rig, pytest.raises(InputError, match=r"from -1\.35 to 1\.35 mm, the stage only"):
        calibrate(rig, tmp_path / "cal.h5")
    assert rig.placed == []
    assert list(tmp_path.iterdir()) == []


def test_too_few_planes_are_refused_before_anything_moves(tmp_path):
    procedure = replace(PROCEDURE, planes=7)
    with PlainRig(procedure=procedure) as rig, pytest.raises(InputError, match=r"at least 8 .* states 7: raise"):
        calibrate(rig, tmp_path / "cal.h5")
    assert rig.placed == []
    assert list(tmp_path.iterdir()) == []


def test_the_rim_of_the_light_is_left_out_of_every_plane(undisturbed):
    relation = undisturbed[0].phase_height
    counted = 0
    for z in plane_heights(PlainRig()):
        light, _ = scene(Placement("board", face="blank"), False, z)
        near_the_dark = minimum_filter(light, size=7) == 0
        # Heights are counted from the shared posture: all shift alike, by far less than a step.
        ends_here = np.abs(relation.z_range - z).min(axis=-1) < PROCEDURE.plane_step_mm / 10
        counted += ends_here.sum()
        assert not (ends_here & near_the_dark).any()
    assert counted >= 2 * relation.valid.sum()


def test_the_planes_are_centred_and_evenly_spaced():
    heights = plane_heights(PlainRig(procedure=replace(PROCEDURE, planes=30, plane_step_mm=0.1)))
    np.testing.assert_allclose(heights, np.linspace(-1.45, 1.45, 30), atol=1e-12)


def test_another_rigs_calibration_is_refused_before_anything_moves(undisturbed):
    with PlainRig(run="other") as rig:
        rig.identity = replace(rig.identity, camera_serial="camera 2")
        with pytest.raises(InputError, match="camera serial is 'camera 1', this rig's is 'camera 2'"):
            measure(rig, undisturbed[0], Placement("tilted plane"))
    assert rig.placed == []


def test_a_measurement_must_not_share_exposures_with_its_calibration(undisturbed):
    with PlainRig(run="run") as rig, pytest.raises(InputError, match="run of another name"):
        measure(rig, undisturbed[0], Placement("tilted plane"))
    with PlainRig(run="run", exposures_done=undisturbed[0].exposures) as rig:
        assert measure(rig, undisturbed[0], Placement("tilted plane")).valid.any()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["paper", "triangulation"])
def test_a_tilted_plane_is_measured_in_a_field_as_large_as_a_table(tmp_path, method):
    """Of which no pixel is left out because heights move its phase less or more than in the middle."""
    wide = {"geometry": TABLETOP, "procedure": replace(PROCEDURE, plane_step_mm=6.0), "limit": 32.0}
    with PlainRig(**wide) as rig:
        calibration = calibrate(rig, tmp_path / "cal.h5", run="run", method=method)
    with PlainRig(run="other", **wide) as rig:
        points = measure(rig, calibration, Placement("tilted plane"))
    origin, direction = rays(TABLETOP)
    pose, flat = pose_of(Placement("tilted plane"), geometry=TABLETOP), pose_of(Placement("board"), geometry=TABLETOP)
    hit = origin + direction * ((pose[:3, 3] - origin) @ pose[:3, 2] / (direction @ pose[:3, 2]))[..., None]
    error = points.xyz - (hit - flat[:3, 3]) @ np.linalg.inv(flat[:3, :3]).T
    light, _ = scene(Placement("tilted plane"), False, 0.0, TABLETOP)
    inner = minimum_filter(light, 31, mode="constant") > 0
    assert points.valid.sum() > {"paper": 0.95, "triangulation": 0.7}[method] * inner.sum()
    noise = np.nanmean((error[..., 2] / points.sigma_noise[..., 2]) ** 2)
    assert 0.9 < noise < 1.6
    assert abs(np.nanmean(error[..., 2])) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_a_grid_of_spots_that_are_all_alike_calibrates_too(tmp_path, dark):
    """White on dark or dark on white: where spots are dark the phase is taken around them."""
    board = replace(BOARD, big=(), big_diameter_mm=BOARD.small_diameter_mm, dark_spots=dark)
    with PlainRig(board=board) as rig:
        calibration = calibrate(rig, tmp_path / "cal.h5", run="run", method="triangulation")
    assert calibration.figures["spot_phases_used"] > 200
    with PlainRig(run="other", board=board) as rig:
        points = measure(rig, calibration, Placement("tilted plane"))
    origin, direction = rays()
    pose = pose_of(Placement("tilted plane"))
    hit = origin + direction * ((pose[:3, 3] - origin) @ pose[:3, 2] / (direction @ pose[:3, 2]))[..., None]
    error = points.xyz - (hit - TABLE_FROM_FLAT[:3, 3]) @ np.linalg.inv(TABLE_FROM_FLAT[:3, :3]).T
    assert points.valid.mean() > 0.4
    assert abs(np.nanmean(error[..., 2])) < 1e-3
    assert np.nanstd(error[..., 2]) < 1.5e-3


def test_brackets_and_the_filter_lower_the_noise(undisturbed):
    def noise(**options):
        with PlainRig(run="other") as rig:
            z = measure(rig, undisturbed[0], Placement("tilted plane"), **options).xyz[100:260, 150:330, 2]
        # Second differences of a plane are noise alone.
        return np.nanstd(z[:, 2:] - 2 * z[:, 1:-1] + z[:, :-2])

    plain = noise()
    assert noise(brackets=(1.0, 0.9)) < 0.95 * plain
    assert noise(filter_fwhm_px=2.0) < 0.5 * plain
