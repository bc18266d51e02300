"""A finding, and by what findings are measured."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

FALSE_ALARM = 1e-3
"""Accepted probability that a check names something in a sound recording, of all that it looks at there together."""

LEAST_RAD = 0.003
"""Effect on the phase below which nothing is reported where no length scale is known: a two-thousandth of a fringe,
which is 0.5 µm at the paper's 163 µm per radian."""

LEAST_UM = 0.5
"""The same where a scale, but no statement of the instrument's own, is known."""

_SHOWN = 3  # places that are named


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Parameters
    ----------
    name : str
        What, in a word or two: the same for the same kind of fault.
    where : str
        In which capture, frames, planes or postures.
    effect_rad : float
        Root mean square error of the finest phase, rad; a lost pixel counts as one that is a whole fringe off.
    effect_um : float or None
        The same of heights, µm; None where no length scale is known.
    cause, remedy : str
        In words.
    evidence : mapping
        Figures, by name with the unit in the name.
    """

    name: str
    where: str
    effect_rad: float
    effect_um: float | None
    cause: str
    remedy: str
    evidence: Mapping[str, float | str]


@dataclass(frozen=True)
class Yardstick:
    """What an error of the phase is worth, and which is worth a word.

    Parameters
    ----------
    um_per_rad : float or None
        Change of height by one radian of the finest phase; None where nobody knows.
    least_um : float
        Effect below which nothing is reported: what the instrument says of its own errors.
    """

    um_per_rad: float | None = None
    least_um: float = LEAST_UM

    @property
    def least_rad(self) -> float:
        """Effect on the finest phase below which nothing is reported."""
        return LEAST_RAD if self.um_per_rad is None else self.least_um / self.um_per_rad

    def um(self, rad: float) -> float | None:
        """Height for phase."""
        return None if self.um_per_rad is None else rad * self.um_per_rad

    def rad(self, um: float) -> float:
        """Phase for height; by the paper's scale where none is known."""
        return um / (self.um_per_rad or LEAST_UM / LEAST_RAD)


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """Findings of one name at several places become one, with the figures of the worst; then by effect."""
    by_name: dict[str, list[Finding]] = {}
    for finding in sorted(findings, key=lambda each: -each.effect_rad):
        by_name.setdefault(finding.name, []).append(finding)
    return [_joined(same) for same in by_name.values()]


def _joined(same: Sequence[Finding]) -> Finding:
    places = list(dict.fromkeys(finding.where for finding in same))
    more = f" and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
    return replace(same[0], where="; ".join(places[:_SHOWN]) + more)
