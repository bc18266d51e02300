"""Results as xarray Datasets: the same numbers, each with its unit."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import xarray

from greenough.instrument.errors import InputError
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import PAPER
from greenough.pipeline.point_cloud import PointCloud
from greenough.pipeline.reconstruct import PointMap
from small_calibration import SHAPE, small_uncertainty

UNITS = {"mm", "rad", "DN", "px", "1"}


def point_map():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    xyz = np.stack([0.01 * u, -0.01 * v, 0.1 * u], axis=-1)
    xyz[1, 2] = np.nan
    return PointMap(xyz, np.full((*SHAPE, 3), -2e-3, np.float32), small_uncertainty(sigma_z_mm=5e-4))


def check_labels(dataset):
    for name, variable in dataset.variables.items():
        assert variable.attrs["units"] in UNITS, name
        assert variable.attrs["long_name"], name


def test_a_phase_map_keeps_its_arrays():
    found = decode(np.ascontiguousarray(PAPER.patterns(6, 608) // 2), PAPER)
    dataset = found.to_xarray()
    check_labels(dataset)
    assert dataset.sizes == {"row": 6, "col": 608}
    for name in ("absolute", "modulation", "background", "valid", "residual", "sigma"):
        np.testing.assert_array_equal(dataset[name], getattr(found, name))
    assert dataset.absolute.attrs["units"] == "rad"
    assert dataset.modulation.attrs["units"] == "DN"
    assert float(dataset.absolute.sel(row=3, col=300)) == found.absolute[3, 300]


def test_a_point_map_has_points_and_both_uncertainties_in_mm():
    points = point_map()
    dataset = points.to_xarray()
    check_labels(dataset)
    for k, axis in enumerate("xyz"):
        np.testing.assert_array_equal(dataset[axis], points.xyz[..., k])
        np.testing.assert_array_equal(dataset[f"sigma_noise_{axis}"], points.sigma_noise[..., k])
        np.testing.assert_array_equal(dataset[f"sigma_calibration_{axis}"], points.sigma_calibration[..., k])
        assert dataset[axis].attrs["units"] == "mm"
    assert float(dataset.sigma_calibration_z.sel(row=0, col=1)) == pytest.approx(5e-4)


def test_what_is_not_known_is_not_there():
    assert set(PointMap(np.zeros((2, 3, 3))).to_xarray()) == {"x", "y", "z"}
    assert set(PointCloud(np.zeros((2, 3))).to_xarray().variables) == {"x", "y", "z"}


def test_a_cloud_has_pixels_for_coordinates_and_its_facts_for_attributes():
    points = point_map()
    cloud = PointCloud.from_point_map(points, np.ones(SHAPE, bool), {"sample": "coin"})
    dataset = cloud.to_xarray()
    check_labels(dataset)
    assert dataset.sizes == {"point": 11}
    assert set(dataset.coords) == {"row", "col"}
    seen = dataset.where((dataset.row == 2) & (dataset.col == 3), drop=True)
    assert float(seen.z[0]) == points.xyz[2, 3, 2]
    assert dataset.attrs["sample"] == "coin"
    assert bool(dataset.smooth.all())


def test_brightness_and_normals_are_there_as_far_as_known():
    light = np.arange(12, dtype=np.float32).reshape(SHAPE)
    dataset = replace(point_map(), intensity=light).to_xarray()
    check_labels(dataset)
    np.testing.assert_array_equal(dataset.intensity, light)
    normals = np.array([[0, 0, 1], [0.6, 0, 0.8]], np.float32)
    dataset = PointCloud(np.zeros((2, 3)), intensity=light[0, :2], normals=normals).to_xarray()
    check_labels(dataset)
    np.testing.assert_array_equal(dataset.intensity, light[0, :2])
    np.testing.assert_array_equal(np.stack([dataset.nx, dataset.ny, dataset.nz], axis=-1), normals)
    assert dataset.intensity.attrs["units"] == "DN"


def test_netcdf_takes_every_dataset_and_gives_it_back(tmp_path):
    phase_map = decode(np.ascontiguousarray(PAPER.patterns(6, 608) // 2), PAPER)
    for result in (phase_map, point_map(), PointCloud.from_point_map(point_map(), facts={"sample": "coin"})):
        dataset = result.to_xarray()
        dataset.to_netcdf(tmp_path / "result.nc", engine="scipy")
        with xarray.open_dataset(tmp_path / "result.nc", engine="scipy") as read:
            xarray.testing.assert_equal(read.load(), dataset)
            check_labels(read)


def test_without_xarray_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(InputError, match=r"needs xarray, .*pip install 'greenough\[notebook\]'"):
        point_map().to_xarray()
