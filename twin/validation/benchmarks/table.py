"""The table that `greenough bench` prints: every section in turn, and which rows are missing for what reason."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from greenough.instrument.errors import FileError, InputError

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
    peers : tuple of str
        Modules of other people without which not all rows can be made.
    """

    module: str
    function: str = "rows"
    peers: tuple[str, ...] = ()


MEASUREMENTS: Mapping[Section, Measurement] = {
    "startup": Measurement("startup"),
    "decoding": Measurement("decoding", peers=("fringes",)),
    "calibrating": Measurement("calibrating"),
    "rendering": Measurement("rendering"),
    "capturing": Measurement("capturing"),
    "scaling": Measurement("scaling"),
    "study": Measurement("study"),
    "calibration": Measurement("calibrating", "whole_calibration_rows"),
    "demo": Measurement("demonstration"),
}

INSTALL: Mapping[str, str] = {
    # Its own requirements would replace OpenCV by another build.
    "fringes": "pip install 'greenough[bench]' and then pip install --no-deps fringes",
}
"""How to get a peer that is not installed; make bench does."""


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
        Called with 1 after each section.

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
        except FileError:
            raise
        except InputError as error:
            reason = str(error)
        found = {row.name for row in rows}
        missing |= {name: reason or f"{section} yielded no such row" for name in REQUIRED[section] if name not in found}
        advance(1)
    return JudgedTable(tuple(rows), missing)
