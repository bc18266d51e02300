"""A camera file is what OpenCV takes for a camera: it projects as ours does, and says where it cannot."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_file import write_camera
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.commands import app
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.rays import rays_of_camera

SHAPE = (48, 64)


def calibrated(skew=0.0, name="bench"):
    """A calibration whose points lie on the rays of its pinhole, 24° off the vertical."""
    camera = CameraModel(1134.0, 1136.0, skew, 31.0, 22.5, -0.9, 40.0, 2e-3, -3e-3, SHAPE)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = (
        cv2.Rodrigues(np.array([np.pi, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.array([0.1, 0.4, 0.05]))[0]
    )
    camera_from_world[:3, 3] = [0.2, -0.1, 224.0]
    nothing = np.full(SHAPE, np.nan, np.float32)
    return Calibration(
        method="bundle",
        camera=camera,
        camera_from_world=camera_from_world,
        rays=rays_of_camera(camera, camera_from_world),
        phase_height=PhaseHeight(
            np.zeros((*SHAPE, 4), np.float32),
            np.zeros(SHAPE, np.float32),
            np.ones(SHAPE, np.float32),
            np.tile(np.float32([-1.45, 1.45]), (*SHAPE, 1)),
            np.ones(SHAPE, bool),
        ),
        identity=RigIdentity(name, "camera 17", "2", "0" * 64),
        board=SpotBoard(5, 7, 1.2, 0.8, 0.5, 8.0, ((2, 3), (2, 4), (1, 3))),
        procedure=Procedure((64.0,), (4,), 16, 30, 0.1, 0.8, (4.0, 1.0)),
        known=KnownUncertainty(3e-5, 5e-4, 5e-5),
        run="calibrate",
        exposures=0,
        figures={"reprojection_rmse_u_px": 0.03, "reprojection_rmse_v_px": 0.04},
        residuals=Residuals(nothing[None], nothing[None], nothing, nothing[None], nothing),
        uncertainty=CalibrationUncertainty(
            np.array([-1.45, 1.45]),
            *(np.array([0.0, n - 1.0]) for n in SHAPE),
            np.zeros((1, 2, 2, 2, 3), np.float32),
            np.zeros(2),
        ),
    )


def opened(path):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return storage


def projected_by_opencv(path, xyz):
    """Pixels (n, 2) of points in the calibrated frame, by what the file says and nothing else."""
    storage = opened(path)
    camera_from_world = storage.getNode("camera_from_world").mat()
    rotation, _ = cv2.Rodrigues(camera_from_world[:3, :3])
    pixels, _ = cv2.projectPoints(
        xyz,
        rotation,
        camera_from_world[:3, 3],
        storage.getNode("camera_matrix").mat(),
        storage.getNode("distortion_coefficients").mat(),
    )
    return pixels[:, 0]


def points(calibration):
    """Points on the rays of all pixels at heights of their own, (n, 3), and the pixels, (n, 2)."""
    z = np.random.default_rng(2).uniform(-1.4, 1.4, SHAPE)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return calibration.rays.points(z).reshape(-1, 3), np.stack([u, v], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("ending", ["yaml", "yml", "json", "xml"])
def test_opencv_projects_with_the_file_as_we_do(tmp_path, ending):
    calibration = calibrated()
    write_camera(calibration, tmp_path / f"camera.{ending}")
    xyz, pixels = points(calibration)
    np.testing.assert_allclose(projected_by_opencv(tmp_path / f"camera.{ending}", xyz), pixels, atol=2e-3)
    in_camera = xyz @ calibration.camera_from_world[:3, :3].T + calibration.camera_from_world[:3, 3]
    np.testing.assert_allclose(
        projected_by_opencv(tmp_path / f"camera.{ending}", xyz), calibration.camera.project(in_camera), atol=2e-3
    )
    storage = opened(tmp_path / f"camera.{ending}")
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (64, 48)
    assert storage.getNode("avg_reprojection_error").real() == pytest.approx(0.05)
    assert storage.getNode("fit_max_px").real() < 2e-3
    assert storage.getNode("camera_serial").string() == "camera 17"
    assert storage.getNode("distortion_coefficients").mat().shape == (1, 5)


def test_a_skew_is_not_dropped_but_fitted_and_the_rest_is_stated(tmp_path):
    calibration = calibrated(skew=-2.0)
    write_camera(calibration, tmp_path / "camera.yaml")
    storage = opened(tmp_path / "camera.yaml")
    assert storage.getNode("camera_matrix").mat()[0, 1] == 0
    xyz, pixels = points(calibration)
    off = np.linalg.norm(projected_by_opencv(tmp_path / "camera.yaml", xyz) - pixels, axis=1)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(storage.getNode("fit_rms_px").real(), rel=0.1)
    assert off.max() < 1.1 * storage.getNode("fit_max_px").real()
    dropped = replace(calibration.camera, skew=0.0)
    in_camera = xyz @ calibration.camera_from_world[:3, :3].T + calibration.camera_from_world[:3, 3]
    # Half of a shear is a rotation, and a pose takes that at least.
    assert off.max() < 0.5 * np.linalg.norm(dropped.project(in_camera) - pixels, axis=1).max()


def test_what_is_nothing_like_a_camera_is_stated_as_such(tmp_path):
    calibration = calibrated()
    noise = np.random.default_rng(3).normal(0, 0.02, (*SHAPE, 2)).astype(np.float32)  # mm: 0.1 px
    noisy = replace(calibration, rays=replace(calibration.rays, origin=calibration.rays.origin + noise))
    write_camera(noisy, tmp_path / "camera.yaml")
    storage = opened(tmp_path / "camera.yaml")
    assert storage.getNode("fit_rms_px").real() == pytest.approx(0.1 * np.sqrt(2), rel=0.1)


def test_a_calibration_without_pixels_has_no_camera(tmp_path):
    calibration = calibrated()
    valid = np.zeros(SHAPE, bool)
    valid[:3, :3] = True
    few = replace(calibration, phase_height=replace(calibration.phase_height, valid=valid))
    with pytest.raises(InputError, match="too few"):
        write_camera(few, tmp_path / "camera.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ["yaml", "json", "xml"])
def test_no_name_breaks_the_file(tmp_path, ending):
    name = 'a"b: </x>&<script> {é} \\ #\n%YAML\x00\x1b'
    write_camera(calibrated(name=name), tmp_path / f"camera.{ending}")
    storage = opened(tmp_path / f"camera.{ending}")
    assert storage.getNode("camera_name").string() == name.replace("\n", "?").replace("\x00", "?").replace("\x1b", "?")
    assert storage.getNode("camera_matrix").mat()[0, 0] == pytest.approx(1134.0, rel=0.01)


def test_the_verb_writes_the_camera_of_a_calibration_and_of_nothing_else(tmp_path):
    calibrated().save(tmp_path / "cal.h5")
    export = ["export", str(tmp_path / "cal.h5"), "--out"]
    assert CliRunner().invoke(app, [*export, str(tmp_path / "camera.yaml")]).exit_code == 0
    xyz, pixels = points(calibrated())
    np.testing.assert_allclose(projected_by_opencv(tmp_path / "camera.yaml", xyz), pixels, atol=2e-3)
    (tmp_path / "cloud.ply").write_text("ply")
    for arguments in (
        [*export, str(tmp_path / "c.stl")],
        [*export, str(tmp_path / "c.json"), "--pitch-um", "3"],
        ["export", str(tmp_path / "cloud.ply"), "--out", str(tmp_path / "c.yaml")],
    ):
        assert CliRunner().invoke(app, arguments).exit_code != 0
    assert {path.name for path in tmp_path.iterdir()} == {"cal.h5", "camera.yaml", "cloud.ply"}
