"""The verdict of a demo: what the paper claims, in words, beside what was measured, what is true, and whether it holds.

Each line is carried by one row of the claims, the one that the paper's sentence speaks of. Nothing is computed anew:
figures, limits and spreads are the row's own. What the paper claims and no row measures is said to be not measured.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from greenough.instrument.plain_table import SCREEN_LINES, WIDTH, first_few, sentence_lines, table_lines
from greenough.pipeline.report.verdict_table import (
    FAILS,
    FAILS_AS_PREDICTED,
    FAILS_BORDERLINE,
    HOLDS,
    HOLDS_AGAINST_PREDICTION,
    HOLDS_BORDERLINE,
    NO_LIMIT,
    NOT_MEASURED,
    VERDICT_COLUMNS,
    verdict_cells,
    verdict_sentence,
)

from .claims import Claim
from .coarse_stage import POSITION_SD_UM

Bound = Literal["at most", "at least", "within", "about nominal"]


@dataclass(frozen=True)
class Line:
    """One claim of the paper.

    Parameters
    ----------
    claim : str
        In words, with treatment and method of calibration where they are not the usual ones.
    row, specimen, calibration, filter : str
        The row of the claims that carries it; empty where there is none.
    unit : str
        Of all figures; "um" is µm.
    paper : float or None
        The paper's figure.
    measured : float or None
        None where nothing was measured.
    uncertainty : float or None
        Standard deviation that the row states; None where it states none.
    truth : float or None
        The true value of what was measured, where the row knows it.
    limit : float or None
    bound : "at most", "at least", "within" or "about nominal"
        How the limit is meant; "within" is to both sides of zero, "about nominal" to both sides of the nominal length.
    predicted : float or None
        What an independent model expects.
    verdict : str
        In a few words: one of those of ``verdict_table``.
    unexpected : bool
        Whether the row behaves otherwise than expected.
    digits : int
        Significant digits of a figure without uncertainty.
    """

    claim: str
    row: str
    specimen: str
    calibration: str
    filter: str
    unit: str
    paper: float | None
    measured: float | None
    uncertainty: float | None
    truth: float | None
    limit: float | None
    bound: Bound
    predicted: float | None
    verdict: str
    unexpected: bool
    digits: int


@dataclass(frozen=True)
class Verdict:
    """The lines, and what is to be said of all rows.

    Parameters
    ----------
    lines : tuple of Line
    rows, judged, as_expected : int
        How many there are, have a limit, and of these behave as expected.
    unexpected : tuple of str
        The other ones: name, specimen and calibration.
    """

    lines: tuple[Line, ...]
    rows: int
    judged: int
    as_expected: int
    unexpected: tuple[str, ...]

    @property
    def plain(self) -> list[dict[str, Any]]:
        """The lines as ``claims.json`` has them; a figure that is not finite is None."""
        return [asdict(line) for line in self.lines]


@dataclass(frozen=True)
class _Said:
    """A sentence of the paper, and which row carries it.

    ``rows`` are names, the best first; one that ends with "*" stands for all names that begin so. Figures of the row
    are multiplied by ``factor`` to come into ``unit``. Where ``words`` are set, they stand as they are.
    """

    claim: str
    rows: tuple[str, ...]
    specimen: str
    unit: str
    paper: float | None = None
    calibration: str = "bundle"
    bound: Bound = "at most"
    knows_truth: bool = False  # what the row predicts is the true value of what it measures
    factor: float = 1.0
    digits: int = 3
    words: str = ""


_TREATED = ("_deconvolved_filtered", "_filtered")
_COARSE_STAGE = f"plane, stage of {POSITION_SD_UM:g} um"

SAID = (
    _Said("depth error 95 %", ("depth_p95_volume",), "plane", "um", 4.0),
    _Said("", ("depth_p95_volume",), "plane", "um", 4.0, "paper", words="same by the paper's method"),
    _Said("", ("depth_p95_volume",), _COARSE_STAGE, "um", 4.0, "paper", words="same, with a stage of 10 µm"),
    _Said("plane RMSE, one exposure", ("plane_rmse_raw",), "plane", "um", 1.223),
    _Said("plane RMSE", ("plane_rmse_filtered",), "plane", "um", 1.223),
    _Said("plane noise along a row 95 %", ("plane_line_noise",), "plane", "um", 4.0),
    _Said(
        "circle distance, mean",
        ("pitch_mean",),
        "board",
        "mm",
        0.6502,
        bound="about nominal",
        knows_truth=True,
        digits=5,
    ),
    _Said("circle distance, RMSE", ("pitch_sd",), "board", "um", 1.1, knows_truth=True, factor=1e3),
    _Said("reprojection RMSE, u", ("reprojection_rmse_u",), "board", "px", 0.07206, "paper"),
    _Said("reprojection RMSE, v", ("reprojection_rmse_v",), "board", "px", 0.08591, "paper"),
    _Said("volume, length", ("volume_x",), "plane", "mm", 8.0, bound="at least"),
    _Said("volume, width", ("volume_y",), "plane", "mm", 6.0, bound="at least"),
    _Said("volume, height", ("z_range",), "plane", "mm", 3.0, bound="at least"),
    _Said("coin 95 %", tuple(f"p95{end}" for end in _TREATED), "coin", "um"),
    _Said("worst ball height error", ("ball_apex_within_tolerance_deconvolved",), "bga", "um", 50.0, bound="within"),
    _Said("ball diameter", ("ball_diameter*",), "bga", "mm", 0.5, bound="about nominal"),
    _Said("coplanarity error", ("coplanarity_error_deconvolved",), "bga", "um", bound="within"),
    _Said("diaphragm concave 95 %", ("p95_filtered",), "diaphragm-concave", "um"),
    _Said("diaphragm equilibrated 95 %", ("p95_filtered",), "diaphragm-equilibrated", "um"),
    _Said("diaphragm raised 95 %", ("p95_filtered",), "diaphragm-raised", "um"),
)
"""What the paper claims, in the order of the verdict's lines."""

HEADING = "claim (bundle, no filter unless said)"


def verdict_of(claims: Sequence[Claim]) -> Verdict:
    """The verdict on the paper's claims."""
    judged = [claim for claim in claims if claim.holds is not None]
    unexpected = tuple(
        f"{claim.claim} ({claim.specimen}, {claim.calibration})" for claim in claims if not claim.as_expected
    )
    return Verdict(
        lines=tuple(_line(said, _carrier(said, claims)) for said in SAID),
        rows=len(claims),
        judged=len(judged),
        as_expected=sum(claim.as_expected for claim in judged),
        unexpected=unexpected,
    )


def word_of(claim: Claim) -> str:
    """The verdict on one row in a few words."""
    if not math.isfinite(claim.measured):
        return NOT_MEASURED
    if claim.holds is None:
        return NO_LIMIT
    if claim.expected_to_hold is None:
        return HOLDS_BORDERLINE if claim.holds else FAILS_BORDERLINE
    if claim.holds:
        return HOLDS if claim.expected_to_hold else HOLDS_AGAINST_PREDICTION
    return FAILS if claim.expected_to_hold else FAILS_AS_PREDICTED


def screen_lines(verdict: Verdict, folder: Path) -> list[str]:
    """What a demo prints at its end: at most `SCREEN_LINES` lines of `WIDTH` characters."""
    cells = [verdict_cells(line) for line in verdict.plain]
    table = table_lines((HEADING, *VERDICT_COLUMNS[1:]), cells, numbers={1, 2, 3})
    where = f"report.html shows the figures, claims.json holds all {verdict.rows} rows; both are in {folder}"
    last = sentence_lines(where)
    if len(last) > 2:
        last = sentence_lines("report.html shows the figures, claims.json holds all rows, in the demo's folder")
    room = SCREEN_LINES - len(table) - len(last)
    counts = sentence_lines(verdict_sentence(verdict.plain))[:1]
    return [*table, *counts, *_rows_lines(verdict, room - len(counts)), *last]


def rows_sentence(verdict: Verdict, room: int = WIDTH) -> str:
    """How many of all rows were judged and behave as expected, with as many names of others as ``room`` holds."""
    judged = f"{verdict.judged} of {verdict.rows} rows have a limit"
    if not verdict.unexpected:
        return f"{judged}; all of these behave as expected."
    start = f"{judged}; {verdict.as_expected} behave as expected, {len(verdict.unexpected)} otherwise: "
    return f"{start}{first_few(verdict.unexpected, room - len(start) - 1, 'claims.json')}."


def _rows_lines(verdict: Verdict, most: int) -> list[str]:
    """The same as at most ``most`` lines."""
    for room in range(WIDTH * max(most, 1), 0, -10):
        lines = sentence_lines(rows_sentence(verdict, room))
        if len(lines) <= most:
            return lines
    return sentence_lines(rows_sentence(verdict, 0))[: max(most, 1)]


def _carrier(said: _Said, claims: Sequence[Claim]) -> Claim | None:
    """The row that carries a sentence: the first name that is there, one with a limit rather than one without."""
    of = [claim for claim in claims if (claim.specimen, claim.calibration) == (said.specimen, said.calibration)]
    found = [claim for name in said.rows for claim in of if _is_named(claim.claim, name)]
    return next((claim for claim in found if claim.limit is not None), found[0] if found else None)


def _is_named(claim: str, name: str) -> bool:
    return claim.startswith(name[:-1]) if name.endswith("*") else claim == name


def _line(said: _Said, claim: Claim | None) -> Line:
    if claim is None:
        return Line(
            said.words or said.claim, "", said.specimen, said.calibration, "", said.unit, said.paper, None, None, None,
            None, said.bound, None, NOT_MEASURED, unexpected=False, digits=said.digits,
        )  # fmt: skip

    def figure(value: float | None) -> float | None:
        return said.factor * value if value is not None and math.isfinite(value) else None

    same_unit = said.factor != 1 or claim.unit == said.unit
    return Line(
        claim=said.words or _in_words(said.claim, claim),
        row=claim.claim,
        specimen=claim.specimen,
        calibration=claim.calibration,
        filter=claim.filter,
        unit=said.unit if same_unit else claim.unit,
        paper=said.paper if same_unit else figure(claim.paper),
        measured=figure(claim.measured),
        uncertainty=figure(claim.predicted_sd),
        truth=figure(claim.predicted) if said.knows_truth else None,
        limit=figure(claim.limit),
        bound=said.bound,
        predicted=figure(claim.predicted),
        verdict=word_of(claim),
        unexpected=not claim.as_expected,
        digits=said.digits,
    )


def _in_words(words: str, claim: Claim) -> str:
    """With the row's own method and filter, where they are not the bundle and none."""
    if claim.calibration == "paper":
        words += ", paper's method"
    if "deconvolved" in claim.filter:
        words += ", deconvolved"
    if "gaussian" in claim.filter:
        words += ", filtered"
    if "over each spot" in claim.filter:
        words += ", per spot"
    return words
