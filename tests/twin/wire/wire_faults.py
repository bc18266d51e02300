"""The faults of a rig of devices: how each strikes, what mends it, and what a calibration with it must keep to."""

import multiprocessing
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from faulty_calibration import (
    DEVIATION_LIMIT,
    ERROR_LIMIT_UM,
    TIMEOUTS_S,
    Bench,
    Call,
    Outcome,
    left_since,
    missing_exposures,
    resources,
)

from greenough.instrument.aravis import REPLY_TIMEOUT_S
from greenough.twin.wire.gige_stream import FrameFault
from greenough.twin.wire.lightcrafter import Fault, at_request
from greenough.twin.wire.line_faults import doubled, preceded_by, truncated, wrong_checksum

PROJECTOR_S = TIMEOUTS_S["lightcrafter.busy_s"] + 4 * TIMEOUTS_S["lightcrafter.timeout_s"]
"""How long an error of the projector may take, by its driver."""

STAGE_S = 4 * TIMEOUTS_S["zaber.reply_timeout_s"] + 3 * TIMEOUTS_S["zaber.settle_timeout_s"]
"""Of the stage: an answer and three more for stopping, and the rest of a motion, which is short, each time."""

CAMERA_S = max(TIMEOUTS_S["genicam.frame_timeout_s"], REPLY_TIMEOUT_S) + REPLY_TIMEOUT_S
"""Of the camera: a frame, or an answer, and then to let go of its stream."""

OPERATOR_S = TIMEOUTS_S["operator.wait_s"]

LEAVING_S = CAMERA_S + STAGE_S + PROJECTOR_S
"""How long the rig may take to be left: each device may be silent."""

BUSY_MACHINE_S = 5.0
"""More than any stated time, where the machine has other things to do."""

EVENTS = {
    "request": 1600,
    "upload": 1300,
    "message": 100,
    "move": 14,
    "trigger": 190,
    "place": 7,
    "any": 1950,
}
"""How many of each come in every calibration at least."""

STRANGERS = [
    b"!01 1 IDLE --\r\n",
    b"#01 1 cont something\r\n",
    b"@02 1 OK IDLE -- 999\r\n",
    b"@01 1 OK IDLE -- 999\r\n",
    b"\xff\xfe rubbish \x00\r\n",
]
_ENDLESS = 10**9


@dataclass(frozen=True)
class Kind:
    """One way in which something goes wrong.

    Parameters
    ----------
    device : str
        By which an error must be told: how its name begins. Any will do where this is empty.
    events : tuple of str
        Of one of which a random one is when it strikes.
    strike : callable
        Of the bench and a source of chance.
    bound_s : float
        How long the error may take.
    harmless : bool
        Whether the calibration must go on to its end.
    must_end : bool
        Whether it must end in an error. If neither is said, either will do.
    mend : callable
        What a person does about it; then comes the second call.
    homes : bool
        Whether a person homes the stage then.
    hears, obeys : bool
        Whether the projector can be told to be dark, and the stage to stop.
    """

    device: str
    events: tuple[str, ...]
    strike: Callable[[Bench, Random], None]
    bound_s: float
    harmless: bool = False
    must_end: bool = True
    mend: Callable[[Bench], None] = lambda bench: None
    homes: bool = False
    hears: bool = True
    obeys: bool = True

    @property
    def role(self) -> str:
        """Of the device in the rig; empty for several."""
        first_word = self.device.partition(" ")[0]
        return {"Zaber": "stage"}.get(first_word, first_word)


def _projector(fault: Fault, count: int = 1, events: tuple[str, ...] = ("request",), **more) -> Kind:
    def strike(bench: Bench, chance: Random) -> None:
        bench.projector_faults = at_request(0, fault, count)

    return Kind("projector at 127.0.0.1", events, strike, PROJECTOR_S, mend=_speak_projector, **more)


def _stage(strike: Callable[[Bench, Random], None], events: tuple[str, ...] = ("message",), **more) -> Kind:
    return Kind("Zaber stage 1 on socket://127.0.0.1", events, strike, STAGE_S, **more)


def _spoiled(how: Callable[[bytes], list[bytes]], **more) -> Kind:
    return _stage(lambda bench, chance: bench.rig.stage.spoil(how), **more)


def _frame(fault: Callable[[Random], FrameFault], **more) -> Kind:
    def strike(bench: Bench, chance: Random) -> None:
        camera = bench.rig.camera
        camera.frame_faults[camera.triggers - 1] = fault(chance)

    return Kind("camera at 127.", ("trigger",), strike, CAMERA_S, **more)


def _speak_projector(bench: Bench) -> None:
    bench.projector_faults = lambda request: Fault.NONE


def _speak_camera(bench: Bench) -> None:
    bench.rig.camera.silent = False
    bench.wait_for_camera()  # which could not be told that its client leaves


def _silence_everything(bench: Bench, chance: Random) -> None:
    bench.projector_faults = at_request(0, Fault.SILENCE, _ENDLESS)
    bench.rig.stage.fall_silent()
    bench.rig.camera.silent = True


def _speak_everything(bench: Bench) -> None:
    _speak_projector(bench)
    bench.rig.stage.speak()
    _speak_camera(bench)


def _kill_camera_process(bench: Bench, chance: Random) -> None:
    for process in multiprocessing.active_children():
        process.kill()


def _interrupt(bench: Bench, chance: Random) -> None:
    """Soon, so that it comes anywhere in the code and not only where an answer is waited for."""
    main = threading.main_thread().ident
    threading.Timer(chance.uniform(0, 0.02), lambda: signal.pthread_kill(main, signal.SIGINT)).start()


def _lose_answer_of_operator(bench: Bench, chance: Random) -> None:
    raise ConnectionResetError


def _keep_operator_waiting(bench: Bench, chance: Random) -> None:
    bench.release_operator.wait()


KINDS: dict[str, Kind] = {
    "projector: TCP reset in mid-upload": _projector(Fault.RESET, events=("upload",)),
    "projector: TCP reset": _projector(Fault.RESET),
    "projector: busy for a while": _projector(Fault.BUSY, 5, harmless=True, must_end=False),
    "projector: busy for too long": _projector(Fault.BUSY, 30),
    "projector: failure reported": _projector(Fault.FAILED, must_end=False),  # to stop, at connecting: it was dark
    "projector: reply lost": _projector(Fault.SILENCE),
    "projector: wrong checksum": _projector(Fault.WRONG_CHECKSUM),
    "projector: truncated reply": _projector(Fault.TRUNCATED),
    "projector: unsolicited reply": _projector(Fault.TWICE),
    "projector: silent": _projector(Fault.SILENCE, _ENDLESS, hears=False),
    "stage: wrong checksum": _spoiled(wrong_checksum),
    "stage: truncated line": _spoiled(truncated),
    "stage: unsolicited lines": _spoiled(preceded_by(*STRANGERS), harmless=True, must_end=False),
    "stage: line twice": _spoiled(doubled, harmless=True, must_end=False),
    "stage: line late": _stage(lambda bench, chance: bench.rig.stage.delay()),
    "stage: line lost": _spoiled(lambda line: []),
    "stage: stall (FS)": _stage(lambda bench, chance: bench.rig.stage.stall(), ("move",), homes=True),
    "stage: emergency stop (FH)": _stage(
        lambda bench, chance: bench.rig.stage.press_emergency_stop(),
        ("message", "message", "request", "trigger"),
        mend=lambda bench: bench.rig.stage.release_emergency_stop(),
        homes=True,
    ),
    "stage: switched off and on": _stage(
        lambda bench, chance: bench.rig.stage.switch_off_and_on(), ("message", "trigger"), homes=True
    ),
    "stage: serial port gone": _stage(
        lambda bench, chance: bench.rig.stage_server.close(),
        ("message", "message", "request", "trigger"),
        mend=lambda bench: bench.reopen_stage_port(),
        obeys=False,  # it ends the motion that it was told, of some tenths of a second
    ),
    "stage: silent": _stage(
        lambda bench, chance: bench.rig.stage.fall_silent(), mend=lambda bench: bench.rig.stage.speak()
    ),
    "camera: frame late": _frame(
        lambda chance: FrameFault("late", delay_s=chance.uniform(0.05, 0.5)), harmless=True, must_end=False
    ),
    # The camera exposes nothing else meanwhile: later than this, the next call's first frame would be too late as well.
    "camera: frame too late": _frame(lambda chance: FrameFault("late", delay_s=chance.uniform(2.2, 3.5))),
    "camera: frame lost": _frame(lambda chance: FrameFault("lost")),
    "camera: frame twice": _frame(lambda chance: FrameFault("sent_twice"), must_end=False),
    "camera: frame nobody asked for": _frame(lambda chance: FrameFault("untriggered"), must_end=False),
    "camera: number skipped": _frame(lambda chance: FrameFault("number_skipped"), must_end=False),
    "camera: packets lost once": _frame(
        lambda chance: FrameFault("packets_lost", share=chance.uniform(0, 0.5)), harmless=True, must_end=False
    ),
    "camera: packets lost for good": _frame(
        lambda chance: FrameFault("packets_lost", share=chance.uniform(0, 0.5), for_good=True)
    ),
    "camera: silent": Kind(
        "camera at 127.",
        ("trigger", "request"),
        lambda bench, chance: setattr(bench.rig.camera, "silent", True),
        CAMERA_S,
        mend=_speak_camera,
    ),
    "camera: its process killed": Kind(
        "camera at 127.",
        ("trigger", "upload"),
        _kill_camera_process,
        CAMERA_S,
        mend=lambda bench: bench.wait_for_camera(),
    ),
    "operator: connection lost": Kind("operator at 127.0.0.1", ("place",), _lose_answer_of_operator, OPERATOR_S),
    "operator: silent": Kind(
        "operator at 127.0.0.1",
        ("place",),
        _keep_operator_waiting,
        OPERATOR_S,
        mend=lambda bench: bench.release_operator.set(),
    ),
    "all devices: silent": Kind(
        "",
        ("request", "message", "trigger"),
        _silence_everything,
        PROJECTOR_S + STAGE_S + CAMERA_S,
        mend=_speak_everything,
        hears=False,
    ),
    "interrupt: Ctrl-C": Kind("interrupt", ("request", "message", "trigger", "place"), _interrupt, STAGE_S),
}


def run(name: str, seed: int, folder: Path) -> Outcome:
    """One calibration with the fault at a random point, and a second call where that has ended it."""
    kind, before = KINDS[name], resources()
    with Bench(folder, seed) as bench:
        order(bench, kind, Random(f"{name} {seed}"))
        first, second = bench.call(), None
        kind.mend(bench)
        if first.calibration is None:
            second = bench.call(home_first=kind.homes)
    return Outcome(first, second, left_since(before))


def order(bench: Bench, kind: Kind, chance: Random, share: float = 1.0) -> None:
    """Have the next call struck at a random one of its events, in the first ``share`` of it."""
    event = chance.choice(kind.events)
    number = chance.randint(1, max(1, round(share * EVENTS[event])))
    bench.at(event, number, kind.role, lambda: kind.strike(bench, chance))


def broken_claims(kind: Kind, outcome: Outcome) -> list[str]:
    """What the requirement says and this outcome does not keep; empty where all is well."""
    first, second = outcome.first, outcome.second
    last = second or first
    claims = {
        "the calibration is made in the end": last.calibration is not None and (last is first or last.error is None),
        f"its heights are right within {ERROR_LIMIT_UM} um": outcome.error_um < ERROR_LIMIT_UM,
        "no thread, socket or port is left": not outcome.left,
    }
    if second is not None:
        least, most = missing_exposures(first.kept)
        claims |= {
            "every frame of the second call is right": second.worst_deviation < DEVIATION_LIMIT,
            "the second call takes only what is missing": least <= second.exposures <= most,
            "the next connection makes it dark": not second.lit_after_connecting and not second.lit,
            "the second call leaves no process": not second.children,
        }
    return broken_by_call(kind, first) + [claim for claim, holds in claims.items() if not holds]


def broken_by_call(kind: Kind, call: Call) -> list[str]:
    """What is required of the call that the fault strikes, and not kept."""
    ended = call.error is not None
    interrupted = kind.role == "interrupt"
    told = isinstance(call.error, KeyboardInterrupt) if interrupted else call.is_typed(kind.device)
    claims = {
        "the fault strikes": call.struck,
        "every frame that is handed out is right": call.worst_deviation < DEVIATION_LIMIT,
        "the error is typed and names device, command and remedy": told or not ended,
        "the error comes in time": not ended or call.after_s < kind.bound_s + BUSY_MACHINE_S,
        "leaving ends in time": call.closing_s < LEAVING_S + BUSY_MACHINE_S,
        "all is safe when the error comes": call.safe_when_told or not (kind.hears and kind.obeys),
        "the projector is dark": not call.lit or not kind.hears,
        "the stage is at rest": not call.moves,
        "no process is left": not call.children,
        "every step that was done is on disk": not ended or len(call.kept) - call.done in (0, int(interrupted)),
        "a harmless fault ends nothing": not (kind.harmless and ended),
        "a harmful fault ends the call": ended or not kind.must_end,
    }
    return [claim for claim, holds in claims.items() if not holds]
