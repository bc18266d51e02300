"""Claims about the verb: it tells kinds of input apart, says what it found, and exits with the code that says so."""

import json
from importlib.metadata import entry_points

import cv2
import numpy as np
import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.contract import Placement
from greenough.instrument.recording import record
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.fringes import FringeSet
from plain_rig import PlainRig

FRINGES = FringeSet((608, 152, 40, 12), (4, 4, 4, 12))
OPTIONS = ("--periods", "608,152,40,12", "--steps", "4,4,4,12")


def diagnose(*words):
    return run(["diagnose", *map(str, words)], entry_points(group=GROUP))


@pytest.fixture
def frames(tmp_path):
    """Writes frames of a level face as images; two of them may be exchanged."""

    def written(gamma=1.0, exchanged=()):
        folder = tmp_path / "frames"
        folder.mkdir()
        grey = FRINGES.patterns(40, 608) / 255.0
        stack = 20 + 180 * grey**gamma + np.random.default_rng(1).normal(0, 1.5, grey.shape)
        stack = np.rint(stack).astype(np.uint8)
        if exchanged:
            stack[list(exchanged)] = stack[list(exchanged[::-1])]
        for k, frame in enumerate(stack):
            cv2.imwrite(str(folder / f"{k:02d}.png"), frame)
        return folder

    return written


def test_sound_frames_end_with_0_and_bent_ones_with_1_and_a_table(frames, tmp_path, capsys):
    assert diagnose(frames(), *OPTIONS, "--json") == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []


def test_a_bent_response_ends_with_1_and_its_table_is_written(frames, tmp_path, capsys):
    table = tmp_path / "lut.txt"
    assert diagnose(frames(gamma=1.8), *OPTIONS, "--lut-out", table, "--json") == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["name"] == "response"
    assert finding["evidence"]["gamma"] == pytest.approx(1.8, rel=0.02)
    np.testing.assert_allclose((np.loadtxt(table) / 255) ** 1.8, np.arange(256) / 255, atol=0.006)


def test_what_was_found_is_said_in_words(frames, capsys):
    assert diagnose(frames(exchanged=(4, 18)), *OPTIONS) == 1
    said = capsys.readouterr().out
    assert "1. frame order" in said
    assert "frames 4 and 18 are exchanged" in said
    assert "remedy" in said


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A sound calibration of the plain rig and its recording."""
    folder = tmp_path_factory.mktemp("calibrated")
    with record(PlainRig(), folder / "recording.h5") as rig:
        calibrate(rig, folder / "calibration.h5")
    return folder


@pytest.mark.slow
def test_a_sound_calibration_and_its_recording_end_with_0(calibrated, capsys):
    for name in ("recording.h5", "calibration.h5"):
        assert diagnose(calibrated / name, "--json") == 0, capsys.readouterr().out
        result = json.loads(capsys.readouterr().out)
        assert result["findings"] == []
        assert result["um_per_rad"] == pytest.approx(163, rel=0.05)


@pytest.mark.slow
def test_a_stage_that_slipped_is_named(tmp_path, capsys):
    slipped = PlainRig(stage_error=lambda reading: reading + 0.05 * (reading > 0.5))
    with record(slipped, tmp_path / "recording.h5") as rig:
        calibrate(rig, tmp_path / "calibration.h5")
    assert diagnose(tmp_path / "recording.h5", "--json") == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["name"] == "stage slip"
    assert finding["evidence"]["jump_um"] == pytest.approx(50, abs=5)


def test_a_measurement_is_told_in_radians_and_with_a_calibration_in_um(calibrated, tmp_path, capsys):
    with record(PlainRig(run="measured"), tmp_path / "recording.h5") as rig:
        rig.operator.place(Placement("tilted plane"))
        rig.camera.exposure_us = 2000.0
        rig.capture(FRINGES.patterns(*rig.projector.shape))
    for options in ((), ("--calibration", calibrated / "calibration.h5")):
        assert diagnose(tmp_path / "recording.h5", *options, "--json") == 1
        (finding,) = json.loads(capsys.readouterr().out)["findings"]
        assert finding["name"] == "too little light"
        assert (finding["effect_um"] is None) == (not options)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere.h5",), "--periods"),
        (("nowhere.png", *OPTIONS), "there is no file"),
        (("nowhere.png", "--periods", "608,12", "--steps", "4"), "one number of steps"),
    ],
)
def test_what_cannot_be_diagnosed_is_one_sentence(words, said, capsys):
    assert diagnose(*words) == 2
    message = capsys.readouterr().err
    assert said in message
    assert message.count("\n") == 1


def test_a_truncated_recording_is_one_sentence(calibrated, tmp_path, capsys):
    whole = (calibrated / "recording.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    assert diagnose(tmp_path / "cut.h5", *OPTIONS) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_other_fringes_than_the_recorded_ones_are_asked_for(calibrated, capsys):
    assert diagnose(calibrated / "recording.h5", "--periods", "600,100,20", "--steps", "5,5,5") == 2
    assert "--periods" in capsys.readouterr().err
