"""A camera file is what OpenCV takes for a camera: it projects as ours does, and says where it cannot."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
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


def points():
    return np.random.default_rng(2).uniform([-6, -4, -1.5], [6, 4, 1.5], (300, 3))


def projected_by_us(calibration, xyz):
    camera_from_world = calibration.camera_from_world
    return calibration.camera.project(xyz @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])


@pytest.mark.parametrize("ending", ["yaml", "yml", "json", "xml"])
def test_opencv_projects_with_the_file_as_we_do(tmp_path, ending):
    calibration = calibrated()
    write_camera(calibration, tmp_path / f"camera.{ending}")
    np.testing.assert_allclose(
        projected_by_opencv(tmp_path / f"camera.{ending}", points()), projected_by_us(calibration, points()), atol=1e-8
    )
    storage = opened(tmp_path / f"camera.{ending}")
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (64, 48)
    assert storage.getNode("avg_reprojection_error").real() == pytest.approx(0.05)
    assert storage.getNode("skew_left_out_px").real() == 0
    assert storage.getNode("rays_off_max_px").real() < 1e-3  # single precision of the rays
    assert storage.getNode("camera_serial").string() == "camera 17"


def test_the_file_says_how_much_opencv_leaves_out_with_the_skew(tmp_path):
    calibration = calibrated(skew=-5.0)
    write_camera(calibration, tmp_path / "camera.yaml")
    storage = opened(tmp_path / "camera.yaml")
    says = storage.getNode("skew_left_out_px").real()
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    z = np.zeros(SHAPE)
    xyz = calibration.rays.points(z).reshape(-1, 3)
    off = projected_by_opencv(tmp_path / "camera.yaml", xyz) - np.stack([u, v], axis=-1).reshape(-1, 2)
    assert np.abs(off).max() == pytest.approx(says, rel=0.01)
    assert says > 0.05
    assert storage.getNode("camera_matrix").mat()[0, 1] == -5.0


def test_the_file_says_how_far_the_rays_of_points_are_from_its_camera(tmp_path):
    calibration = calibrated()
    moved = replace(calibration, rays=replace(calibration.rays, origin=calibration.rays.origin + np.float32(0.02)))
    write_camera(moved, tmp_path / "camera.yaml")
    storage = opened(tmp_path / "camera.yaml")
    says = storage.getNode("rays_off_rms_px").real()
    xyz = points()
    shift = projected_by_us(calibration, xyz + np.array([0.02, 0.02, 0])) - projected_by_us(calibration, xyz)
    assert says == pytest.approx(np.sqrt(np.mean(np.sum(shift**2, axis=1))), rel=0.02)


@pytest.mark.parametrize("ending", ["yaml", "json", "xml"])
def test_no_name_breaks_the_file(tmp_path, ending):
    name = 'a"b: </x>&<script> {é} \\ #\n%YAML\x00\x1b'
    write_camera(calibrated(name=name), tmp_path / f"camera.{ending}")
    storage = opened(tmp_path / f"camera.{ending}")
    assert storage.getNode("camera_name").string() == name.replace("\n", "?").replace("\x00", "?").replace("\x1b", "?")
    assert storage.getNode("camera_matrix").mat()[0, 0] == 1134.0


def test_the_verb_writes_the_camera_of_a_calibration_and_of_nothing_else(tmp_path):
    calibrated().save(tmp_path / "cal.h5")
    export = ["export", str(tmp_path / "cal.h5"), "--out"]
    assert CliRunner().invoke(app, [*export, str(tmp_path / "camera.yaml")]).exit_code == 0
    assert len(projected_by_opencv(tmp_path / "camera.yaml", points())) == 300
    (tmp_path / "cloud.ply").write_text("ply")
    for arguments in (
        [*export, str(tmp_path / "c.stl")],
        [*export, str(tmp_path / "c.json"), "--pitch-um", "3"],
        ["export", str(tmp_path / "cloud.ply"), "--out", str(tmp_path / "c.yaml")],
    ):
        assert CliRunner().invoke(app, arguments).exit_code != 0
    assert {path.name for path in tmp_path.iterdir()} == {"cal.h5", "camera.yaml", "cloud.ply"}
