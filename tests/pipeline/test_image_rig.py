"""Somebody's images of a board, planes and a part: the plain rig's, kept in folders under names of their own."""

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from greenough.instrument import Placement, open_rig
from greenough.instrument.command import GROUP, run
from greenough.instrument.contract import KnownUncertainty
from greenough.instrument.errors import InputError
from greenough.pipeline.acquisition import calibrate_by_methods, measure
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.method import Method
from greenough.pipeline.point_cloud import read_cloud
from greenough.pipeline.sequence import sequence_patterns
from image_folders import keep, keep_as_it_lies, rig_file
from plain_rig import PROCEDURE, PlainRig

HEIGHTS = tuple(k * 0.001 for k in (-1350, -1050, -750, -450, -150, 150, 450, 750, 1050, 1350))  # as names tell them
LISTED = replace(PROCEDURE, heights_mm=HEIGHTS)
PART = Placement("tilted plane")
METHODS: tuple[Method, ...] = ("paper", "stage-free")  # one of either kind of data


def fixed(**options: Any) -> PlainRig:
    """A rig whose exposure cannot be set and whose noise nobody states: as images are."""
    rig = PlainRig(**{"procedure": LISTED, **options})
    rig.camera.exposure_limits_us, rig.camera.noise = (8000.0, 8000.0), None
    rig.uncertainty = KnownUncertainty(1e-6 * 30.0, 1e-3 * 0.5, 1e-3 * 0.05)  # rounded as from the rig file
    return rig


def assert_same(one: Calibration, other: Calibration) -> None:
    """To the last bit."""
    assert one.camera == other.camera
    assert one.figures == other.figures
    for group in ("rays", "phase_height", "residuals", "uncertainty"):
        for field in fields(getattr(one, group)):
            arrays = (getattr(getattr(calibration, group), field.name) for calibration in (one, other))
            np.testing.assert_array_equal(*arrays)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with their rig file, images of board and planes, and of a part."""
    folder = tmp_path_factory.mktemp("theirs")
    keep(fixed(), folder, HEIGHTS)
    rig = fixed(run="part")
    rig.operator.place(PART)
    keep_as_it_lies(rig, folder / "part")
    (folder / "rig.toml").write_text(rig_file(rig))
    return folder


@pytest.fixture
def theirs(kept: Path, tmp_path: Path) -> Path:
    """The same, to be spoiled."""
    shutil.copytree(kept, tmp_path / "theirs")
    return tmp_path / "theirs"


@pytest.fixture(scope="module")
def direct(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Calibration]:
    """Calibrations by the rig itself, of the same frames."""
    folder = tmp_path_factory.mktemp("direct")
    with fixed() as rig:
        return dict(calibrate_by_methods(rig, {method: folder / f"{method}.h5" for method in METHODS}, "calibrate"))


@pytest.mark.slow
@pytest.mark.essential
def test_calibrations_from_images_are_those_of_the_same_frames_to_the_last_bit(kept, direct, tmp_path):
    with open_rig(kept / "rig.toml", run="calibrate") as rig:
        made = calibrate_by_methods(rig, {method: tmp_path / f"{method}.h5" for method in METHODS}, "calibrate")
    assert made.keys() == direct.keys()
    for method, calibration in made.items():
        assert calibration.identity.name == "theirs"
        assert_same(calibration, direct[method])


@pytest.mark.slow
def test_commands_calibrate_and_measure_where_the_twin_cannot_be_imported(kept, direct, tmp_path):
    program = (
        "import sys\n"
        "sys.modules['greenough.twin'] = None\n"
        "from importlib.metadata import entry_points\n"
        "from greenough.instrument.command import GROUP, run\n"
        "verbs = [entry for entry in entry_points(group=GROUP) if entry.name in ('instrument', 'pipeline')]\n"
        "for line in sys.argv[1:]:\n"
        "    assert run(line.split(), verbs) == 0\n"
    )
    lines = [
        f"calibrate {kept}/rig.toml --method stage-free --out cal.h5 --json",
        f"measure {kept}/rig.toml --calibration cal.h5 --sample {kept}/part --out part.ply --json",
    ]
    done = subprocess.run([sys.executable, "-c", program, *lines], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with fixed(run="part") as rig:
        expected = measure(rig, direct["stage-free"], PART)
    cloud = read_cloud(tmp_path / "part.ply")
    np.testing.assert_array_equal(cloud.xyz, expected.xyz[expected.valid].astype(cloud.xyz.dtype))


@pytest.mark.slow
def test_other_periods_signs_starts_and_horizontal_fringes_give_the_same_places(tmp_path):
    """A camera and a projector that both lie on their sides, and fringes of another kind, see the same world."""
    procedure = replace(
        LISTED, periods_px=(70.0, 64.0, 59.0), steps=(4, 4, 5), field_px=608.0, start_rad=-math.pi / 2, sign=-1
    )
    folder, turned = tmp_path / "upright", tmp_path / "turned"
    keep(fixed(procedure=procedure), folder, ())
    rig = fixed(procedure=procedure, run="part")
    rig.operator.place(PART)
    keep_as_it_lies(rig, folder / "part")
    for path in folder.rglob("*.png"):
        to = turned / path.relative_to(folder)
        to.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(to), np.rot90(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    text = rig_file(rig).partition("planes =")[0]
    text = text.replace("steps = ", 'direction = "horizontal"\nsign = -1\nstart_deg = -90.0\nsteps = ')
    sides = {"rows = 360\ncols = 480": "rows = 480\ncols = 360", "rows = 4\ncols = 608": "rows = 608\ncols = 4"}
    for upright, on_its_side in sides.items():
        assert upright in text
        text = text.replace(upright, on_its_side)
    (turned / "rig.toml").write_text(text)

    with fixed(procedure=procedure) as rig:
        calibration = calibrate_by_methods(rig, {"stage-free": tmp_path / "a.h5"}, "calibrate")["stage-free"]
        rig = fixed(procedure=procedure, run="part")
        expected = measure(rig, calibration, PART).xyz
    with open_rig(turned / "rig.toml", run="calibrate") as rig:
        calibration = calibrate_by_methods(rig, {"stage-free": tmp_path / "b.h5"}, "calibrate")["stage-free"]
    with open_rig(turned / "rig.toml", run="part") as rig:
        xyz = np.rot90(measure(rig, calibration, Placement(str(turned / "part"))).xyz, -1)
    both = np.isfinite(xyz).all(axis=-1) & np.isfinite(expected).all(axis=-1)
    assert both.mean() > 0.3
    assert np.isfinite(xyz).all(axis=-1).sum() == pytest.approx(both.sum(), rel=0.01)
    difference = np.abs(xyz - expected)[both]
    assert np.percentile(difference, 99) < 0.2e-3  # mm: the model's fields are not the same on their side


@pytest.mark.slow
def test_a_gray_code_tells_the_orders_of_one_period(tmp_path):
    shown = {"periods_px": (20.0,), "steps": (5,), "field_px": 608.0, "gray_bits": 5}
    procedure = replace(LISTED, planes=0, plane_step_mm=0.0, heights_mm=(), **shown)
    keep(fixed(procedure=procedure), tmp_path, ())
    text = rig_file(fixed(procedure=procedure)).partition("planes =")[0] + 'gray_frames = "0-4"\n'
    (tmp_path / "rig.toml").write_text(text)
    with fixed(procedure=procedure) as rig:
        direct = calibrate_by_methods(rig, {"stage-free": tmp_path / "a.h5"}, "calibrate")["stage-free"]
    with open_rig(tmp_path / "rig.toml", run="calibrate") as rig:
        made = calibrate_by_methods(rig, {"stage-free": tmp_path / "b.h5"}, "calibrate")["stage-free"]
    assert made.figures == direct.figures
    assert made.figures["spot_phases_used"] > 200
    assert made.camera == direct.camera
    np.testing.assert_array_equal(made.phase_height.coefficients, direct.phase_height.coefficients)


@pytest.mark.slow
def test_white_pictures_of_the_board_are_enough_for_the_papers_method(theirs, direct, tmp_path):
    """With planes in front: what is white is as bright as the mean of the fringes, so spots are where they were."""
    for posture in (theirs / "board").iterdir():
        frames = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(posture.iterdir())]
        shutil.rmtree(posture)
        cv2.imwrite(f"{posture}.png", np.rint(np.mean(frames, axis=0)).astype(np.uint8))
    text = (theirs / "rig.toml").read_text().replace("pose_{}", "pose_{}.png")
    (theirs / "rig.toml").write_text(text)
    with open_rig(theirs / "rig.toml", run="calibrate") as rig:
        assert not rig.procedure.fringes_on_postures
        calibration = calibrate_by_methods(rig, {"paper": tmp_path / "cal.h5"}, "calibrate")["paper"]
        with pytest.raises(InputError, match="the method bundle needs fringes on the board's postures"):
            calibrate_by_methods(rig, {"bundle": tmp_path / "cal.h5"}, "calibrate")
    np.testing.assert_array_equal(calibration.phase_height.coefficients, direct["paper"].phase_height.coefficients)
    offset = calibration.residuals.centres_px - direct["paper"].residuals.centres_px
    assert np.nanmax(np.abs(offset)) < 0.02  # px: whole grey values of one picture


@pytest.fixture
def greenough(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Runs a command line; returns the exit code, the JSON and the errors."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, Any, str]:
        code = run([str(argument) for argument in arguments], entry_points(group=GROUP))
        printed = capsys.readouterr()
        return code, json.loads(printed.out) if printed.out.startswith("{") else printed.out, printed.err

    return call


@pytest.mark.slow
def test_check_says_what_each_place_holds(kept, greenough):
    code, result, errors = greenough("check", kept / "rig.toml", "--json")
    assert (code, errors) == (0, "")
    postures, planes = result["checks"][:8], result["checks"][8:]
    assert [row["place"] for row in postures] == [f"posture {k}" for k in range(1, 9)]
    assert [row["height_mm"] for row in planes] == pytest.approx(sorted([0.0, *HEIGHTS]))
    assert all(row["holds"] and row["frames"] == 24 and row["valid_share"] > 0.9 for row in result["checks"])
    assert all(20 <= row["spots"] <= 35 for row in postures)
    assert (postures[0]["first"], postures[0]["last"]) == ("shift1_freq4.png", "shift12_freq1.png")
    assert "'_freq' counts periods" in postures[0]["order"]
    assert postures[1]["order"] == "as above"


@pytest.mark.slow
def test_check_names_every_bad_place_and_goes_on(theirs, greenough):
    (theirs / "board/pose_2/shift3_freq1.png").unlink()
    dark = np.zeros((360, 480), np.uint8)
    for path in (theirs / "board/pose_4").iterdir():
        cv2.imwrite(str(path), dark)
    cut = theirs / "planes/z+150/shift1_freq1.png"
    cut.write_bytes(cut.read_bytes()[:1000])
    swapped = [theirs / f"planes/z+450/shift{step}_freq2.png" for step in (1, 2)]
    for path in (theirs / "planes/z-450").iterdir():
        cv2.imwrite(str(path), 255 - dark)
    first, second = (path.read_bytes() for path in swapped)
    swapped[0].write_bytes(second)
    swapped[1].write_bytes(first)
    code, result, errors = greenough("check", theirs / "rig.toml", "--json")
    assert (code, errors) == (1, "")
    wrong = {row["place"]: row["remedy"] for row in result["checks"] if not row["holds"]}
    assert wrong.keys() == {"posture 2", "posture 4", "plane +150", "plane +450", "plane -450"}
    assert "holds 23 frames" in wrong["posture 2"]
    assert "board not found" in wrong["posture 4"]
    assert "shift1_freq1.png is not an image, or a damaged one" in wrong["plane +150"]
    assert "check the order of the frames" in wrong["plane +450"]
    assert "100% of the picture is saturated" in wrong["plane -450"]


@pytest.mark.slow
def test_a_board_that_is_not_found_is_named_as_its_images_are(theirs, greenough, caplog):
    for path in (theirs / "board/pose_4").iterdir():
        cv2.imwrite(str(path), np.full((360, 480), 7, np.uint8))
    code, result, _ = greenough("calibrate", theirs / "rig.toml", "--method", "stage-free", "--out", "cal.h5")
    assert code == 0
    assert "posture 4: the board was not found" in caplog.text
    assert re.search(r"postures_without_board +4\n", result)


def edit(old: str, new: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        text = (folder / "rig.toml").read_text()
        assert old in text
        (folder / "rig.toml").write_text(text.replace(old, new))

    return change


def without(*names: str) -> Callable[[Path], object]:
    return lambda folder: [shutil.rmtree(folder / name) for name in names]


def picture(name: str, image: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: cv2.imwrite(str(folder / name), image)


BAD = {
    "a posture is missing": (
        lambda folder: (edit("[uncertainty]", "postures = 8\n[uncertainty]")(folder), without("board/pose_3")(folder)),
        r"images\.postures matches 7 postures, but procedure\.postures is 8; there are 1, 2, 4, \.\.\., 8",
    ),
    "no postures": (without("board"), r'images\.postures = "board/pose_\{\}": nothing in .* matches it'),
    "no such flat one": (
        edit("planes =", 'flat = "9"\nplanes ='),
        r'images\.flat = "9" is no posture; there are 1, 2, 3, \.\.\., 8',
    ),
    "no plane at 0": (without("planes/z+0"), "none of the 10 planes is at height 0"),
    "too few planes": (without("planes/z+150", "planes/z-150", "planes/z+450"), "needs at least 8"),
    "no planes": (edit('planes = "planes/z{}"\nplane_step_mm = 0.001\n', ""), "needs at least 8 .*states 0"),
    "a plane whose name is no number": (
        lambda folder: (folder / "planes/z+150").rename(folder / "planes/zhigh"),
        r"the plane high is not called by a number",
    ),
    "two planes of one height": (
        lambda folder: shutil.copytree(folder / "planes/z+150", folder / "planes/z150"),
        r"the planes (\+?150) and (\+?150) have the same height, 0\.15 mm",
    ),
    "heights that rise and fall": (
        edit("plane_step_mm = 0.001", f"heights_mm = [0, 1, 3, 2, {', '.join(str(k) for k in range(4, 11))}]"),
        "must rise, or fall, from plane to plane, but 3 is followed by 2",
    ),
    "too few heights": (edit("plane_step_mm = 0.001", "heights_mm = [0, 1]"), "lists 2 heights, but .*matches 11"),
    "no heights": (edit("plane_step_mm = 0.001", ""), "planes need one of heights_mm"),
    "no file of heights": (edit("plane_step_mm = 0.001", 'heights_file = "z.csv"'), r"z\.csv cannot be read: No such"),
    "a frame is missing": (
        lambda folder: (folder / "board/pose_2/shift3_freq1.png").unlink(),
        r"posture 2 \(.*pose_2\) holds 23 frames, but the procedure's steps \[12, 4, 4, 4\] need 24",
    ),
    "images of another size": (
        picture("board/pose_1/shift1_freq1.png", np.zeros((36, 48), np.uint8)),
        "posture 1: .* is 480 x 360 uint8, but .* is 48 x 36 uint8; all frames must be alike",
    ),
    "all of another size": (edit("rows = 360", "rows = 361"), "are 480 x 360, but the rig file's camera has 480 x 361"),
    "another depth": (edit("black_level_dn", "bits = 16\nblack_level_dn"), r"uint8 up to \d+, but camera\.bits = 16"),
    "a truncated image": (
        lambda folder: (folder / "board/pose_1/shift1_freq1.png").write_bytes(b"\x89PNG\r\n\x1a\n"),
        r"posture 1: .*shift1_freq1\.png is not an image, or a damaged one",
    ),
    "a misspelt field": (edit("steps =", "stepps = 1\nsteps ="), r"no field procedure\.stepps, the nearest is .*steps"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "says"), BAD.values(), ids=BAD)
def test_bad_input_is_one_sentence(theirs, greenough, change, says):
    change(theirs)
    code, printed, errors = greenough("calibrate", theirs / "rig.toml", "--out", "cal.h5")
    assert (code, printed) == (2, "")
    assert re.search(says, errors)
    assert errors.count("\n") == 1
    assert not Path("cal.h5").exists()


def test_boards_that_are_found_nowhere_are_named(theirs, greenough):
    for path in theirs.glob("board/pose_[345678]/*"):
        cv2.imwrite(str(path), np.full((360, 480), 7, np.uint8))
    code, _, errors = greenough("calibrate", theirs / "rig.toml", "--out", "cal.h5", "--json")
    assert code == 2
    assert "the board was not found in posture 3, 4, 5, 6, 7, flat" in errors


def test_a_part_needs_its_frames_and_lies_as_it_lay(kept, direct, greenough):
    direct["paper"].save("cal.h5")
    command = ("measure", kept / "rig.toml", "--calibration", "cal.h5", "--out", "part.ply", "--sample")
    assert "made with another rig" in greenough(*command, kept / "part")[2]
    replace(direct["paper"], identity=open_rig(kept / "rig.toml").identity).save("cal.h5")
    assert "there is no file nothing" in greenough(*command, "nothing")[2]
    assert "leave unit and pose out" in greenough(*command, kept / "part", "--pose", "0,0,1,0,0,0")[2]
    assert greenough(*command, kept / "part", "--json")[0] == 0


def test_only_what_was_projected_is_answered(kept):
    with open_rig(kept / "rig.toml") as rig:
        rig.operator.place(Placement("board"))
        patterns = sequence_patterns(rig.procedure, rig.projector.shape)
        frames = rig.capture(patterns)
        assert frames.stack.flags.writeable
        assert rig.capture(patterns).serials[0] == frames.serials[-1] + 1
        for other in (patterns[::-1], patterns[:3], 255 - patterns):
            with pytest.raises(InputError, match="nothing is known of"):
                rig.capture(other)
        with pytest.raises(InputError, match="holds 24 frames, where one white picture"):
            rig.capture(np.full((1, *rig.projector.shape), 255, np.uint8))
        rig.operator.place(Placement("board", face="blank"))
        rig.stage.move_to_mm(0.3)
        with pytest.raises(InputError, match=r"has no plane at 0\.3 mm"):
            rig.capture(patterns)
