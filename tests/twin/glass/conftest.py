"""Both paths, as designed and as built, and the same lenses in optiland, a peer that shares no code with us."""

import warnings
from collections.abc import Callable

import numpy as np
import pytest

from greenough.twin.glass.as_built import Tolerances, draw_path_errors
from greenough.twin.glass.placed import PlacedPath, place
from greenough.twin.glass.prescription import load_prescription
from peers import need_module


@pytest.fixture(scope="session", params=["camera", "projector"])
def designed(request: pytest.FixtureRequest) -> PlacedPath:
    return place(load_prescription(request.param))


@pytest.fixture(scope="session", params=["camera", "projector"])
def built(request: pytest.FixtureRequest) -> PlacedPath:
    """A path with errors three times the usual ones."""
    prescription = load_prescription(request.param)
    tolerances = Tolerances(decentre_mm=0.09, tilt_deg=0.15, image_tilt_deg=0.9)
    return place(prescription, draw_path_errors(prescription, tolerances, np.random.default_rng(5)))


@pytest.fixture(scope="session")
def optiland_trace() -> Callable[[PlacedPath, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]:
    """Traces rays from the specimen: points in the image's plane (n, 2) and directions before it (n, 3).

    Skips, or fails, where optiland is not installed: see ``peers.need_module``.
    optiland reads radii, distances, apertures and names of glasses; the indices are those of its own catalogue.
    """
    need_module("optiland")
    from numba import NumbaWarning
    from optiland.materials import Material
    from optiland.optic import Optic
    from optiland.rays import RealRays

    def traced(path: PlacedPath, points: np.ndarray, directions: np.ndarray, wavelength_um: float):
        lens = Optic()
        lens.surfaces.add(index=0, z=-1.0)
        for k, surface in enumerate(path.surfaces, 1):
            x, y, z = surface.vertex
            lens.surfaces.add(
                index=k,
                radius=1 / surface.curvature if surface.curvature else np.inf,
                material="air" if surface.glass_behind == "air" else Material(surface.glass_behind, "schott"),
                is_stop=k - 1 == path.prescription.stop,
                x=x, y=y, z=z,
                rx=-np.arcsin(surface.axis[1]), ry=np.arctan2(surface.axis[0], surface.axis[2]),
            )  # fmt: skip
        normal = path.image.normal
        x, y, z = path.image.centre
        lens.surfaces.add(
            index=len(path.surfaces) + 1, x=x, y=y, z=z, rx=-np.arcsin(normal[1]), ry=np.arctan2(normal[0], normal[2])
        )
        n = len(points)
        rays = RealRays(*points.T, *directions.T, np.ones(n), np.full(n, wavelength_um))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumbaWarning)  # of numba about itself, while it compiles optiland
            lens.surfaces.trace(rays)
        met = np.stack([rays.x, rays.y, rays.z], axis=1) - path.image.centre
        return met @ np.transpose([path.image.along_x, path.image.along_y]), np.stack([rays.L, rays.M, rays.N], axis=1)

    return traced
