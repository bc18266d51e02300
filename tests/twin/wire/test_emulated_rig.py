"""What the wires carry is the twin's own measurement, to the last bit, and nothing stays behind."""

import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from emulated_gige import free_address, need_aravis

from greenough.instrument import open_rig
from greenough.instrument.contract import Frames, Placement, Rig
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline import FringeSet
from greenough.pipeline.acquisition import calibrate, measure
from greenough.twin.wire.emulated_rig import EmulatedRig
from greenough.twin.wire.twin_scene import TwinScene

pytestmark = pytest.mark.wire

SMALL = ("camera.rows=120", "camera.cols=160", "twin.optics.camera_focal_px=2835.375", "twin.render.nodes=16")
# Enough pixels to find the spots, and as few postures and planes as a calibration takes.
QUICK = (
    *("camera.rows=360", "camera.cols=480", "twin.optics.camera_focal_px=8506.125"),
    *("procedure.postures=6", "procedure.planes=8", "procedure.plane_step_mm=0.3"),
    *("twin.render.nodes=16", "twin.render.nodes_edges=16"),
)
PATTERNS = FringeSet(periods=(608, 152, 40, 12), steps=(4, 4, 4, 12)).patterns(684, 608)
WHITE = np.full_like(PATTERNS[:1], 255)
T = TypeVar("T")


def through_the_wire(settings: tuple[str, ...], work: Callable[..., T], run: str = "default") -> T:
    """What ``work(rig, emulated)`` makes of a rig of drivers, which reach the twin by emulated devices alone."""
    need_aravis()
    overrides = [*settings, f'genicam.address="{free_address()}"']
    rig_file = load_rig_file("wire", overrides)
    with (
        EmulatedRig(rig_file, TwinScene(rig_file, run), free_ports=True, homed=True) as emulated,
        open_rig("wire", [*overrides, *emulated.overrides], run=run) as rig,
    ):
        return work(rig, emulated)


def sequences(rig: Rig, heights: list[float]) -> list[Frames]:
    """White, and fringes in two uploads, twice, of a tilted board and of a coin, at these readings of the stage."""
    taken = []
    for placement, height in zip((Placement("board", posture=1), Placement("coin")), heights, strict=True):
        rig.operator.place(placement)
        rig.stage.move_to_mm(height)
        rig.camera.exposure_us = 50_000
        taken += [rig.capture(patterns) for patterns in (WHITE, PATTERNS, PATTERNS[:5])]
    return taken


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("bits", [8, 16])
def test_frames_through_the_wire_are_the_twins_own_bit_by_bit(seed, bits):
    settings = (*SMALL, f"twin.seed={seed}", f"camera.bits={bits}")
    wired = through_the_wire(settings, lambda rig, _: sequences(rig, [0.1234, -0.5]))
    with open_rig("twin", settings) as rig:
        direct = sequences(rig, [frames.stage_position_mm for frames in wired[::3]])
    for theirs, ours in zip(wired, direct, strict=True):
        assert theirs.stack.dtype == ours.stack.dtype
        np.testing.assert_array_equal(theirs.stack, ours.stack)
        np.testing.assert_array_equal(theirs.serials, ours.serials)
        assert (theirs.exposure_us, theirs.stage_position_mm) == (ours.exposure_us, ours.stage_position_mm)
        assert (theirs.full_scale_dn, theirs.black_level_dn) == (ours.full_scale_dn, ours.black_level_dn)


@pytest.mark.slow
def test_a_calibration_and_a_measurement_through_the_wire_are_those_without_it(tmp_path):
    def directly(run: str, work: Callable[[Rig], object]):
        with open_rig("twin", QUICK, run=run) as rig:
            return work(rig)

    def wired(run: str, work: Callable[[Rig], object]):
        return through_the_wire(QUICK, lambda rig, _: work(rig), run)

    clouds = []
    for name, way in (("wire", wired), ("twin", directly)):
        made = way("calibrate", lambda rig, out=tmp_path / f"{name}.h5": calibrate(rig, out, "calibrate"))
        clouds.append(way("measure", lambda rig, made=made: measure(rig, made, Placement("coin"))))
    theirs, ours = clouds
    assert np.isfinite(ours.xyz).all(axis=-1).mean() > 0.3
    # Heights in whole microsteps are the targets' but for rounding in the last of 53 bits.
    np.testing.assert_allclose(theirs.xyz, ours.xyz, rtol=0, atol=1e-6)
    np.testing.assert_allclose(theirs.sigma_noise, ours.sigma_noise, rtol=1e-6)


@pytest.mark.slow
def test_a_projector_that_shows_nothing_is_dark_and_half_the_current_is_half_the_light():
    dark = ("twin.light.ambient=0", "twin.stability.flicker=0")

    def work(rig, emulated):
        rig.operator.place(Placement("plane"))
        rig.camera.exposure_us = 50_000
        full = rig.capture(WHITE).stack.astype(float) - rig.camera.black_level_dn
        set_current = rig.projector.set_led_current
        set_current(0, 128, 0)
        half = rig.capture(WHITE).stack.astype(float) - rig.camera.black_level_dn
        set_current(255, 0, 255)
        other_leds = rig.capture(WHITE).stack.astype(float) - rig.camera.black_level_dn
        rig.camera.arm()
        unlit = rig.camera.trigger_and_grab().image.astype(float) - rig.camera.black_level_dn
        return full.mean(), half.mean(), other_leds.mean(), unlit.mean()

    full, half, other_leds, unlit = through_the_wire((*SMALL, *dark), work)
    assert half / full == pytest.approx(128 / 255, rel=5e-3)
    assert abs(other_leds) < 0.1
    assert abs(unlit) < 0.1


def test_an_empty_table_gives_dark_frames_and_no_error():
    stack = through_the_wire(SMALL, lambda rig, _: rig.capture(WHITE).stack)
    assert stack.mean() < 10


@pytest.mark.slow
@pytest.mark.essential
def test_the_stage_is_where_it_went_and_not_where_it_was_sent():
    def work(rig, emulated):
        rig.operator.place(Placement("plane"))
        rig.stage.move_to_mm(0.3)
        one = rig.capture(PATTERNS[-12:]).stack
        emulated.stage.turn_knob(-3000)  # 0.3 mm down
        rig.stage.home()
        rig.stage.move_to_mm(0.0)
        other = rig.capture(PATTERNS[-12:]).stack
        return one, other

    one, other = through_the_wire(SMALL, work)
    with open_rig("twin", SMALL) as rig:
        rig.operator.place(Placement("plane"))
        rig.stage.move_to_mm(0.3)
        np.testing.assert_array_equal(rig.capture(PATTERNS[-12:]).stack, one)
        rig.stage.move_to_mm(0.0)
        np.testing.assert_array_equal(rig.capture(PATTERNS[-12:]).stack, other)
    assert (one != other).mean() > 0.3


@pytest.mark.slow
def test_nothing_is_left_after_close():
    def open_files() -> set[str]:
        return {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if _is_open(fd)}

    through_the_wire(SMALL, lambda rig, _: rig.capture(PATTERNS))  # what is loaded for good is loaded
    threads, files = set(threading.enumerate()), open_files()
    through_the_wire(SMALL, lambda rig, _: rig.capture(PATTERNS))
    assert set(threading.enumerate()) == threads
    assert {name for name in open_files() - files if "socket" in name or "pt" in name} == set()
    assert not multiprocessing.active_children()


def _is_open(fd: str) -> bool:
    return os.path.lexists(f"/proc/self/fd/{fd}")


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (['lightcrafter.host="0.0.0.0"'], r"other machines on 0\.0\.0\.0"),
        (['genicam.address="192.0.2.1"'], r"other machines on 192\.0\.2\.1"),
        (['operator.address="192.0.2.1:9"'], r"other machines on 192\.0\.2\.1"),
        (['zaber.port="socket://192.0.2.1:9"'], r"other machines on 192\.0\.2\.1"),
        (['zaber.port="/dev/ttyUSB0"'], r"zaber\.port = /dev/ttyUSB0 cannot be emulated"),
        (['operator.kind="console"'], "operator.kind"),
        (["camera.bits=0"], "camera.bits"),
        (["zaber.zero_microsteps=10"], "too little room"),
    ],
)
def test_what_cannot_be_emulated_or_could_be_reached_from_elsewhere_is_refused(settings, sentence):
    rig_file = load_rig_file("wire", [*SMALL, f'genicam.address="{free_address()}"', *settings])
    with pytest.raises(InputError, match=sentence), EmulatedRig(rig_file, TwinScene(rig_file), free_ports=True):
        pass


def test_a_rig_with_another_camera_is_refused():
    with pytest.raises(InputError, match="UVC camera"):
        EmulatedRig(load_rig_file("paper"), TwinScene(load_rig_file("twin")))


def test_a_port_that_is_taken_is_one_sentence_and_nothing_stays_open():
    rig_file = load_rig_file("wire", [*SMALL, f'genicam.address="{free_address()}"'])
    with EmulatedRig(rig_file, TwinScene(rig_file), free_ports=True) as first:
        taken = load_rig_file("wire", [*SMALL, f'genicam.address="{free_address()}"', *first.overrides])
        threads = set(threading.enumerate())
        with pytest.raises(InputError, match="cannot listen on"), EmulatedRig(taken, TwinScene(taken)):
            pass
        assert set(threading.enumerate()) == threads


@pytest.mark.slow
@pytest.mark.essential
@pytest.mark.parametrize(
    ("ignored", "number"), [(False, signal.SIGINT), (False, signal.SIGTERM), (True, signal.SIGTERM)]
)
def test_serve_says_where_and_ends_cleanly(ignored, number):
    """By Ctrl-C, and by a termination, which a background job of a script hears alone."""
    need_aravis()
    address = free_address()
    settings = [*SMALL, f'genicam.address="{address}"', f'lightcrafter.host="{address}"']
    settings += [f'zaber.port="socket://{address}:21846"', f'operator.address="{address}:21847"']
    arguments = [item for setting in settings for item in ("--set", setting)]
    command = [str(Path(sys.executable).parent / "greenough"), "serve", "wire", "--json", *arguments]
    if ignored:
        command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            lines = iter(server.stdout.readline, "")
            answer = json.loads("".join(itertools.chain(itertools.takewhile(lambda line: line != "}\n", lines), "}")))
            assert answer["projector"] == f"{address}:21845"
            assert answer["camera"] == address
            with open_rig("wire", settings) as rig:
                assert {device.role for device in rig.devices} == {"projector", "camera", "stage"}
                rig.stage.home()
                rig.stage.move_to_mm(1.0)
                assert rig.stage.position_mm == pytest.approx(1.0, abs=1e-3)
        finally:
            if ignored:
                server.send_signal(signal.SIGINT)
            server.send_signal(number)
        _, errors = server.communicate(timeout=60)
    assert (server.returncode, errors) == (0, "")


def test_truth_is_not_on_the_wire():
    """The control connection takes placements; everything else is refused without a word of the scene."""
    from greenough.twin.wire.placements import answer

    for request in ({"truth": True}, {"place": {"part": "coin"}, "truth": True}, {"position": 0}, [], None):
        reply = json.loads(answer(json.dumps(request).encode(), lambda placement: None))
        assert set(reply) == {"refused"}
