"""`greenough calibrate` in a process of its own that is ended from outside, and the call that goes on afterwards."""

import signal
from dataclasses import dataclass
from pathlib import Path
from random import Random

from faulty_calibration import (
    DEVIATION_LIMIT,
    ERROR_LIMIT_UM,
    HEARTBEAT_S,
    Bench,
    Call,
    Ended,
    left_since,
    missing_exposures,
    resources,
)
from plain_scene import largest_error_um
from wire_faults import EVENTS

SOON_S = 20.0
"""In which the camera's process has ended, where its own is gone: a busy machine's time for a frame and a close."""


@dataclass(frozen=True)
class ProcessKind:
    """A signal, and whether the process can clean up then.

    Parameters
    ----------
    sent : Signals
    whole_group : bool
        Whether the camera's process gets it, too.
    code : int
        Exit code that follows.
    """

    sent: signal.Signals
    whole_group: bool
    code: int

    @property
    def cleans_up(self) -> bool:
        return self.sent != signal.SIGKILL


PROCESS_KINDS = {
    "process: killed": ProcessKind(signal.SIGKILL, whole_group=False, code=-signal.SIGKILL),
    "process: killed with the camera's": ProcessKind(signal.SIGKILL, whole_group=True, code=-signal.SIGKILL),
    "process: SIGTERM": ProcessKind(signal.SIGTERM, whole_group=False, code=128 + signal.SIGTERM),
    "process: SIGTERM to its group": ProcessKind(signal.SIGTERM, whole_group=True, code=128 + signal.SIGTERM),
    "process: Ctrl-C at its terminal": ProcessKind(signal.SIGINT, whole_group=True, code=130),
}


@dataclass(frozen=True)
class Aftermath:
    """What was found when the process had ended, and the call that went on.

    Parameters
    ----------
    lit : bool
        Whether the projector was lit.
    rest_s : float
        How long the stage went on moving.
    kept : tuple of str
        Steps on disk.
    second : Call
    left : tuple of str
    """

    lit: bool
    rest_s: float
    kept: tuple[str, ...]
    second: Call
    left: tuple[str, ...]


def run_process(name: str, seed: int, folder: Path) -> tuple[Ended, Aftermath]:
    """`greenough calibrate`, ended at a random event, and a call in this process that goes on."""
    kind, chance, before = PROCESS_KINDS[name], Random(f"{name} {seed}"), resources()
    with Bench(folder, seed) as bench:
        ended = bench.call_process(chance.randint(1, EVENTS["any"]), kind.sent, kind.whole_group)
        lit, rest_s, kept = bench.rig.projector.lit, bench.wait_for_stage(), bench.kept
        second = bench.call()
    return ended, Aftermath(lit, rest_s, kept, second, left_since(before))


def broken_claims_of_process(kind: ProcessKind, ended: Ended, after: Aftermath) -> list[str]:
    """What the requirement says and this outcome does not keep; empty where all is well."""
    second = after.second
    least, most = missing_exposures(after.kept)
    claims = {
        f"it ends with {kind.code}": ended.code == kind.code,
        "it ends with no traceback": "Traceback" not in ended.said,
        "the camera's process ends": ended.camera_process_s < SOON_S,
        "the camera is free": ended.camera_held_s < SOON_S + (HEARTBEAT_S if kind.whole_group else 0),
        "the projector is dark": not (after.lit and kind.cleans_up),
        "the stage is at rest": after.rest_s == 0 or not kind.cleans_up,
        "the next connection makes it dark": not second.lit_after_connecting and not second.lit,
        "the second call takes only what is missing": least <= second.exposures <= most,
        "every frame that was handed out is right": second.worst_deviation < DEVIATION_LIMIT,
        "the calibration is made in the end": second.calibration is not None and second.error is None,
        "nothing is left": not after.left and not second.children,
    }
    if second.calibration is not None:
        claims["its heights are right"] = largest_error_um(second.calibration) < ERROR_LIMIT_UM
    return [claim for claim, holds in claims.items() if not holds]
