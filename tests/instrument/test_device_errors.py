"""Errors of devices are one sentence for a person, exit the command line with 2, and pass between processes."""

import pickle
from importlib.metadata import EntryPoint

import pytest
import typer

from greenough.instrument.command import run
from greenough.instrument.device_errors import BadReply, ConnectionLost, DeviceError, Fault, Rejected, TimedOut
from greenough.instrument.errors import InputError

WHERE = ("stage on /dev/ttyUSB0", "move abs 2000")
REMEDY = "free the table and home it"
ERRORS = [
    DeviceError(*WHERE, "it did nothing", REMEDY),
    TimedOut(*WHERE, 2.5, REMEDY),
    TimedOut(*WHERE, 2.5, REMEDY, "the end of the motion"),
    Rejected(*WHERE, "BADDATA", "out of range", REMEDY),
    Rejected(*WHERE, 3, "invalid parameter", REMEDY),
    Fault(*WHERE, "FS", "stalled and stopped", REMEDY),
    BadReply(*WHERE, b"@01 1\n\xff" * 100, "no checksum", REMEDY),
    ConnectionLost(*WHERE, "refused", REMEDY),
]
app = typer.Typer()


@app.command()
def fail(number: int) -> None:
    raise ERRORS[number]


@app.command()
def other() -> None: ...


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_names_device_command_and_remedy_in_one_short_line(error):
    assert isinstance(error, InputError)
    sentence = str(error)
    assert all(part in sentence for part in (*WHERE, REMEDY))
    assert sentence.isprintable()  # no line breaks or control characters from a wire reach the terminal
    assert not sentence.endswith(".")
    assert len(sentence) < 400


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_passes_whole_between_processes(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_what_a_caller_decides_by_is_an_attribute():
    assert ERRORS[2].timeout_s == 2.5
    assert "the end of the motion did not come within 2.5 s" in str(ERRORS[2])
    assert ERRORS[4].code == 3
    assert ERRORS[5].flag == "FS"
    assert ERRORS[6].reply == b"@01 1\n\xff" * 100


def test_the_command_line_prints_the_sentence_and_exits_with_2(capsys):
    source = EntryPoint(name="here", value=f"{__name__}:app", group="greenough.commands")
    assert run(["fail", "5"], [source]) == 2
    assert capsys.readouterr().err == f"greenough: {ERRORS[5]}\n"
