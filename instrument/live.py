"""What the camera sees, in a browser on the same machine, while a person turns screws.

The caller's thread captures rounds of a white pattern and four steps of the finest fringes; requests are answered in
threads of their own, which end with the server.
"""

import base64
import hashlib
import json
import logging
import math
import re
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

from .contract import Frames, Rig
from .errors import InputError
from .frame_figures import bright_part, fringe_patterns, lit_pixels, median_contrast, modulation_maps

LOOPBACK = "127.0.0.1"
LAYERS = ("image", "modulation")

_log = logging.getLogger(__name__)
_HOSTS = (LOOPBACK, "localhost")
_LEAST_LIGHT = 0.01  # of full scale; what is darker is the camera's noise
_REQUEST_S = 10.0  # a client that says nothing for so long is let go
_TOLD_S = 3.0  # for a page to fetch the error that ends the command
_RED = (0, 0, 255)  # BGR
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_COLOURS = cv2.COLORMAP_VIRIDIS  # brighter is more, also in print and to the colour-blind


@dataclass(frozen=True, eq=False)
class Round:
    """What one round showed.

    Parameters
    ----------
    image : (rows, cols) uint8
        The white frame, black at 0 and full scale at 255.
    saturated : (rows, cols) bool
        Where it clips.
    contrast : (rows, cols) float32
        Modulation of the finest fringes over their mean; NaN where there is no light.
    exposure_us, stage_position_mm : float
    saturated_share : float
    modulation_dn, modulation : float or None
        Medians where there is light and nothing clips: amplitude of the fringes, and the same over their mean.
    focus : float or None
        Of what does not clip, see `focus`; None in the dark.
    """

    image: np.ndarray
    saturated: np.ndarray
    contrast: np.ndarray
    exposure_us: float
    stage_position_mm: float
    saturated_share: float
    modulation_dn: float | None
    modulation: float | None
    focus: float | None


def patterns(rig: Rig) -> np.ndarray:
    """What a round projects: white and four steps of the finest fringes, (5, rows, cols) uint8."""
    shape = rig.projector.shape
    white = np.full((1, *shape), 255, dtype=np.uint8)
    return np.concatenate([white, fringe_patterns(shape, rig.procedure.periods_px[-1], 4)])


def focus(light: np.ndarray, counts: np.ndarray) -> float | None:
    """How sharp a picture is, in 1/px²: the gradient's mean square over the square of the mean grey value.

    Neither exposure nor light changes it, apart from noise. It compares pictures of one part in one place: a part
    without texture has no focus but that of the fringes, their modulation.

    Parameters
    ----------
    light : (rows, cols) float32
        Grey values above black.
    counts : (rows, cols) bool
        Pixels that count; gradients count where their four neighbours do.

    Returns
    -------
    float or None
        None where no pixel counts.
    """
    inside = counts[1:-1, 1:-1] & counts[:-2, 1:-1] & counts[2:, 1:-1] & counts[1:-1, :-2] & counts[1:-1, 2:]
    if not inside.any():
        return None
    down = (light[2:, 1:-1] - light[:-2, 1:-1])[inside] / 2
    right = (light[1:-1, 2:] - light[1:-1, :-2])[inside] / 2
    mean = float(light[1:-1, 1:-1][inside].mean())
    return float((down**2 + right**2).mean()) / mean**2


def judge_round(frames: Frames, full_scale_dn: float) -> Round:
    """Figures and pictures of the frames of `patterns`.

    Parameters
    ----------
    frames : Frames
        Of five frames.
    full_scale_dn : float
        What is shown as 255: of a camera whose frames do not clip, ``frames.full_scale_dn`` is infinite.
    """
    black = np.float32(frames.black_level_dn)
    white = frames.stack[0].astype(np.float32) - black
    modulation, mean = modulation_maps(frames.stack[1:], frames.black_level_dn)
    light = white - mean  # half of the projector's, without that of the room
    is_dark = bright_part(light) < _LEAST_LIGHT * full_scale_dn
    lit = np.zeros(mean.shape, dtype=bool) if is_dark else lit_pixels(light)
    clips = frames.stack >= frames.full_scale_dn
    counts = lit & (mean > 0) & ~clips.any(axis=0)
    contrast = np.full(mean.shape, np.nan, dtype=np.float32)
    np.divide(modulation, mean, out=contrast, where=lit & (mean > 0))
    return Round(
        image=np.clip(white * (255 / (full_scale_dn - black)), 0, 255).astype(np.uint8),
        saturated=clips[0],
        contrast=contrast,
        exposure_us=frames.exposure_us,
        stage_position_mm=frames.stage_position_mm,
        saturated_share=float(clips[0].mean()),
        modulation_dn=float(np.median(modulation[counts])) if counts.any() else None,
        modulation=median_contrast(modulation, mean, counts),
        focus=None if is_dark else focus(white, ~clips[0]),
    )


def picture(seen: Round, layer: str) -> np.ndarray:
    """A layer of ``LAYERS`` as (rows, cols, 3) uint8 in OpenCV's order, BGR.

    The image is grey with red where it saturates; modulation goes from 0 to 1 of the mean in false colour, and is black
    where there is no light.
    """
    if layer == "image":
        shown = np.repeat(seen.image[..., None], 3, axis=2)
        shown[seen.saturated] = _RED
        return shown
    lit = np.isfinite(seen.contrast)
    shown = cv2.applyColorMap(np.rint(255 * np.clip(np.where(lit, seen.contrast, 0), 0, 1)).astype(np.uint8), _COLOURS)
    shown[~lit] = 0
    return shown


class View:
    """What the page shows now; the capturing thread writes it, those of requests read it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: Round | None = None
        self._number = 0
        self._frames_per_s: float | None = None
        self._error: str | None = None
        self._told = threading.Event()

    def show(self, seen: Round, frames_per_s: float) -> None:
        """Put a new round in place of the last."""
        with self._lock:
            self._seen, self._frames_per_s = seen, frames_per_s
            self._number += 1

    def fail(self, error: str) -> None:
        """Say what ended it, and wait a moment for a page to fetch that."""
        with self._lock:
            self._error = error
        self._told.wait(_TOLD_S)

    @property
    def seen(self) -> Round | None:
        """The newest round."""
        with self._lock:
            return self._seen

    def state(self) -> dict[str, float | int | str | None]:
        """The newest figures, as JSON knows them: what there is not, or not yet, is None."""
        with self._lock:
            seen, number, frames_per_s, error = self._seen, self._number, self._frames_per_s, self._error
        if error is not None:
            self._told.set()
        names = ("exposure_us", "stage_position_mm", "saturated_share", "modulation_dn", "modulation", "focus")
        figures = {name: getattr(seen, name, None) for name in names} | {"frames_per_s": frames_per_s}
        finite = {
            name: value if value is not None and math.isfinite(value) else None for name, value in figures.items()
        }
        return {"round": number, **finite, "error": error}


def watch(rig: Rig, view: View, rounds: int | None = None) -> None:
    """Capture rounds of an open rig and show them; without ``rounds`` until interrupted.

    Raises
    ------
    InputError
        As the rig does.
    """
    projected, full_scale_dn = patterns(rig), rig.camera.full_scale_dn
    number, began = 0, time.monotonic()
    while rounds is None or number < rounds:
        seen = judge_round(rig.capture(projected), full_scale_dn)
        ended = time.monotonic()
        view.show(seen, len(projected) / max(ended - began, 1e-6))
        number, began = number + 1, ended


@contextmanager
def serving(view: View, port: int, host: str = LOOPBACK) -> Iterator[str]:
    """Serve the page while the context lasts; then no thread and no socket of it are left.

    Parameters
    ----------
    view : View
    port : int
        0 takes any that is free.
    host : str
        There is no other than 127.0.0.1: the pictures are for whoever sits here.

    Yields
    ------
    str
        The page's address.

    Raises
    ------
    InputError
        For another host, and for a port that is taken or is none.
    """
    if host != LOOPBACK:
        raise InputError(f"the live page cannot be served on {host}: {LOOPBACK} alone keeps it on this machine")
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: give a port from 1 to 65535, or 0 for any that is free")
    try:
        server = _Server((host, port), _Handler)
    except OSError as error:
        raise InputError(
            f"the live page cannot be served on port {port} ({error.strerror}): give another by --port, or 0 for any "
            "that is free"
        ) from None
    server.view = view
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="live page")
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        thread.join()
        server.hang_up()
        server.server_close()  # which waits for the threads of requests


class _Server(ThreadingHTTPServer):
    """Knows its connections, so that none outlives it."""

    daemon_threads = False
    view: View

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]):
        self._connections: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.page, self.policy = _page()
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._connections.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._connections.discard(request)
        super().shutdown_request(request)

    def hang_up(self) -> None:
        """End all connections, whatever they wait for."""
        with self._lock:
            for connection in self._connections:
                try:
                    connection.shutdown(socket.SHUT_RDWR)
                except OSError:  # it has ended of itself
                    _log.debug("a connection had ended")

    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.debug("a request failed", exc_info=True)  # a browser that goes away in the middle of an answer


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout: ClassVar[float] = _REQUEST_S
    server_version, sys_version = "greenough", ""

    def do_GET(self) -> None:
        if not self._is_local():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"this page is for this machine alone\n")
            return
        url = urlsplit(self.path)
        if url.path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif url.path == "/state.json":
            state = json.dumps(self.server.view.state(), allow_nan=False, ensure_ascii=False)
            self._answer(HTTPStatus.OK, "application/json", state.encode())
        elif url.path == "/picture.png":
            self._picture(parse_qs(url.query))
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such page\n")

    def do_POST(self) -> None:
        self._answer(HTTPStatus.METHOD_NOT_ALLOWED, "text/plain", b"here is nothing to be changed\n", {"Allow": "GET"})

    do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_HEAD = do_POST

    def _is_local(self) -> bool:
        """Whether the browser means this machine: a foreign name that resolves to it must not read what is here."""
        names = self.headers.get_all("Host", [])
        return len(names) == 1 and re.sub(r":\d{1,5}$", "", names[0].strip().lower()) in _HOSTS

    def _picture(self, query: Mapping[str, list[str]]) -> None:
        layer, seen = query.get("layer", ["image"])[0], self.server.view.seen
        if layer not in LAYERS:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such layer\n")
        elif seen is None:
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"nothing has been captured yet\n")
        else:
            self._answer(HTTPStatus.OK, "image/png", cv2.imencode(".png", picture(seen, layer), _FAST_PNG)[1].tobytes())

    def _answer(self, status: HTTPStatus, kind: str, body: bytes, more: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": self.server.policy,
            "Cache-Control": "no-store",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        for name, value in (headers | dict(more or {})).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        _log.debug(format, *args)


def _page() -> tuple[bytes, str]:
    """The page, and the policy that lets nothing but its own script, style and pictures work."""
    text = (resources.files("greenough.instrument") / "live.html").read_text(encoding="utf-8")
    own = {tag: _digest(re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[0]) for tag in ("script", "style")}
    policy = (
        f"default-src 'none'; script-src '{own['script']}'; style-src '{own['style']}'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return text.encode(), policy


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
