"""The table of faults and outcomes."""

from dataclasses import dataclass, field

from faulty_calibration import HEARTBEAT_S, Ended, Outcome
from plain_scene import largest_error_um
from process_faults import PROCESS_KINDS, SOON_S, Aftermath


@dataclass
class _Row:
    """What came of the runs with one fault."""

    bound_s: float
    runs: int = 0
    finished: int = 0
    errors: dict[str, int] = field(default_factory=dict)
    latest_s: float = 0.0
    left_lit: int = 0
    resumed: int = 0
    kept: list[int] = field(default_factory=list)
    error_um: float = 0.0
    deviation: float = 0.0

    def cells(self) -> list[str]:
        errors = ", ".join(f"{count} {name}" for name, count in sorted(self.errors.items()))
        in_time = f"{self.latest_s:.1f} of {self.bound_s:.0f}" if self.errors else ""
        kept = f"{min(self.kept)} to {max(self.kept)}" if self.kept else ""
        figures = [f"{self.error_um:.1f}", f"{self.deviation:.1f}"]
        return [
            str(self.runs),
            str(self.finished),
            errors,
            in_time,
            str(self.left_lit),
            kept,
            str(self.resumed),
            *figures,
        ]


class FaultTable:
    """Rows of Markdown, one per fault."""

    HEAD = (
        "fault",
        "runs",
        "went on",
        "ended in",
        "latest error, or camera free, s",
        "left lit",
        "steps kept",
        "resumed to the end",
        "largest error, um",
        "worst grey value, sd",
    )

    def __init__(self) -> None:
        self._rows: dict[str, _Row] = {}

    def add(self, name: str, bound_s: float, outcome: Outcome) -> None:
        """One run with a fault on the wire."""
        first, row = outcome.first, self._rows.setdefault(name, _Row(bound_s))
        row.runs += 1
        row.left_lit += first.lit
        if first.error is None:
            row.finished += 1
        else:
            kind = type(first.error).__name__
            row.errors[kind] = row.errors.get(kind, 0) + 1
            row.latest_s = max(row.latest_s, first.after_s)
        row.error_um = max(row.error_um, outcome.error_um)
        row.deviation = max(row.deviation, first.worst_deviation)
        if outcome.second is not None:
            row.kept.append(len(first.kept))
            row.resumed += outcome.second.calibration is not None
            row.deviation = max(row.deviation, outcome.second.worst_deviation)

    def add_process(self, name: str, ended: Ended, after: Aftermath) -> None:
        """One run whose process was ended."""
        row = self._rows.setdefault(name, _Row(SOON_S + HEARTBEAT_S * PROCESS_KINDS[name].whole_group))
        row.runs += 1
        row.left_lit += after.lit
        row.latest_s = max(row.latest_s, ended.camera_held_s)
        row.errors[f"exit {ended.code}"] = row.errors.get(f"exit {ended.code}", 0) + 1
        row.kept.append(len(after.kept))
        if after.second.calibration is not None:
            row.resumed += 1
            row.error_um = max(row.error_um, largest_error_um(after.second.calibration))
        row.deviation = max(row.deviation, after.second.worst_deviation)

    def __str__(self) -> str:
        lines = [self.HEAD, ["---"] * len(self.HEAD)]
        lines += [[name, *row.cells()] for name, row in self._rows.items()]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"{table}\n{sum(row.runs for row in self._rows.values())} runs"
