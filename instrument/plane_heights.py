"""How high somebody's planes lay: as listed, as a file says, or as their names do."""

import csv
import math
from itertools import pairwise
from pathlib import Path

from .errors import InputError
from .image_rig_settings import ImagesSection


def plane_heights(images: ImagesSection, names: list[str], folder: Path) -> dict[str, float]:
    """Height of each plane, mm, from the lowest up.

    Parameters
    ----------
    images : ImagesSection
    names : list of str
        What stands for ``{}``, in natural order.
    folder : Path
        Of the rig file.

    Raises
    ------
    InputError
        If a plane has no height or two have the same, or the list neither rises nor falls throughout.
    """
    if images.heights_mm is not None:
        heights = _listed_heights(images.heights_mm, names)
    elif images.heights_file is not None:
        path = folder / images.heights_file
        stated = _read_heights(path)
        missing = [name for name in names if name not in stated]
        if missing:
            raise InputError(f"heights {path}: there is none for the plane {missing[0]}")
        heights = {name: stated[name] for name in names}
    else:
        heights = {name: (_number(name) - images.plane_zero) * (images.plane_step_mm or 0.0) for name in names}
    rising = sorted(heights, key=heights.__getitem__)
    for one, other in pairwise(rising):
        if heights[other] - heights[one] < 1e-6:
            raise InputError(f"the planes {one} and {other} have the same height, {heights[one]:g} mm")
    return {name: heights[name] for name in rising}


def _listed_heights(heights_mm: tuple[float, ...], names: list[str]) -> dict[str, float]:
    if len(heights_mm) != len(names):
        raise InputError(
            f"images.heights_mm lists {len(heights_mm)} heights, but images.planes matches {len(names)} planes, "
            f"{names[0]} to {names[-1]}"
        )
    rises = heights_mm[-1] > heights_mm[0]
    for one, other in pairwise(heights_mm):
        if one == other or (other > one) != rises:
            raise InputError(
                f"images.heights_mm must rise, or fall, from plane to plane, but {one:g} is followed by {other:g}: "
                "give the heights in the order of the planes' names"
            )
    return dict(zip(names, heights_mm, strict=True))


def _number(name: str) -> float:
    try:
        number = float(name)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(
            f"images.plane_step_mm: the plane {name} is not called by a number; change images.planes so that {{}} "
            "stands for the number alone, or give images.heights_mm"
        )
    return number


def _read_heights(path: Path) -> dict[str, float]:
    """Of a CSV file of names and heights; a first line that holds no number is a heading."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row, _ in zip(csv.reader(file), range(10_000), strict=False) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"heights {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    heights: dict[str, float] = {}
    for line, row in enumerate(rows, 1):
        try:
            name, height = row[0].strip(), float(row[1])
        except (IndexError, ValueError):
            if line == 1:
                continue
            height = math.nan
        if len(row) != 2 or not abs(height) <= 1000 or name in heights:
            raise InputError(
                f"heights {path}, line {line}: {','.join(row)[:80]!r} must be a plane's name, which comes once, a "
                "comma, and its height in mm"
            )
        heights[name] = height
    return heights
