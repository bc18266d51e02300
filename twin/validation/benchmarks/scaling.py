"""How time and memory grow with pixels, patterns, planes, triangles and samples.

Run as a module it is the process in which the memory of one step is measured.
"""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...renderer import dr
from .peak_memory import peak_mb
from .rows import Row, interleaved, limited
from .sized_works import FRINGES, camera, decoding, fitting, loading, patterns, planes, reconstruction, rendering

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


def _peak_in_child(series: Series, size: int, rig_name: str, overrides: Sequence[str]) -> float:
    arguments = [str(SERIES.index(series)), str(size), rig_name, *overrides]
    done = subprocess.run([sys.executable, "-m", __name__, *arguments], check=True, stdout=subprocess.PIPE)
    return float(done.stdout)


PIXELS = (1, 4, 16)
"""Of a quarter of the camera's own: x4 is the rig's camera."""

PLANES = (10, 30, 100)
TRIANGLES = (10_000, 100_000, 1_000_000, 10_000_000)
SAMPLES = (16, 64, 256)

_QUARTER = 1 / 4


def _pixels(step: str, repeats: int, work: Callable[[str, Sequence[str]], Work]) -> Series:
    return Series(
        step,
        "pixels",
        PIXELS,
        LINEAR,
        repeats,
        lambda rig, overrides, size: work(rig, camera(rig, overrides, _QUARTER * size)),
    )


def _decoded_patterns(rig: str, overrides: Sequence[str], size: int) -> Work:
    return decoding(rig, patterns(overrides, size))


def _rendered_patterns(rig: str, overrides: Sequence[str], size: int) -> Work:
    return rendering(rig, patterns(camera(rig, overrides, _QUARTER), size))


def _fitted_planes(rig: str, overrides: Sequence[str], size: int) -> Work:
    return fitting(rig, planes(camera(rig, overrides, _QUARTER), size))


def _rendered_triangles(rig: str, overrides: Sequence[str], size: int) -> Work:
    return rendering(rig, camera(rig, overrides, _QUARTER), triangles=size)


def _rendered_samples(rig: str, overrides: Sequence[str], size: int) -> Work:
    return rendering(rig, camera(rig, overrides, _QUARTER / 4), samples=size)


SERIES = (
    _pixels("decode", 15, decoding),
    _pixels("frames to points", 15, reconstruction),
    _pixels("fit", 3, fitting),
    _pixels("render", 3, rendering),
    Series("decode", "patterns", tuple(FRINGES), LINEAR, 15, _decoded_patterns),
    Series("render", "patterns", tuple(FRINGES), LINEAR, 3, _rendered_patterns),
    Series("fit", "planes", PLANES, LINEAR, 3, _fitted_planes),
    Series("load a mesh", "triangles", TRIANGLES, None, 1, loading),
    Series("render", "triangles", TRIANGLES, SUBLINEAR, 3, _rendered_triangles),
    Series("render", "samples", SAMPLES, None, 3, _rendered_samples),
)

if __name__ == "__main__":
    number, size, rig_name, *overrides = sys.argv[1:]
    print(peak_mb(SERIES[int(number)].prepare(rig_name, overrides, int(size))))
