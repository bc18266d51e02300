"""The works whose cost grows with the sizes of a rig: settings that make these smaller or larger, and what is done."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import PhaseHeightFit, fit_phase_height
from greenough.pipeline.reconstruct import PointMap, reconstruct
from greenough.scenes.parts import Part

from ...plugins import FringeIntegrator
from ...renderer import dr, mi
from ...rig import open as open_twin
from ...rig import scene_dict
from ...scene import integrator_dict, specimen_dict
from ...settings import load_twin_file
from . import synthetic

FRINGES = {
    9: ((608.0, 80.0, 12.0), (3, 3, 3)),
    24: ((608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12)),
    48: ((608.0, 152.0, 40.0, 12.0), (8, 8, 8, 24)),
}
"""Periods and steps of sets with so many patterns."""

NOISE_DN = 2.0
PLANES_MM = 2.9
HALF_FIELD_MM = (6.2, 4.7)


def camera(rig_name: str, overrides: Sequence[str], share: float) -> list[str]:
    """Overrides that give the camera this share of its pixels and leave its field as it is."""
    rig_file, settings = load_twin_file(rig_name, overrides)
    scale = share**0.5
    rows, cols = (round(n * scale) for n in rig_file.camera.shape)
    focal_px = settings.optics.camera_focal_px * scale
    return [*overrides, f"camera.rows={rows}", f"camera.cols={cols}", f"twin.optics.camera_focal_px={focal_px!r}"]


def patterns(overrides: Sequence[str], count: int) -> list[str]:
    """Overrides for three or four sets of fringes with so many patterns together."""
    periods, steps = FRINGES[count]
    return [*overrides, f"procedure.periods_px={list(periods)}", f"procedure.steps={list(steps)}"]


def planes(overrides: Sequence[str], count: int) -> list[str]:
    """Overrides for so many planes over ``PLANES_MM``."""
    return [*overrides, f"procedure.planes={count}", f"procedure.plane_step_mm={PLANES_MM / (count - 1)!r}"]


def decoding(rig_name: str, overrides: Sequence[str]) -> Callable[[], PhaseMap]:
    """Frames of the rig's camera to phase."""
    rig_file = load_rig_file(rig_name, overrides)
    fringes = FringeSet(rig_file.procedure.periods_px, rig_file.procedure.steps)
    stack = synthetic.frames(fringes, rig_file.camera.shape, NOISE_DN)
    return lambda: decode(stack, fringes, rig_file.camera.noise)


def reconstruction(rig_name: str, overrides: Sequence[str]) -> Callable[[], PointMap]:
    """Frames of the rig's camera to points."""
    rig_file = load_rig_file(rig_name, overrides)
    calibration = synthetic.calibration(rig_file)
    stack = synthetic.frames(calibration.fringes, rig_file.camera.shape, NOISE_DN)
    return lambda: reconstruct(decode(stack, calibration.fringes, rig_file.camera.noise), calibration)


def fitting(rig_name: str, overrides: Sequence[str]) -> Callable[[], PhaseHeightFit]:
    """The relation of phase and height of all pixels to the planes of the rig's procedure."""
    rig_file = load_rig_file(rig_name, overrides)
    procedure = rig_file.procedure
    z_mm = (np.arange(procedure.planes) - (procedure.planes - 1) / 2) * procedure.plane_step_mm
    phases = synthetic.plane_phases(FringeSet(procedure.periods_px, procedure.steps), rig_file.camera.shape, z_mm)
    return lambda: fit_phase_height(phases, z_mm)


def rendering(
    rig_name: str, overrides: Sequence[str], triangles: int = 100_000, samples: int = 16
) -> Callable[[], list[mi.Float]]:
    """Direct light on a relief of so many triangles, in the fringes of the rig."""
    scene = loading(rig_name, [*overrides, f"twin.render.nodes={samples}", "twin.render.bounces=1"], triangles)()
    integrator, sensor = cast(FringeIntegrator, scene.integrator()), scene.sensors()[0]

    def work() -> list[mi.Float]:
        channels = integrator.render_channels(scene, sensor)
        dr.sync_thread()
        return channels

    return work


def loading(rig_name: str, overrides: Sequence[str], triangles: int) -> Callable[[], mi.Scene]:
    """A scene of a relief of so many triangles, with the structure in which rays find them."""
    rig, bench = open_twin(rig_name, overrides)
    settings = bench.settings.render
    scene = {name: part for name, part in scene_dict(rig, "plane").items() if not name.startswith("part_")}
    scene["integrator"] = integrator_dict(settings, flat=False)
    part = relief(triangles)
    return lambda: mi.load_dict(scene | specimen_dict([part], settings))


def relief(triangles: int) -> Part:
    """Waves of 0.1 mm over the camera's field, of about so many triangles that are all of one size seen from above."""
    half_x, half_y = HALF_FIELD_MM
    rows = round((triangles / 2 * half_y / half_x) ** 0.5)
    cols = round(triangles / 2 / rows)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, cols + 1), np.linspace(-half_y, half_y, rows + 1))
    vertices = np.stack([x, y, 0.1 * np.sin(2 * x) * np.sin(2 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows, dtype=np.int32)[:, None] * np.int32(cols + 1) + np.arange(cols, dtype=np.int32)).ravel()
    right, above, across = corner + 1, corner + cols + 1, corner + cols + 2
    faces = np.stack([corner, right, across, corner, across, above], axis=-1).reshape(-1, 3)
    return Part(vertices, faces, None, "ceramic")
