from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.projector_model import ProjectorModel
from greenough.pipeline.rays import Rays

IDENTITY = RigIdentity("bench 3", "camera 17", "projector 4", "ab" * 32)


def some_calibration(rows=12, cols=16, method="paper"):
    rng = np.random.default_rng(1)
    valid = rng.random((rows, cols)) < 0.9
    camera = CameraModel(22683.0, 22690.0, -0.9, 633.0, 520.0, -0.09, 0.02, 1e-3, -2e-3, (rows, cols))
    camera_from_world = np.vstack([np.hstack([np.diag([1.0, -1, -1]), [[0.1], [0.2], [224.0]]]), [0, 0, 0, 1]])
    field = DepthField((0.01, -0.02), (0.03, 0.04), (1, 2), (0, 1), 1.5)
    instrument = InstrumentModel(
        ImagingPath(camera, camera_from_world, field, rng.normal(size=(2, 8))),
        ProjectorModel(rng.normal(size=7), field, rng.normal(size=8)),
        rng.normal(size=(30, 30)),
    )
    return Calibration(
        method=method,
        camera=camera,
        camera_from_world=camera_from_world,
        rays=Rays(*rng.normal(size=(2, rows, cols, 2)).astype(np.float32)),
        phase_height=PhaseHeight(
            coefficients=rng.normal(size=(rows, cols, 4)).astype(np.float32),
            phase_centre=rng.normal(size=(rows, cols)).astype(np.float32),
            phase_half_range=rng.uniform(8, 9, size=(rows, cols)).astype(np.float32),
            z_range=np.tile(np.float32([-1.45, 1.45]), (rows, cols, 1)),
            valid=valid,
        ),
        identity=IDENTITY,
        board=SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5))),
        procedure=Procedure((608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12), 16, 30, 0.1, 0.8, (4.0, 1.0)),
        known=KnownUncertainty(3e-5, 5e-4, 5e-5),
        run="monday",
        exposures=1104,
        figures={"reprojection_rmse_u_px": 0.07, "postures_without_board": (3,)},
        residuals=Residuals(
            centres_px=rng.normal(size=(7, 99, 2)),
            spots_px=rng.normal(size=(7, 99, 2)),
            spot_phases_rad=rng.normal(size=(7, 99)),
            planes_um=rng.normal(size=(30, 3, 4)).astype(np.float32),
            pixels_um=rng.normal(size=(rows, cols)).astype(np.float32),
        ),
        uncertainty=CalibrationUncertainty(
            heights_mm=np.array([-1.45, 0.0, 1.45]),
            grid_v_px=np.array([0.0, rows - 1.0]),
            grid_u_px=np.array([0.0, cols - 1.0]),
            modes_mm=rng.normal(size=(5, 3, 2, 2, 3)).astype(np.float32),
            pattern_sd_mm=rng.uniform(size=3),
        ),
        instrument=instrument if method == "bundle" else None,
    )


def arrays(calibration, group):
    """The arrays of one part of a calibration by name."""
    part = getattr(calibration, group)
    return {field.name: getattr(part, field.name) for field in fields(part)}


@pytest.mark.parametrize("method", ["paper", "bundle"])
def test_a_calibration_comes_back_whole(tmp_path, method):
    calibration = some_calibration(method=method)
    calibration.save(tmp_path / "cal.h5")
    back = Calibration.load(tmp_path / "cal.h5")
    for name in ("method", "camera", "identity", "board", "procedure", "known", "run", "exposures", "figures"):
        assert getattr(back, name) == getattr(calibration, name)
    np.testing.assert_array_equal(back.camera_from_world, calibration.camera_from_world)
    for group in ("rays", "phase_height", "residuals", "uncertainty"):
        for name, original in arrays(calibration, group).items():
            stored = arrays(back, group)[name]
            np.testing.assert_array_equal(stored, original)
            assert stored.dtype == original.dtype


def test_the_bundles_model_and_its_covariance_come_back(tmp_path):
    instrument = some_calibration(method="bundle").instrument
    some_calibration(method="bundle").save(tmp_path / "cal.h5")
    back = Calibration.load(tmp_path / "cal.h5").instrument
    xyz = np.random.default_rng(2).uniform(-2, 2, (50, 3))
    np.testing.assert_array_equal(back.camera.project(xyz), instrument.camera.project(xyz))
    np.testing.assert_array_equal(back.projector.phase(xyz), instrument.projector.phase(xyz))
    np.testing.assert_array_equal(back.covariance, instrument.covariance)
    assert Calibration.load(tmp_path / "cal.h5").camera == instrument.camera.camera


def test_a_file_of_the_version_before_is_refused_in_one_sentence(tmp_path):
    some_calibration().save(tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5", "r+") as file:
        file.attrs["version"] = 2
    with pytest.raises(
        InputError, match=r"old\.h5 is a greenough calibration of version 2; this program reads version 3"
    ):
        Calibration.load(tmp_path / "old.h5")


def test_every_array_in_the_file_states_its_unit(tmp_path):
    some_calibration(method="bundle").save(tmp_path / "cal.h5")
    found = []
    with h5py.File(tmp_path / "cal.h5") as file:
        file.visititems(lambda name, item: found.append("units" in item.attrs) if hasattr(item, "shape") else None)
    assert len(found) > 15
    assert all(found)


def test_saving_leaves_nothing_else_in_the_folder(tmp_path):
    some_calibration().save(tmp_path / "cal.h5")
    some_calibration().save(tmp_path / "cal.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["cal.h5"]


@settings(max_examples=40)
@given(share=st.floats(0, 0.999))
def test_a_truncated_file_is_refused_wherever_it_was_cut(tmp_path_factory, share):
    path = tmp_path_factory.mktemp("cut") / "cal.h5"
    some_calibration().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cal\.h5"):
        Calibration.load(path)


@settings(max_examples=40)
@given(pixel=st.integers(0, 12 * 16 - 1), bit=st.integers(0, 31))
def test_a_flipped_bit_in_an_array_is_noticed(tmp_path_factory, pixel, bit):
    path = tmp_path_factory.mktemp("flip") / "cal.h5"
    some_calibration().save(path)
    with h5py.File(path, "r+") as file:
        values = file["phase_height/phase_centre"][()]
        values.view(np.uint32).ravel()[pixel] ^= np.uint32(1 << bit)
        file["phase_height/phase_centre"][()] = values
    with pytest.raises(InputError, match="checksum of phase_height/phase_centre"):
        Calibration.load(path)


def test_a_changed_number_in_the_document_is_noticed(tmp_path):
    path = tmp_path / "cal.h5"
    some_calibration().save(path)
    with h5py.File(path, "r+") as file:
        text = file["document"][()].tobytes().replace(b"22683", b"22684")
        file["document"][()] = np.frombuffer(text, np.uint8)
    with pytest.raises(InputError, match="checksum of document"):
        Calibration.load(path)


def test_foreign_files_are_refused_by_what_they_are(tmp_path):
    with pytest.raises(InputError, match="there is no greenough calibration"):
        Calibration.load(tmp_path / "missing.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="not a greenough calibration: it is not HDF5"):
        Calibration.load(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["image"] = np.zeros(3)
    with pytest.raises(InputError, match="not a greenough calibration"):
        Calibration.load(tmp_path / "other.h5")
    some_calibration().save(tmp_path / "future.h5")
    with h5py.File(tmp_path / "future.h5", "r+") as file:
        file.attrs["version"] = 99
    with pytest.raises(InputError, match="version 99; this program reads version 3"):
        Calibration.load(tmp_path / "future.h5")


def test_another_camera_size_is_refused_with_both_sizes():
    with pytest.raises(InputError, match="camera of 16 x 12 pixels, the picture has 20 x 10"):
        some_calibration().check_fits(IDENTITY, (10, 20))


@pytest.mark.parametrize("what", ["name", "camera_serial", "projector_serial"])
def test_another_rig_is_refused_with_what_differs(what):
    with pytest.raises(InputError, match=f"{what.replace('_', ' ')} is .* this rig's is 'other'"):
        some_calibration().check_fits(replace(IDENTITY, **{what: "other"}), (12, 16))


def test_other_settings_of_the_same_rig_are_no_reason_to_refuse():
    some_calibration().check_fits(replace(IDENTITY, settings_sha256="cd" * 32), (12, 16))
