"""How time and memory grow with pixels, patterns, planes, triangles and samples.

Run as a module it is the process in which the memory of one step is measured.
"""

import gc
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline import FringeSet, decode, reconstruct
from greenough.pipeline.phase_height import fit_phase_height
from greenough.scenes.parts import Part

from ...plugins import FringeIntegrator
from ...renderer import dr, mi
from ...rig import open as open_twin
from ...rig import scene_dict
from ...scene import integrator_dict, specimen_dict
from ...settings import load_twin_file
from . import synthetic
from .rows import Row, interleaved, limited

LINEAR = 1.05
"""Most that the exponent of what should grow linearly may be."""

SUBLINEAR = 1.0

Work = Callable[[], object]
Prepare = Callable[[str, Sequence[str], int], Work]


@dataclass(frozen=True)
class Series:
    """One step at several sizes.

    Parameters
    ----------
    step, of : str
        What is done, and what of it grows.
    sizes : tuple of int
    limit : float or None
        Of the exponent.
    repeats : int
    prepare : callable
        Makes the work of one size for a rig of that name with these overrides.
    """

    step: str
    of: str
    sizes: tuple[int, ...]
    limit: float | None
    repeats: int
    prepare: Prepare

    def name(self, size: int) -> str:
        """Of the row of one size."""
        return f"{self.step}, {'x' if self.of == 'pixels' else ''}{size} {self.of}"

    @property
    def exponent_name(self) -> str:
        """Of the row of the exponent."""
        return f"{self.step}, exponent of time in {self.of}"


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """k of times that go with sizes to the power of k: the slope of a straight line through their logarithms."""
    return float(np.polynomial.Polynomial.fit(np.log(sizes), np.log(times), 1).convert().coef[1])


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Time and peak memory of every size of every series, and their exponents."""
    return [row for series in SERIES for row in series_rows(series, rig_name, overrides)]


def series_rows(series: Series, rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Times, which take turns, then peaks of memory, each in a process of its own, then the exponent of the times."""
    works = {series.name(size): series.prepare(rig_name, overrides, size) for size in series.sizes}
    times = interleaved(works, series.repeats)
    works.clear()
    dr.flush_malloc_cache()
    first, least = next(iter(times.items()))
    result = [Row(name, seconds, "s", first, seconds / least) for name, seconds in times.items()]
    for size in series.sizes:
        name = f"{series.name(size)}, peak memory"
        result.append(Row(name, _peak_in_child(series, size, rig_name, overrides), "MB"))
    slope = exponent(series.sizes, list(times.values()))
    if series.limit is None:
        return [*result, Row(series.exponent_name, slope, "1")]
    return [*result, limited(series.exponent_name, slope, "1", None, None, series.limit)]


def peak_mb(work: Work) -> float:
    """How far a piece of work raises this process's resident memory above where it was before, 1e6 bytes.

    What it works on must be there already; its result counts.
    """
    gc.collect()
    dr.flush_malloc_cache()
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status_kb("VmRSS")
    result = work()
    peak = _status_kb("VmHWM")
    del result
    return 1024e-6 * (peak - before)


def _status_kb(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(f"{field}:")).split()[1])


def _peak_in_child(series: Series, size: int, rig_name: str, overrides: Sequence[str]) -> float:
    arguments = [str(SERIES.index(series)), str(size), rig_name, *overrides]
    done = subprocess.run([sys.executable, "-m", __name__, *arguments], check=True, stdout=subprocess.PIPE)
    return float(done.stdout)


def _camera(rig_name: str, overrides: Sequence[str], share: float) -> list[str]:
    """Overrides that give the camera this share of its pixels and leave its field as it is."""
    rig_file, settings = load_twin_file(rig_name, overrides)
    scale = share**0.5
    rows, cols = (round(n * scale) for n in rig_file.camera.shape)
    focal_px = settings.optics.camera_focal_px * scale
    return [*overrides, f"camera.rows={rows}", f"camera.cols={cols}", f"twin.optics.camera_focal_px={focal_px!r}"]


def _patterns(overrides: Sequence[str], count: int) -> list[str]:
    """Overrides for three or four sets of fringes with so many patterns together."""
    periods, steps = FRINGES[count]
    return [*overrides, f"procedure.periods_px={list(periods)}", f"procedure.steps={list(steps)}"]


def _planes(overrides: Sequence[str], count: int) -> list[str]:
    """Overrides for so many planes over 2.9 mm."""
    return [*overrides, f"procedure.planes={count}", f"procedure.plane_step_mm={2.9 / (count - 1)!r}"]


def _decoding(rig_name: str, overrides: Sequence[str]) -> Work:
    rig_file = load_rig_file(rig_name, overrides)
    fringes = FringeSet(rig_file.procedure.periods_px, rig_file.procedure.steps)
    stack = synthetic.frames(fringes, rig_file.camera.shape, NOISE_DN)
    return lambda: decode(stack, fringes, rig_file.camera.noise)


def _reconstruction(rig_name: str, overrides: Sequence[str]) -> Work:
    rig_file = load_rig_file(rig_name, overrides)
    calibration = synthetic.calibration(rig_file)
    stack = synthetic.frames(calibration.fringes, rig_file.camera.shape, NOISE_DN)
    return lambda: reconstruct(decode(stack, calibration.fringes, rig_file.camera.noise), calibration)


def _fit(rig_name: str, overrides: Sequence[str]) -> Work:
    rig_file = load_rig_file(rig_name, overrides)
    procedure = rig_file.procedure
    z_mm = (np.arange(procedure.planes) - (procedure.planes - 1) / 2) * procedure.plane_step_mm
    phases = synthetic.plane_phases(FringeSet(procedure.periods_px, procedure.steps), rig_file.camera.shape, z_mm)
    return lambda: fit_phase_height(phases, z_mm)


def _rendering(rig_name: str, overrides: Sequence[str], triangles: int = 100_000, samples: int = 16) -> Work:
    """Direct light on a relief of so many triangles, in the fringes of the rig."""
    scene = _loading(rig_name, [*overrides, f"twin.render.nodes={samples}", "twin.render.bounces=1"], triangles)()
    integrator, sensor = cast(FringeIntegrator, scene.integrator()), scene.sensors()[0]

    def work() -> list[mi.Float]:
        channels = integrator.render_channels(scene, sensor)
        dr.sync_thread()
        return channels

    return work


def _loading(rig_name: str, overrides: Sequence[str], triangles: int) -> Callable[[], mi.Scene]:
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


PIXELS = (1, 4, 16)
"""Of a quarter of the camera's own: x4 is the rig's camera."""

QUARTER = 1 / 4
TRIANGLES = (10_000, 100_000, 1_000_000, 10_000_000)

FRINGES = {
    9: ((608.0, 80.0, 12.0), (3, 3, 3)),
    24: ((608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12)),
    48: ((608.0, 152.0, 40.0, 12.0), (8, 8, 8, 24)),
}
"""Periods and steps of sets with so many patterns."""

NOISE_DN = 2.0
HALF_FIELD_MM = (6.2, 4.7)


def _pixels(work: Callable[[str, Sequence[str]], Work]) -> Prepare:
    return lambda rig, overrides, size: work(rig, _camera(rig, overrides, QUARTER * size))


SERIES = (
    Series("decode", "pixels", PIXELS, LINEAR, 15, _pixels(_decoding)),
    Series("frames to points", "pixels", PIXELS, LINEAR, 15, _pixels(_reconstruction)),
    Series("fit", "pixels", PIXELS, LINEAR, 3, _pixels(_fit)),
    Series("render", "pixels", PIXELS, LINEAR, 3, _pixels(_rendering)),
    Series(
        "decode",
        "patterns",
        tuple(FRINGES),
        LINEAR,
        15,
        lambda rig, overrides, size: _decoding(rig, _patterns(overrides, size)),
    ),
    Series(
        "render",
        "patterns",
        tuple(FRINGES),
        LINEAR,
        3,
        lambda rig, overrides, size: _rendering(rig, _patterns(_camera(rig, overrides, QUARTER), size)),
    ),
    Series(
        "fit",
        "planes",
        (10, 30, 100),
        LINEAR,
        3,
        lambda rig, overrides, size: _fit(rig, _planes(_camera(rig, overrides, QUARTER), size)),
    ),
    Series("load a mesh", "triangles", TRIANGLES, None, 1, _loading),
    Series(
        "render",
        "triangles",
        TRIANGLES,
        SUBLINEAR,
        3,
        lambda rig, overrides, size: _rendering(rig, _camera(rig, overrides, QUARTER), triangles=size),
    ),
    Series(
        "render",
        "samples",
        (16, 64, 256),
        None,
        3,
        lambda rig, overrides, size: _rendering(rig, _camera(rig, overrides, QUARTER / 4), samples=size),
    ),
)

if __name__ == "__main__":
    number, size, rig_name, *overrides = sys.argv[1:]
    print(peak_mb(SERIES[int(number)].prepare(rig_name, overrides, int(size))))
