"""A table of rows that must all be there and keep to their limits, whatever they measure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar


class JudgedRow(Protocol):
    """A row of such a table: ``holds`` is None where it has no limit."""

    @property
    def name(self) -> str: ...
    @property
    def holds(self) -> bool | None: ...


RowT = TypeVar("RowT", bound=JudgedRow)


@dataclass(frozen=True)
class JudgedTable(Generic[RowT]):
    """What was measured.

    Parameters
    ----------
    rows : tuple of rows
    missing : mapping of str to str
        Names of rows that should be there and are not, each with the reason.
    """

    rows: tuple[RowT, ...]
    missing: Mapping[str, str]

    @property
    def not_holding(self) -> list[str]:
        """Names of rows that do not keep to their limit."""
        return [row.name for row in self.rows if row.holds is False]

    @property
    def holds(self) -> bool:
        """Whether every row is there and none fails."""
        return not self.missing and not self.not_holding
