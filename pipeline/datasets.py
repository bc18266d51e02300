"""Results as xarray Datasets: every array with its unit and its name in words."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from greenough.instrument.errors import InputError

if TYPE_CHECKING:
    from xarray import Dataset

    from .decode import PhaseMap
    from .point_cloud import PointCloud
    from .reconstruct import PointMap

_PIXEL = ("row", "col")
_PHASE_MAP = {
    "absolute": ("rad", "absolute phase of the densest fringes"),
    "modulation": ("DN", "modulation of the densest fringes"),
    "background": ("DN", "background above the black level"),
    "valid": ("1", "whether the phase is valid"),
    "residual": ("rad", "largest residual of the fringe order"),
    "sigma": ("rad", "standard deviation of the absolute phase by noise"),
}
_BRIGHTNESS = ("DN", "brightness of the pixel above the black level")
_CAUSES = {"noise": "noise", "calibration": "the calibration and drifts"}


def phase_map_dataset(phase_map: "PhaseMap") -> "Dataset":
    """The maps over row and col; raises InputError where xarray is not installed."""
    variables = {name: (_PIXEL, getattr(phase_map, name), unit, words) for name, (unit, words) in _PHASE_MAP.items()}
    pixels = _pixel_coordinates(phase_map.valid.shape)
    return _dataset(variables, pixels, {"title": "phase map", "exposures": phase_map.exposures})


def point_map_dataset(point_map: "PointMap") -> "Dataset":
    """x, y and z over row and col, with their standard uncertainties and brightness as far as these are known.

    NaN where there is no point. Raises InputError where xarray is not installed.
    """
    known = {"noise": point_map.noise_mm is not None, "calibration": point_map.uncertainty is not None}
    sigmas = {cause: getattr(point_map, f"sigma_{cause}") for cause, is_known in known.items() if is_known}
    variables = _points(_PIXEL, point_map.xyz, sigmas)
    if point_map.intensity is not None:
        variables["intensity"] = (_PIXEL, point_map.intensity, *_BRIGHTNESS)
    return _dataset(variables, _pixel_coordinates(point_map.valid.shape), {"title": "point map"})


def point_cloud_dataset(cloud: "PointCloud") -> "Dataset":
    """x, y and z over point, with row and col of the pixels that saw them and whatever else is known of each.

    The cloud's facts are the attributes. Raises InputError where xarray is not installed.
    """
    sigmas = {"noise": cloud.noise_mm, "calibration": cloud.calibration_mm}
    variables = _points(("point",), cloud.xyz, {cause: sd for cause, sd in sigmas.items() if sd is not None})
    if cloud.smooth is not None:
        variables["smooth"] = ("point", cloud.smooth, "1", "whether the surface is smooth over the optical resolution")
    if cloud.intensity is not None:
        variables["intensity"] = ("point", cloud.intensity, *_BRIGHTNESS)
    if cloud.normals is not None:
        for k, axis in enumerate("xyz"):
            variables[f"n{axis}"] = ("point", cloud.normals[:, k], "1", f"{axis} of the unit normal")
    pixels = {} if cloud.pixels is None else {name: cloud.pixels[:, k] for k, name in enumerate(_PIXEL)}
    coordinates = {name: ("point", of_points, "px", f"{name} of the camera") for name, of_points in pixels.items()}
    return _dataset(variables, coordinates, {"title": "point cloud", **cloud.facts})


def _points(dimensions: tuple[str, ...], xyz: np.ndarray, sigmas: Mapping[str, np.ndarray]) -> dict[str, tuple]:
    variables = {}
    for k, axis in enumerate("xyz"):
        variables[axis] = (dimensions, xyz[..., k], "mm", f"{axis} in the calibrated frame")
        for cause, sigma in sigmas.items():
            words = f"standard uncertainty of {axis} by {_CAUSES[cause]}"
            variables[f"sigma_{cause}_{axis}"] = (dimensions, sigma[..., k], "mm", words)
    return variables


def _pixel_coordinates(shape: tuple[int, ...]) -> dict[str, tuple]:
    return {
        name: (name, np.arange(size, dtype=np.int32), "px", f"{name} of the camera")
        for name, size in zip(_PIXEL, shape, strict=True)
    }


def _dataset(variables: Mapping[str, tuple], coordinates: Mapping[str, tuple], facts: Mapping[str, Any]) -> "Dataset":
    """Of entries (dimensions, array, unit, words)."""
    try:
        from xarray import Dataset
    except ImportError:
        raise InputError(
            "to_xarray needs xarray, which is not installed: pip install 'greenough[notebook]', or use the arrays of "
            "the object itself"
        ) from None

    def labelled(entries: Mapping[str, tuple]) -> dict[str, tuple]:
        return {
            name: (dimensions, values, {"units": unit, "long_name": words})
            for name, (dimensions, values, unit, words) in entries.items()
        }

    return Dataset(labelled(variables), labelled(coordinates), dict(facts))
