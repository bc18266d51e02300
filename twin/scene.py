"""The Mitsuba scene: both lens paths, the projector, the sensor, and the parts on the table with their materials."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from greenough.scenes.materials import MATERIALS, Diffuse, Material, RoughConductor
from greenough.scenes.parts import Part

from . import plugins  # noqa: F401  its import registers the plugins that the dictionaries below name
from .glass.as_built import AssembledPath, Tolerances, assemble
from .glass.placed import errors_to_json
from .glass.prescription import load_prescription
from .quadrature import nodes_of_direct_light
from .randomness import instrument_rng
from .renderer import mi
from .settings import AssemblySettings, OpticsSettings, RenderSettings, TwinSettings

NODES_FLAT = 16  # enough where nothing but the fringes changes within a pixel's blur


def axis_frame(angle: float, distance: float) -> np.ndarray:
    """``twin_from_path`` (4, 4) of a lens path whose axis leans by ``angle`` from z towards +x.

    Its origin is the pupil's centre at ``distance`` from the twin's origin; it looks along its +z, and its x and y run
    against the image's columns and rows, which is Mitsuba's convention. In the image +x is to the right and +y up.
    """
    backward = np.array([np.sin(angle), 0.0, np.cos(angle)])
    left = np.array([-np.cos(angle), 0.0, np.sin(angle)])
    frame = np.eye(4)
    frame[:3, :3] = np.stack([left, [0.0, 1.0, 0.0], -backward], axis=1)
    frame[:3, 3] = backward * distance
    return frame


def assembled(name: str, lean: float, sizes: AssemblySettings, seed: int) -> AssembledPath:
    """The path "camera" or "projector" of one instrument in glass, its axis meant to lean by ``lean`` towards +x."""
    tolerances = Tolerances(
        sizes.decentre_um * 1e-3,
        sizes.tilt_deg,
        sizes.image_tilt_deg,
        sizes.focus_um * 1e-3,
        sizes.axis_deg,
        sizes.pointing_um * 1e-3,
    )
    return _assembled(name, lean, tolerances, seed)


@lru_cache(maxsize=4)
def _assembled(name: str, lean: float, tolerances: Tolerances, seed: int) -> AssembledPath:
    return assemble(load_prescription(name), lean, tolerances, instrument_rng(seed, f"{name} path"))


def _lens(settings: TwinSettings, name: str) -> dict[str, Any]:
    """What a lens's plugin is told about where it stands and which glass it has."""
    optics = settings.optics
    lean = np.radians(optics.convergence_deg) / 2 * {"camera": -1, "projector": 1}[name]
    if not optics.glass:
        return {"to_world": mi.ScalarTransform4f(axis_frame(lean, optics.pupil_distance_mm))}
    built = assembled(name, float(lean), settings.assembly, settings.seed)
    return {
        "to_world": mi.ScalarTransform4f(built.twin_from_pupil),
        "prescription": name,
        "glass_errors": errors_to_json(built.errors),
    }


def camera_dict(settings: TwinSettings, shape: tuple[int, int]) -> dict[str, Any]:
    """The camera path as a ``lens_sensor``; ``shape`` is (rows, cols)."""
    optics = settings.optics
    distance = optics.pupil_distance_mm
    wavelength = optics.wavelength_um * 1e-3 if optics.camera_diffraction else 0.0
    film = {"type": "hdrfilm", "width": shape[1], "height": shape[0], "pixel_format": "luminance"}
    return {
        "type": "lens_sensor",
        **_lens(settings, "camera"),
        "focal_length_px": optics.camera_focal_px,
        "focus_distance": distance,
        "aperture_radius": optics.na * distance if optics.finite_aperture else 0.0,
        "diffraction_na": optics.na,
        "wavelength": wavelength,
        "film": film | {"component_format": "float32", "rfilter": {"type": "box"}},
    }


def projector_dict(settings: TwinSettings, patterns: np.ndarray, shift: np.ndarray | None = None) -> dict[str, Any]:
    """The projector path as a ``lens_projector`` that shows ``patterns``, (N, rows, cols) uint8, moved by ``shift``.

    The mirrors' band limit stays when the aperture is switched off: without it the lattice itself would be projected.
    """
    optics = settings.optics
    distance = optics.pupil_distance_mm
    return {
        "type": "lens_projector",
        **_lens(settings, "projector"),
        "wavelength_um": optics.wavelength_um,
        "bandwidth_um": settings.light.bandwidth_um if optics.glass else 0.0,
        "patterns": mi.TensorXf(patterns.astype(np.float32)),
        "pattern_shift": mi.TensorXf((np.zeros((len(patterns), 2)) if shift is None else shift).astype(np.float32)),
        "column_pitch": optics.column_pitch_um * 1e-3,
        "row_pitch": optics.row_pitch_um * 1e-3,
        "focus_distance": distance,
        "aperture_radius": optics.na * distance if optics.finite_aperture else 0.0,
        "diffraction_na": optics.na,
        "wavelength": optics.wavelength_um * 1e-3,
        "fill": optics.mirror_fill,
        "off_state": optics.off_state,
        "gamma": optics.gamma,
    }


def mirrors_passed(optics: OpticsSettings, motion: np.ndarray) -> np.ndarray:
    """Columns and rows, (N, 2), by which a point's place on the mirrors changes with its ``motion`` (N, 3), twin frame.

    To first order, on the axis: over the field it varies by 3 %.
    """
    frame = axis_frame(np.radians(optics.convergence_deg) / 2, optics.pupil_distance_mm)
    pitch = 1e-3 * np.array([optics.column_pitch_um, optics.row_pitch_um])
    return -motion @ frame[:3, :2] / pitch


def pixels_passed(optics: OpticsSettings, motion: np.ndarray) -> np.ndarray:
    """Columns and rows, (N, 2), by which a point's image moves with its ``motion`` (N, 3), as ``mirrors_passed``."""
    frame = axis_frame(-np.radians(optics.convergence_deg) / 2, optics.pupil_distance_mm)
    return -motion @ frame[:3, :2] * (optics.camera_focal_px / optics.pupil_distance_mm)


def specimen_dict(parts: Sequence[Part], render: RenderSettings) -> dict[str, mi.Mesh]:
    """The ``parts``, already in the twin's frame, as meshes with their materials."""
    return {f"part_{k}": _mesh(f"part_{k}", part, render.diffuse_only) for k, part in enumerate(parts)}


def integrator_dict(render: RenderSettings, flat: bool) -> dict[str, Any]:
    """The one-pass integrator for a specimen with or without relief."""
    if flat:  # it can neither light nor shade itself
        tables = {"node_table": _table(NODES_FLAT), "edge_table": _table(render.nodes_edges)}
        return {"type": "fringe", "bounces": 1, "shadows": False} | tables
    return {
        "type": "fringe",
        "node_table": _table(render.nodes),
        "nodes_indirect": render.nodes_indirect,
        "smoothing": render.smoothing_px,
        "bounces": render.bounces,
    }


def _table(count: int) -> mi.TensorXf:
    return mi.TensorXf(nodes_of_direct_light(count))


def _mesh(name: str, part: Part, diffuse_only: bool) -> mi.Mesh:
    """The one place where meshes are built: the next Mitsuba changes how."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(_bsdf(MATERIALS[part.material], diffuse_only))
    smooth = part.normals is not None
    props["face_normals"] = not smooth
    mesh = mi.Mesh(name, len(part.vertices), len(part.faces), props=props, has_vertex_normals=smooth)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(part.vertices.ravel().astype(np.float32))
    params["faces"] = mi.UInt32(part.faces.ravel().astype(np.uint32))
    if part.normals is not None:
        params["vertex_normals"] = mi.Float(part.normals.ravel().astype(np.float32))
    params.update()
    return mesh


def _bsdf(material: Material, diffuse_only: bool) -> dict[str, Any]:
    if diffuse_only or isinstance(material, Diffuse):
        return {"type": "diffuse", "reflectance": material.reflectance}
    if isinstance(material, RoughConductor):
        return {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": material.alpha,
            "specular_reflectance": material.reflectance,
        }
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": material.alpha,
        "int_ior": material.ior,
        "diffuse_reflectance": material.reflectance,
    }
