"""The hands at a real rig: says in plain words what to lay down, and waits until a person, or a script, says it is.

An empty line goes on, ``s`` skips the part and ``a`` ends the run.
"""

import os
import select
import sys
import termios
import time
from pathlib import Path
from typing import TextIO

from .contract import BLANK, Placement
from .device_errors import TimedOut
from .errors import InputError

_GO, _SKIP, _ABORT = ("", "go", "ok", "y", "yes"), ("s", "skip"), ("a", "abort", "q", "quit")
_CHUNK = 1024
_LONGEST_ANSWER = 4096  # characters; the rest of a line is read as another answer


class PlacementSkipped(InputError):
    """The person skips this part: ``placement`` is not under the microscope."""

    def __init__(self, placement: Placement):
        super().__init__(f"{_name(placement)} was skipped; give the same command again to go on with it")
        self.placement = placement


class PlacementAborted(InputError):
    """The person ends the run at ``placement``, or nobody can answer any more."""

    def __init__(self, placement: Placement, reason: str):
        super().__init__(f"{reason} at {_name(placement)}; give the same command again to go on from there")
        self.placement = placement


class ConsoleOperator:
    """An operator at a terminal.

    Parameters
    ----------
    postures : int
        Of a whole calibration, the flat one included, so that the person knows how far it is.
    wait_s : float
        How long to wait for an answer; the person is told.
    answers, words : text streams, optional
        Where answers come from and words go to. Default is standard input and standard error. At a terminal, what was
        typed before the question does not count.
    """

    def __init__(
        self, postures: int, wait_s: float = 3600.0, answers: TextIO | None = None, words: TextIO | None = None
    ):
        self._postures = postures
        self._wait_s = wait_s
        self._answers = answers
        self._words = words
        self._typed = ""  # after the last answer

    def place(self, placement: Placement) -> None:
        """Ask for ``placement`` and wait until it is said to lie there.

        Raises
        ------
        PlacementSkipped, PlacementAborted
            As the person decides; the latter also when the answers have come to their end.
        TimedOut
            When no answer came in time.
        """
        deadline = time.monotonic() + self._wait_s
        answers = sys.stdin if self._answers is None else self._answers
        if answers.isatty():  # Enter hit twice must not confirm the next part unseen
            termios.tcflush(answers.fileno(), termios.TCIFLUSH)
            self._typed = ""
        self._say(f"{instruction(placement, self._postures)}\n")
        while True:
            self._say(f"Then press Enter (s skips it, a ends here; waiting {self._wait_s / 60:.3g} min): ")
            answer = self._next_line(answers, deadline, placement)
            if answer is None:
                raise PlacementAborted(placement, "there is nobody to answer")
            match answer.strip().lower():
                case word if word in _GO:
                    return
                case word if word in _SKIP:
                    raise PlacementSkipped(placement)
                case word if word in _ABORT:
                    raise PlacementAborted(placement, "ended by the operator")
            self._say("That is neither Enter nor s nor a.\n")

    def _say(self, words: str) -> None:
        print(words, end="", file=sys.stderr if self._words is None else self._words, flush=True)

    def _next_line(self, answers: TextIO, deadline: float, placement: Placement) -> str | None:
        """The next answer; None at the end of the stream."""
        try:
            number = answers.fileno()
        except (OSError, ValueError):  # a stream in memory: nothing to wait for
            if time.monotonic() > deadline:
                raise self._nobody(placement) from None
            return answers.readline(_LONGEST_ANSWER) or None
        while "\n" not in self._typed and len(self._typed) < _LONGEST_ANSWER:
            if not select.select([number], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise self._nobody(placement)
            received = os.read(number, _CHUNK)
            if not received:
                break
            self._typed += received.decode("utf-8", errors="replace")
        line, end, self._typed = self._typed.partition("\n")
        return line if line or end else None

    def _nobody(self, placement: Placement) -> TimedOut:
        return TimedOut(
            "operator", f"lay down {_name(placement)}", self._wait_s, "stay with the rig and give the command again"
        )


def instruction(placement: Placement, postures: int) -> str:
    """What a person is to do, in a sentence or two.

    Parameters
    ----------
    placement : Placement
    postures : int
        Of a whole calibration; the flat one is the last.
    """
    part = _name(placement)
    if placement.face == BLANK:
        return f"Turn {part} over and lay it flat on the table, its blank side up."
    if placement.posture is not None:
        return (
            f"Tilt {part} by a few degrees, unlike before, its printed side up and in focus: "
            f"posture {placement.posture + 1} of {postures}."
        )
    if placement.part == "board":
        return f"Lay {part} flat on the table, its printed side up: posture {postures} of {postures}, where z = 0."
    turn, shift = placement.pose_mm_deg[:3], placement.pose_mm_deg[3:]
    words = [f"Lay {part} flat on the table, in the middle of the field"]
    if any(turn):
        words.append("turned by {:g}, {:g} and {:g} degrees about x, y and z".format(*turn))
    if any(shift):
        words.append("shifted by {:g}, {:g} and {:g} mm along x, y and z".format(*shift))
    return ", ".join(words) + "."


def _name(placement: Placement) -> str:
    if placement.part == "board":
        return "the calibration board"
    if Path(placement.part).suffix:
        made_of = "" if placement.material is None else f" of {placement.material}"
        return f"the part{made_of} whose mesh is {placement.part}"
    return f"the sample {placement.part}"
