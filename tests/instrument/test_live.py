"""The live page: its figures, what it serves and to whom, and that nothing of it is left."""

import http.client
import json
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from greenough.instrument import live, open_rig
from greenough.instrument.command import GROUP, run
from greenough.instrument.contract import Frames, Placement, Procedure
from greenough.instrument.device_errors import TimedOut
from greenough.instrument.errors import InputError

SHAPE = (60, 80)
SMALL = ["camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75", "twin.render.nodes=16"]
LOST = TimedOut("camera at 192.168.0.10", "frame", 2.0, "check the cable", "a frame")


def scene(blur_px: float = 0.0, contrast: float = 0.6, light: float = 150.0, ambient: float = 0.0) -> Frames:
    """Five frames of a part with texture, of which the left quarter is in the dark."""
    rng = np.random.default_rng(7)
    albedo = cv2.GaussianBlur(rng.uniform(0, 1, SHAPE), (0, 0), 1.5)
    albedo = 0.5 + 3 * (albedo - albedo.mean())
    if blur_px:
        albedo = cv2.GaussianBlur(albedo, (0, 0), blur_px)
    albedo[:, :20] = 0
    phase = np.broadcast_to(0.9 * np.arange(SHAPE[1]), SHAPE)
    shown = [np.ones(SHAPE), *(0.5 + 0.5 * contrast * np.cos(phase + n * np.pi / 2) for n in range(4))]
    stack = 4 + light * (np.stack(shown) * albedo + ambient)
    return Frames(
        stack=np.clip(np.rint(stack), 0, 255).astype(np.uint8),
        full_scale_dn=255.0,
        black_level_dn=4.0,
        exposure_us=10_000.0,
        gain_db=0.0,
        stage_position_mm=0.25,
        serials=np.arange(5),
        times_s=np.arange(5) * 0.1,
    )


class Rig:
    """Shows `scene` again and again; after ``good`` rounds its camera fails, as it may on the way in."""

    def __init__(self, good: float = np.inf, opens: bool = True):
        self.camera = SimpleNamespace(full_scale_dn=255.0, exposure_us=10_000.0)
        self.projector = SimpleNamespace(shape=(30, 608))
        self.procedure = Procedure((608.0, 12.0), (4, 12), 6, 5, 0.1, 0.8)
        self.operator = SimpleNamespace(place=self._place)
        self.placed: list[Placement] = []
        self.asked: list[np.ndarray] = []
        self.is_open = False
        self._good, self._opens = good, opens

    def _place(self, placement: Placement) -> None:
        self.placed.append(placement)

    def capture(self, patterns: np.ndarray) -> Frames:
        assert self.is_open
        self.asked.append(patterns)
        if len(self.asked) > self._good:
            raise LOST
        time.sleep(0.01)
        return scene()

    def __enter__(self) -> "Rig":
        if not self._opens:
            raise LOST
        self.is_open = True
        return self

    def __exit__(self, *exc: object) -> None:
        self.is_open = False


def test_focus_falls_with_blur_and_neither_with_light_nor_black() -> None:
    everywhere = np.ones(SHAPE, dtype=bool)
    sharp = scene().stack[0].astype(np.float32)[:, 25:] - 4
    counts = everywhere[:, 25:]
    values = [
        live.focus(scene(blur).stack[0].astype(np.float32)[:, 25:] - 4, counts) or 0.0 for blur in (0, 0.5, 1, 2, 4)
    ]
    assert values == sorted(values, reverse=True)
    assert values[0] > 5 * values[-1]
    assert live.focus(0.5 * sharp, counts) == pytest.approx(live.focus(sharp, counts))
    assert live.focus(sharp, ~counts) is None
    ramp = np.tile(np.arange(100, 180, dtype=np.float32), (60, 1))
    assert live.focus(ramp, everywhere) == pytest.approx(1 / 139.5**2)


def test_figures_are_those_of_the_scene() -> None:
    seen = live.judge_round(scene(contrast=0.6), 255.0)
    assert seen.modulation == pytest.approx(0.6, abs=0.01)
    assert seen.saturated_share == 0
    assert (seen.exposure_us, seen.stage_position_mm) == (10_000.0, 0.25)
    assert np.isnan(seen.contrast[:, :20]).all()
    assert np.nanmedian(seen.contrast) == pytest.approx(0.6, abs=0.01)
    assert seen.modulation_dn == pytest.approx(0.6 * 0.5 * 75, rel=0.1)
    # Ambient light is no light of the projector: what it alone lights does not count, and modulation falls.
    seen = live.judge_round(scene(contrast=0.6, ambient=0.25), 255.0)
    assert np.isnan(seen.contrast[:, :20]).all()
    assert seen.modulation == pytest.approx(0.3, abs=0.02)
    noise = np.random.default_rng(2).integers(3, 6, (5, *SHAPE)).astype(np.uint8)
    dark = live.judge_round(replace(scene(), stack=noise), 255.0)
    assert (dark.modulation, dark.modulation_dn, dark.focus) == (None, None, None)


def test_what_clips_is_counted_and_red() -> None:
    frames = scene(light=400.0)
    expected = frames.stack[0] == 255
    assert 0.1 < expected.mean() < 0.9
    seen = live.judge_round(frames, 255.0)
    assert seen.saturated_share == pytest.approx(expected.mean())
    shown = live.picture(seen, "image")
    np.testing.assert_array_equal((shown == (0, 0, 255)).all(axis=2), expected)
    assert (shown[~expected].min(axis=1) == shown[~expected].max(axis=1)).all()


def test_modulation_in_false_colour_is_black_where_there_is_no_light() -> None:
    shown = live.picture(live.judge_round(scene(), 255.0), "modulation")
    assert shown.shape == (*SHAPE, 3)
    assert not shown[:, :20].any()
    assert shown[:, 30:].any(axis=2).mean() > 0.9


def test_a_camera_of_sixteen_bits_or_none_is_shown_by_its_full_scale() -> None:
    frames = scene()
    for dtype, scale, clips_at in ((np.uint16, 257.0, 65_535.0), (np.float32, 1.0, np.inf)):
        stack = (frames.stack * scale).astype(dtype)
        other = replace(frames, stack=stack, full_scale_dn=clips_at, black_level_dn=4.0 * scale)
        seen = live.judge_round(other, 255.0 * scale)
        assert np.abs(seen.image.astype(int) - live.judge_round(frames, 255.0).image).max() <= 1
        assert seen.modulation == pytest.approx(0.6, abs=0.01)


@pytest.fixture
def view() -> live.View:
    return live.View()


@pytest.fixture
def ask(view: live.View) -> Iterator[Callable[..., tuple[int, Any, bytes]]]:
    """Asks the served page; returns status, headers and body."""
    with live.serving(view, 0) as address:
        yield lambda path, method="GET", **headers: fetch(address, path, method, **headers)


def fetch(address: str, path: str, method: str = "GET", **headers: str) -> tuple[int, Any, bytes]:
    connection = http.client.HTTPConnection(address.removeprefix("http://").rstrip("/"), timeout=60)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def test_the_page_comes_whole_and_with_a_policy(ask) -> None:
    status, headers, body = ask("/")
    assert status == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    page = body.decode()
    assert "http" not in page
    assert "innerHTML" not in page
    assert page.count("<script>") == page.count("<style>") == 1


def test_state_is_json_before_and_after_the_first_round(ask, view: live.View) -> None:
    names = {
        "round", "exposure_us", "stage_position_mm", "saturated_share", "modulation_dn", "modulation", "focus",
        "frames_per_s", "error",
    }  # fmt: skip
    status, headers, body = ask("/state.json")
    assert (status, headers["Content-Type"]) == (200, "application/json")
    state = json.loads(body)
    assert set(state) == names
    assert state["round"] == 0
    assert all(value is None for name, value in state.items() if name != "round")
    assert ask("/picture.png")[0] == 503
    seen = live.judge_round(scene(), 255.0)
    view.show(seen, 12.5)
    state = json.loads(ask("/state.json?t=1")[2])
    assert (state["round"], state["frames_per_s"], state["focus"]) == (1, 12.5, seen.focus)
    assert state["error"] is None
    view.show(live.judge_round(replace(scene(), stage_position_mm=np.nan), 255.0), 12.5)
    assert json.loads(ask("/state.json")[2])["stage_position_mm"] is None


def test_pictures_have_the_camera_s_shape(ask, view: live.View) -> None:
    view.show(live.judge_round(scene(), 255.0), 1.0)
    for layer in live.LAYERS:
        status, headers, body = ask(f"/picture.png?layer={layer}&round=1")
        assert (status, headers["Content-Type"]) == (200, "image/png")
        decoded = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
        assert decoded.shape == (*SHAPE, 3)
        np.testing.assert_array_equal(decoded, live.picture(view.seen, layer))
    assert ask("/picture.png?layer=other")[0] == 404


def test_foreign_names_other_methods_and_other_paths_are_refused(ask) -> None:
    for host in ("evil.example", "evil.example:8765", "127.0.0.1.evil.example", "localhost:1:2", "192.168.0.1", ""):
        for path in ("/", "/state.json", "/picture.png"):
            assert ask(path, Host=host)[0] == 403, host
    for host in ("localhost", "LOCALHOST:9000", "127.0.0.1", "127.0.0.1:1"):
        assert ask("/", Host=host)[0] == 200, host
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD"):
        status, headers, _ = ask("/", method)
        assert (status, headers["Allow"]) == (405, "GET")
    assert ask("/", "BREW")[0] == 501
    assert ask("/../live.py")[0] == 404
    assert ask("/live.html")[0] == 404


def test_it_is_served_to_this_machine_alone(view: live.View) -> None:
    for host in ("0.0.0.0", "192.168.0.1", "::", "localhost", ""):
        with pytest.raises(InputError, match=r"127\.0\.0\.1 alone"), live.serving(view, 0, host):
            pass
    for port in (-1, 65_536):
        with pytest.raises(InputError, match="--port"), live.serving(view, port):
            pass


def test_a_port_that_is_taken_is_refused(view: live.View) -> None:
    with live.serving(view, 0) as address:
        port = int(address.rsplit(":")[-1].rstrip("/"))
        with pytest.raises(InputError, match=f"port {port}.*--port"), live.serving(view, port):
            pass


def test_nothing_is_left_not_even_of_a_client_that_says_nothing(view: live.View) -> None:
    before = threading.active_count()
    with live.serving(view, 0) as address:
        port = int(address.rsplit(":")[-1].rstrip("/"))
        silent = socket.create_connection(("127.0.0.1", port))
        assert fetch(address, "/")[0] == 200
        assert threading.active_count() > before
    assert threading.active_count() == before
    silent.settimeout(5)
    assert silent.recv(1) == b""
    silent.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))


@pytest.fixture
def greenough(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs `greenough live` on a rig of these tests; returns the exit code and the errors."""

    def call(rig: Any, *options: str) -> tuple[int, str]:
        monkeypatch.setattr("greenough.instrument.opening.open_rig", lambda name, overrides: rig)
        source = EntryPoint("instrument", "greenough.instrument.commands:app", GROUP)
        code = run(["live", "rig.toml", "--port", "0", *options], [source])
        printed = capsys.readouterr()
        assert printed.out == ""
        return code, printed.err

    return call


def test_the_verb_ends_after_its_rounds(greenough) -> None:
    rig, before = Rig(), threading.active_count()
    code, errors = greenough(rig, "--rounds", "3", "--sample", "coin", "--exposure-us", "12000")
    assert code == 0
    assert errors.startswith("greenough: http://127.0.0.1:")
    assert errors.count("\n") == 1
    assert (len(rig.asked), rig.placed, rig.camera.exposure_us) == (3, [Placement("coin")], 12_000)
    assert [len(asked) for asked in rig.asked] == [5, 5, 5]
    assert (rig.asked[0][0] == 255).all()
    assert not rig.is_open
    assert threading.active_count() == before
    rig = Rig()
    assert greenough(rig, "--rounds", "1")[0] == 0
    assert (rig.placed, rig.camera.exposure_us) == ([], 10_000)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_a_termination_end_it_cleanly(greenough, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    rig, before = Rig(), threading.active_count()

    def interrupted(patterns: np.ndarray) -> Frames:
        signal.raise_signal(number)
        raise AssertionError("it went on")

    monkeypatch.setattr(rig, "capture", interrupted)
    code, errors = greenough(rig)
    assert code == 0
    assert len(errors.splitlines()) == 1, "only where the page is"
    assert not rig.is_open
    assert threading.active_count() == before


def test_what_a_device_does_wrong_is_told_to_the_page_and_ends_the_command(greenough, monkeypatch) -> None:
    for rig, view in ((Rig(good=2), live.View()), (Rig(opens=False), live.View())):
        monkeypatch.setattr(live, "View", lambda view=view: view)
        told: list[dict] = []

        def poll(view=view, told=told, rig=rig) -> None:
            while not told or told[-1]["error"] is None:
                time.sleep(0.02)
                told.append(view.state() | {"is_open": rig.is_open})

        page = threading.Thread(target=poll)
        page.start()
        code, errors = greenough(rig)
        page.join()
        assert code == 2
        assert errors.splitlines()[-1] == f"greenough: {LOST}"
        assert told[-1]["error"] == str(LOST)
        assert not told[-1]["is_open"]  # and so dark
        assert told[-1]["round"] == min(rig._good, len(rig.asked))


def test_an_error_that_nobody_fetches_ends_the_command_all_the_same(greenough, monkeypatch) -> None:
    monkeypatch.setattr(live, "_TOLD_S", 0.05)
    assert greenough(Rig(good=0))[0] == 2


@pytest.mark.slow
def test_the_twin_is_seen(view: live.View) -> None:
    with open_rig("twin", SMALL) as rig:
        rig.operator.place(Placement("coin"))
        rig.camera.exposure_us = 30_000
        live.watch(rig, view, rounds=2)
    state = view.state()
    assert state["round"] == 2
    assert state["exposure_us"] == 30_000
    assert 0.3 < state["modulation"] < 1
    assert view.seen is not None
    assert view.seen.image.shape == (240, 320)
