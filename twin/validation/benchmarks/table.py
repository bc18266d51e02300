"""The table that `greenough bench` prints: every section in turn, and which rows are missing for what reason."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from greenough.instrument.errors import InputError

from ..judged_table import JudgedTable
from .required import REQUIRED, Section
from .rows import Row


@dataclass(frozen=True)
class Measurement:
    """What measures the rows of a section.

    Parameters
    ----------
    module, function : str
        Of this package: ``function(rig_name, overrides)`` makes the rows.
    weight : int
        The section's share of the progress, which is about its share of the time.
    peers : tuple of str
        Modules of other people without which not all rows can be made.
    """

    module: str
    weight: int
    function: str = "rows"
    peers: tuple[str, ...] = ()


MEASUREMENTS: Mapping[Section, Measurement] = {
    "startup": Measurement("startup", 3),
    "decoding": Measurement("decoding", 10, peers=("fringes",)),
    "calibrating": Measurement("calibrating", 10),
    "rendering": Measurement("rendering", 20),
    "capturing": Measurement("capturing", 2),
    "scaling": Measurement("scaling", 20),
    "study": Measurement("study", 10),
    "calibration": Measurement("calibrating", 10, "whole_calibration_rows"),
    "demo": Measurement("demonstration", 20),
}

INSTALL: Mapping[str, str] = {
    # Its own requirements would replace OpenCV by another build.
    "fringes": "pip install 'greenough[bench]' and then pip install --no-deps fringes",
}
"""How to get a peer that is not installed; make bench does."""


def weight(sections: Iterable[Section]) -> int:
    """Steps of progress that `bench` takes for these sections."""
    return sum(MEASUREMENTS[section].weight for section in sections)


def bench(
    rig_name: str, overrides: Sequence[str], sections: Iterable[Section], advance: Callable[[float], None]
) -> JudgedTable[Row]:
    """Measure sections of the table one after the other.

    Parameters
    ----------
    rig_name : str
        A twin.
    overrides : sequence of str
        Settings of its rig file.
    sections : iterable of Section
        Rows of the others are not missed.
    advance : callable
        Called with each section's weight when it is done.

    Raises
    ------
    InputError
        If the rig is not a twin or its settings are refused. What a section refuses makes its rows missing instead.
    """
    from ...settings import load_twin_file

    load_twin_file(rig_name, overrides)
    rows: list[Row] = []
    missing: dict[str, str] = {}
    for section in sections:
        measurement = MEASUREMENTS[section]
        absent = [peer for peer in measurement.peers if find_spec(peer) is None]
        reason = "; ".join(f"{peer} is not installed: {INSTALL[peer]}" for peer in absent)
        try:
            module = import_module(f".{measurement.module}", __package__)
            rows.extend(getattr(module, measurement.function)(rig_name, overrides))
        except InputError as error:
            reason = str(error)
        found = {row.name for row in rows}
        missing |= {name: reason or f"{section} yielded no such row" for name in REQUIRED[section] if name not in found}
        advance(measurement.weight)
    return JudgedTable(tuple(rows), missing)
