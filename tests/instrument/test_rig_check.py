"""Every fault that is planted makes its own row red and no other, and what is in order makes none."""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from greenough.instrument import open_rig
from greenough.instrument.command import GROUP, run
from greenough.instrument.contract import (
    BLANK,
    CameraNoise,
    DeviceReport,
    Frames,
    KnownUncertainty,
    Placement,
    Procedure,
    RigIdentity,
    SpotBoard,
)
from greenough.instrument.device_errors import ConnectionLost, Fault, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.frame_figures import (
    CYCLES,
    dropped_frames,
    fringe_patterns,
    median_contrast,
    modulation_maps,
    shown_patterns,
    stripe_frequencies,
    stripe_patterns,
)
from greenough.instrument.recording import record
from greenough.instrument.rig_check import Check, check_rig

SMALL = ["camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75", "twin.render.nodes=16"]
SHAPE, PROJECTOR = (120, 160), (40, 608)
ROWS = ("stage_homed", "dark_level", "light", "saturation", "modulation", "pattern_order", "frames_dropped")
NOT_HOMED = Fault("stage on /dev/x", "get pos", "WR", "no reference position", "home the stage")


class Stage:
    """A stage that must be homed where it has not been, and that misses its targets by ``miss_um``."""

    def __init__(self, homed: bool = True, miss_um: float = 0.0):
        self.limits_mm = (-1.6, 1.6)
        self.homed, self.miss_um = homed, miss_um
        self.targets: list[float] = []
        self.homings = 0
        self.is_stuck = False

    @property
    def position_mm(self) -> float:
        if not self.homed:
            raise NOT_HOMED
        return (self.targets[-1] if self.targets else 0.0) + 1e-3 * self.miss_um

    def move_to_mm(self, position: float) -> None:
        if self.is_stuck:
            raise TimedOut("stage on /dev/x", "move abs 1", 3.0, "clear the way of the table", "the end of the motion")
        self.targets.append(position)

    def home(self) -> None:
        if self.is_stuck:
            raise TimedOut("stage on /dev/x", "home", 3.0, "clear the way of the table", "the end of the motion")
        self.homings += 1
        self.homed = True


class Bench:
    """A rig whose camera sees the projector's columns turned, mirrored and in perspective, otherwise for every seed.

    ``light`` is relative to a lamp that gives three quarters of full scale at 10 ms, ``ambient`` to that light,
    ``blur_columns`` the standard deviation of the projector's defocus; ``spoil`` changes what a capture returns.
    """

    identity = RigIdentity("bench", "camera-1", "projector-1", 64 * "0")
    devices = (DeviceReport("camera", "camera at 192.168.0.10", "ACME 1 camera-1", "2.0"),)
    board = SpotBoard(3, 3, 0.65, 0.4, 0.175, 2.0, ((1, 1), (1, 2), (0, 1)))
    procedure = Procedure((608.0, 12.0), (4, 12), 6, 5, 0.1, 0.8)
    uncertainty = KnownUncertainty(3e-5, 5e-4, 5e-5)

    def __init__(
        self,
        seed: int = 1,
        light: float = 1.0,
        ambient: float = 0.005,
        blur_columns: float = 1.2,
        stage: Stage | None = None,
        spoil: Callable[[Frames], Frames] = lambda frames: frames,
        fails: Callable[[np.ndarray], bool] = lambda patterns: False,
    ):
        rng = np.random.default_rng(seed)
        self._rng, self._light, self._ambient, self._blur = rng, light, ambient, blur_columns
        self._spoil, self._fails = spoil, fails
        noise = CameraNoise(6500.0, 10.0, 25.9)
        self.camera = SimpleNamespace(
            shape=SHAPE, full_scale_dn=255.0, black_level_dn=4.0, noise=noise, exposure_limits_us=(1000.0, 1e6)
        )
        self.camera.exposure_us = float(rng.choice([1000.0, 5000.0, 10_000.0, 1e6]))
        self.projector = SimpleNamespace(shape=PROJECTOR)
        self.stage = stage or Stage()
        self.operator = SimpleNamespace(place=self._place)
        self.placed: list[Placement] = []
        self.targets_when_placed: list[int] = []
        self.lit = False
        self._serial = 0
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] / SHAPE[1] - 0.5
        turn = np.radians(rng.uniform(-20, 20))
        across = (u * np.cos(turn) + v * np.sin(turn)) / (1 + 0.04 * u)
        self._column = 303.5 + rng.choice([-1, 1]) * rng.uniform(300, 560) * across
        self._albedo = 0.9 - 0.2 * (v + 0.5)
        self._albedo[:30, 40:70] *= 0.02  # something black lies there
        self._albedo *= (self._column > 0) & (self._column < PROJECTOR[1] - 1)

    def _place(self, placement: Placement) -> None:
        self.placed.append(placement)
        self.targets_when_placed.append(len(self.stage.targets))

    def capture(self, patterns: np.ndarray) -> Frames:
        self.lit = True
        if self._fails(patterns):
            raise TimedOut("camera at 192.168.0.10", "frame", 2.0, "check the cable", "a frame")
        lines = patterns[:, 0].astype(np.float32)
        lines = cv2.GaussianBlur(lines, (0, 0), sigmaX=self._blur, sigmaY=1e-3, borderType=cv2.BORDER_REPLICATE)
        shown = np.stack([np.interp(self._column, np.arange(PROJECTOR[1]), line) for line in lines]) / 255
        grey = 190 * self.camera.exposure_us / 10_000 * (self._light * self._albedo * shown + self._ambient)
        grey += np.sqrt(grey / 25.9 + 0.15) * self._rng.standard_normal(grey.shape)
        serials = self._serial + np.arange(len(patterns))
        self._serial += len(patterns)
        frames = Frames(
            stack=np.clip(np.rint(grey + 4), 0, 255).astype(np.uint8),
            full_scale_dn=255.0,
            black_level_dn=4.0,
            exposure_us=self.camera.exposure_us,
            gain_db=0.0,
            stage_position_mm=0.0,
            serials=serials,
            times_s=serials * 1.1,
        )
        return self._spoil(frames)

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *exc: object) -> None:
        self.lit = False


def long_only(change: Callable[[Frames], Frames]) -> Callable[[Frames], Frames]:
    """Spoils nothing but the long sequence."""
    return lambda frames: change(frames) if len(frames.stack) == len(CYCLES) else frames


def reordered(*order: int) -> Callable[[Frames], Frames]:
    def change(frames: Frames) -> Frames:
        stack = frames.stack.copy()
        stack[: len(order)] = frames.stack[list(order)]
        return replace(frames, stack=stack)

    return long_only(change)


def replaced(grey: int, frame: int) -> Callable[[Frames], Frames]:
    def change(frames: Frames) -> Frames:
        stack = frames.stack.copy()
        stack[frame] = grey
        return replace(frames, stack=stack)

    return long_only(change)


def without_a_serial(frames: Frames) -> Frames:
    return replace(frames, serials=frames.serials + (np.arange(len(frames.serials)) >= 9))


def late_counter(frames: Frames) -> Frames:
    return replace(frames, times_s=np.where(np.arange(len(frames.times_s)) == 9, 0.0, frames.times_s))


def rows_of(rig: Any, **options: bool) -> dict[str, Check]:
    with rig:
        return {row.check: row for row in check_rig(rig, **options)}


def red(rows: dict[str, Check]) -> list[str]:
    for row in rows.values():
        assert (row.remedy == "") == (row.holds is True), row
    return [name for name, row in rows.items() if row.holds is False]


@pytest.mark.parametrize("seed", range(1, 13))
def test_a_rig_in_order_is_green(seed: int) -> None:
    rig = Bench(seed)
    rows = rows_of(rig)
    assert tuple(rows) == ROWS
    assert all(row.holds for row in rows.values()), rows
    assert rig.placed == [Placement("board", face=BLANK)]
    assert not rig.stage.targets


FAULTS = [
    ("light", {"light": 0.0, "ambient": 0.0}, "lens caps"),
    ("light", {"light": 0.003, "ambient": 0.0}, "too little light"),
    ("dark_level", {"ambient": 0.2}, "light of the room"),
    ("saturation", {"light": 30.0}, "dim the light"),
    ("modulation", {"blur_columns": 4.0}, "focus"),
    ("pattern_order", {"spoil": reordered(0, 1, 2, 3, 5, 4)}, "frame 4 shows pattern 5, frame 5 shows pattern 4; patt"),
    ("pattern_order", {"spoil": reordered(*range(7), 6)}, "frame 7 shows pattern 6; a frame is older than its trigger"),
    ("pattern_order", {"spoil": reordered(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0)}, "more are wrong"),
    ("pattern_order", {"spoil": replaced(4, 3)}, "frame 3 shows none of the patterns"),
    ("pattern_order", {"spoil": replaced(170, 0)}, "frame 0 shows none of the patterns"),
    ("frames_dropped", {"spoil": long_only(without_a_serial)}, "1 frames are missing"),
    ("frames_dropped", {"spoil": long_only(late_counter)}, "no later than the one before"),
]


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("row", "fault", "remedy"), FAULTS)
def test_a_planted_fault_makes_its_row_red_and_no_other(row: str, fault: dict, remedy: str, seed: int) -> None:
    rows = rows_of(Bench(seed, **fault))
    assert red(rows) == [row]
    assert remedy in rows[row].remedy


def test_without_light_nothing_is_said_of_what_needs_it() -> None:
    rows = rows_of(Bench(light=0.0, ambient=0.0))
    for name in ("modulation", "pattern_order"):
        assert (rows[name].figure, rows[name].holds) == (None, None)
        assert rows[name].remedy == "cannot be judged before light holds"


def test_a_stage_that_is_not_homed_stays_and_is_red() -> None:
    stage = Stage(homed=False)
    rows = rows_of(Bench(stage=stage))
    assert red(rows) == ["stage_homed"]
    assert "greenough check RIG --move" in rows["stage_homed"].remedy
    assert (stage.homings, stage.targets) == (0, [])


def test_move_homes_a_stage_that_is_not_and_visits_both_ends() -> None:
    for homed in (False, True):
        rig = Bench(stage=Stage(homed))
        rows = rows_of(rig, move=True)
        assert tuple(rows) == (ROWS[0], "stage_moves", *ROWS[1:])
        assert not red(rows)
        assert rig.stage.homings == (not homed)
        assert rig.stage.targets == [0.0, -1.6, 1.6, 0.0]
        assert rig.targets_when_placed == [4]


def test_a_stage_that_misses_or_is_stuck_is_red() -> None:
    rows = rows_of(Bench(stage=Stage(miss_um=-11.0)), move=True)
    assert red(rows) == ["stage_moves"]
    assert rows["stage_moves"].figure == pytest.approx(11.0)
    assert "clear the way" in rows["stage_moves"].remedy
    for homed, expected in ((True, "stage_moves"), (False, "stage_homed")):
        stage = Stage(homed)
        stage.is_stuck = True
        rows = rows_of(Bench(stage=stage), move=True)
        assert red(rows) == [expected]
        assert "the end of the motion did not come" in rows[expected].remedy


def test_a_capture_that_fails_is_told_in_its_rows_and_the_others_are_still_taken() -> None:
    rows = rows_of(Bench(fails=lambda patterns: len(patterns) == 4))
    assert red(rows) == ["modulation", "frames_dropped"]
    assert rows["modulation"].remedy.startswith("camera at 192.168.0.10: frame: a frame did not come within 2 s")
    rows = rows_of(Bench(fails=lambda patterns: len(patterns) == 2))
    assert red(rows) == ["dark_level", "light", "saturation", "frames_dropped"]
    rows = rows_of(Bench(fails=lambda patterns: True))
    assert red(rows) == list(ROWS[1:])


def test_what_lies_there_is_looked_at_if_that_is_asked_for() -> None:
    rig = Bench()
    rows_of(rig, as_it_lies=True)
    assert rig.placed == []


def test_another_refusal_is_no_row() -> None:
    rig = Bench()

    def refuse(placement: Placement) -> None:
        raise InputError("the board was skipped")

    rig.operator.place = refuse
    with pytest.raises(InputError, match="skipped"):
        rows_of(rig)


def test_stripes_are_counted_whichever_way_they_run() -> None:
    stripes = stripe_patterns((40, 608)).astype(float)[:, :, ::2]
    upright = np.repeat(stripes[:, :1], 120, axis=1)  # (16, 120, 304)
    for frames in (upright, upright[..., ::-1], upright.transpose(0, 2, 1)):
        measured = stripe_frequencies(frames, 0.0)
        np.testing.assert_allclose(measured, np.array(CYCLES) / 304, atol=0.1 / 304)
        np.testing.assert_array_equal(shown_patterns(frames, 0.0), np.arange(16))
    assert np.isnan(stripe_frequencies(np.zeros((16, 40, 40)), 0.0)).all()
    assert (shown_patterns(np.full((16, 40, 40), 100.0), 4.0) == -1).all()


def test_a_camera_that_sees_a_part_of_the_field_tells_patterns_apart() -> None:
    rng = np.random.default_rng(3)
    seen = np.repeat(stripe_patterns((40, 608))[:, :1, 150:400], 200, axis=1)
    order = np.arange(16)
    order[[3, 11]] = 11, 3
    frames = seen[order] * 0.7 + rng.normal(4, 5, seen.shape)
    np.testing.assert_array_equal(shown_patterns(frames, 4.0), order)
    for _ in range(10):
        order = rng.permutation(16)
        assert (shown_patterns(seen[order] * 0.7, 0.0) != np.arange(16)).any()


def test_modulation_is_that_of_the_fringes() -> None:
    rng = np.random.default_rng(5)
    phase, mean = rng.uniform(0, 6, (30, 40)), rng.uniform(50, 100, (30, 40))
    steps = np.arange(4)[:, None, None] * np.pi / 2
    modulation, background = modulation_maps(10 + mean * (1 + 0.6 * np.cos(phase + steps)), 10.0)
    np.testing.assert_allclose(modulation, 0.6 * mean, rtol=1e-5)
    np.testing.assert_allclose(background, mean, rtol=1e-5)
    assert median_contrast(modulation, background, mean > 0) == pytest.approx(0.6, rel=1e-5)
    assert median_contrast(modulation, background, mean < 0) is None


def test_patterns_are_those_that_are_measured_with() -> None:
    from greenough.pipeline.fringes import FringeSet

    expected = FringeSet((608.0, 12.0), (4, 4)).patterns(20, 608)[4:]
    np.testing.assert_array_equal(fringe_patterns((20, 608), 12.0, 4), expected)
    assert stripe_patterns((20, 608)).shape == (16, 20, 608)
    assert len(set(CYCLES)) == len(CYCLES)


def test_dropped_frames_are_counted_through_all_captures() -> None:
    def dropped(*serials: list[int]) -> int:
        each = [np.array(numbers) for numbers in serials]
        return dropped_frames(each, [np.array(numbers) * 0.1 for numbers in serials])

    assert dropped([5, 6, 7], [8, 9]) == 0
    assert dropped([5, 7], [8, 11]) == 3
    assert dropped([5, 6, 7], [7, 8]) == 1
    assert dropped_frames([np.arange(3)], [np.array([0.0, 0.2, 0.2])]) == 1


@pytest.mark.slow
def test_the_twin_is_green_and_names_its_devices(tmp_path: Path) -> None:
    for seed in (1, 2):
        with open_rig("twin", [*SMALL, f"twin.seed={seed}"]) as rig:
            assert [device.role for device in rig.devices] == ["projector", "camera", "stage"]
            assert rig.devices[1] == DeviceReport("camera", "camera of the twin", rig.identity.camera_serial, "")
            assert not red({row.check: row for row in check_rig(rig, move=True)})
    with record(open_rig("twin", SMALL), tmp_path / "twin.h5") as rig:
        assert len(rig.devices) == 3
    assert open_rig(tmp_path / "twin.h5").devices == ()


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs `greenough check` on a rig of these tests; returns the exit code, what was printed, and the errors."""

    def call(rig: Any, *options: str) -> tuple[int, str, str]:
        def opened(name: str, overrides: object) -> Any:
            if isinstance(rig, Exception):
                raise rig
            return rig

        monkeypatch.setattr("greenough.instrument.opening.open_rig", opened)
        source = EntryPoint("instrument", "greenough.instrument.commands:app", GROUP)
        code = run(["check", "bench.toml", *options], [source])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


def test_the_verb_shows_devices_and_rows_and_says_by_its_code_whether_all_hold(check) -> None:
    rig = Bench()
    code, printed, errors = check(rig, "--json")
    result = json.loads(printed)
    assert (code, errors) == (0, "")
    assert result["camera_shape"] == list(SHAPE)
    assert result["devices"] == [
        {"role": "camera", "name": "camera at 192.168.0.10", "identity": "ACME 1 camera-1", "firmware": "2.0"}
    ]
    assert [row["check"] for row in result["checks"]] == list(ROWS)
    assert list(result["checks"][0]) == ["check", "figure", "unit", "limit", "holds", "remedy"]
    assert not rig.lit
    rig = Bench(stage=Stage(homed=False))
    code, printed, errors = check(rig)
    assert (code, errors) == (1, "")
    assert "home the stage, which moves it through its whole travel: greenough check RIG --move" in printed
    assert not rig.lit
    code, printed, _ = check(Bench(stage=Stage(homed=False)), "--json")
    assert code == 1
    assert json.loads(printed)["stage_position_mm"] is None
    rig = Bench(stage=Stage(homed=False))
    assert check(rig, "--move", "--as-it-lies")[0] == 0
    assert (rig.stage.homings, rig.placed) == (1, [])


def test_a_device_that_cannot_be_opened_is_bad_input(check) -> None:
    lost = ConnectionLost("stage on /dev/x", "open", "no such file", "plug it in")
    code, printed, errors = check(lost)
    assert (code, printed) == (2, "")
    assert errors == "greenough: stage on /dev/x: open: no connection (no such file); plug it in\n"
