"""The operator at a terminal says what to lay down, waits no longer than stated, and does as the person decides."""

import io
import os
import pty
import select
import time

import pytest

from greenough.instrument.console_operator import (
    ConsoleOperator,
    PlacementAborted,
    PlacementSkipped,
    instruction,
)
from greenough.instrument.contract import BLANK, Placement
from greenough.instrument.device_errors import TimedOut
from greenough.instrument.errors import InputError

PATIENT_S = 600.0
COIN = Placement("coin")


def scripted(answers: str, **settings) -> tuple[ConsoleOperator, io.StringIO]:
    words = io.StringIO()
    return ConsoleOperator(16, answers=io.StringIO(answers), words=words, **settings), words


@pytest.mark.parametrize(
    ("placement", "said"),
    [
        (Placement("board", posture=0), ["board", "Tilt", "posture 1 of 16", "printed side up"]),
        (Placement("board", posture=14), ["posture 15 of 16"]),
        (Placement("board"), ["flat", "posture 16 of 16", "printed side up"]),
        (Placement("board", face=BLANK), ["Turn", "board", "flat", "blank side up"]),
        (COIN, ["sample coin", "flat"]),
        (Placement("lab/part.stl", unit="um"), ["lab/part.stl", "mesh"]),
        (Placement("part.stl", material="metal"), ["the part of metal", "part.stl"]),
        (
            Placement("part.stl", pose_mm_deg=(0, 0, 30, 1, -0.5, 0)),
            ["0, 0 and 30 degrees about x, y and z", "1, -0.5 and 0 mm"],
        ),
    ],
)
def test_the_words_say_part_posture_and_side(placement, said):
    words = instruction(placement, 16)
    assert all(part in words for part in said), words
    assert ("posture" in words) == (placement.part == "board" and placement.face != BLANK)


def test_every_posture_of_a_calibration_is_told_from_the_others():
    placements = [
        *(Placement("board", posture=k) for k in range(15)),
        Placement("board"),
        Placement("board", face=BLANK),
    ]
    assert len({instruction(placement, 16) for placement in placements}) == len(placements)


def test_a_script_answers_placement_by_placement():
    operator, words = scripted("\ngo\n Y \ns\na\n")
    for _ in range(3):
        operator.place(COIN)
    with pytest.raises(PlacementSkipped) as skipped:
        operator.place(COIN)
    with pytest.raises(PlacementAborted) as ended:
        operator.place(COIN)
    assert skipped.value.placement == ended.value.placement == COIN
    assert words.getvalue().count("sample coin") == 5
    assert "waiting 60 min" in words.getvalue()


def test_an_answer_that_means_nothing_is_asked_again():
    operator, words = scripted("what?\n\n")
    operator.place(COIN)
    assert words.getvalue().count("press Enter") == 2


def test_the_end_of_the_answers_is_an_error_for_a_person():
    operator, _ = scripted("")
    with pytest.raises(PlacementAborted, match="nobody to answer at the sample coin") as ended:
        operator.place(COIN)
    assert isinstance(ended.value, InputError)


def test_a_pipe_may_hold_all_answers_at_once_and_end_without_a_line_break():
    reader, writer = os.pipe()
    with os.fdopen(reader) as answers:
        os.write(writer, b"\n\ngo")
        os.close(writer)
        operator = ConsoleOperator(16, 5.0, answers, io.StringIO())
        for _ in range(3):
            operator.place(COIN)
        with pytest.raises(PlacementAborted):
            operator.place(COIN)


@pytest.mark.timeout(60)
def test_nobody_answering_ends_in_the_stated_time():
    reader, writer = os.pipe()
    with os.fdopen(reader) as answers:
        began = time.monotonic()
        with pytest.raises(TimedOut, match=r"sample coin.*within 0\.1 s"):
            ConsoleOperator(16, 0.1, answers, io.StringIO()).place(COIN)
        assert time.monotonic() - began >= 0.1
    os.close(writer)


class AnsweredWhenAsked(io.StringIO):
    """Where the questions go: a person presses Enter at the other end of the terminal as soon as one is put."""

    def __init__(self, person: int):
        super().__init__()
        self._person = person

    def write(self, words: str) -> int:
        if "press Enter" in words:
            os.write(self._person, b"\n")
        return super().write(words)


def test_what_was_typed_before_the_question_confirms_nothing():
    person, terminal = pty.openpty()
    with os.fdopen(terminal) as answers:
        os.write(person, b"\n\n\n")
        select.select([terminal], [], [])  # until the terminal has it
        with pytest.raises(TimedOut):
            ConsoleOperator(16, 0.3, answers, io.StringIO()).place(COIN)
        ConsoleOperator(16, PATIENT_S, answers, AnsweredWhenAsked(person)).place(COIN)
    os.close(person)
