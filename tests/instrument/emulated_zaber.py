"""An emulated stage behind its driver, for the tests of either."""

import contextlib

from greenough.instrument.zaber_stage import ZaberSettings, ZaberStage
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel, ZaberDevice

MICROSTEP_UM, ZERO = 0.047625, 100_000
INSTANT = StageModel(travel=200_000, start=30_000, instant=True)
REPLY_S = 0.4  # for answers that do not come: see ``hurry``


@contextlib.contextmanager
def opened(model=INSTANT, terminal=True, limits_mm=(-1.6, 1.6), homed=True, **settings):
    """(device, server, stage) with the stage connected, and homed unless told otherwise."""
    device = ZaberDevice(model)
    with LineServer(device) as server:
        port = server.terminal if terminal else server.url
        with ZaberStage(options(port, **settings), limits_mm) as stage:
            if homed:
                stage.home()
            yield device, server, stage


def options(port: str, **settings) -> ZaberSettings:
    values = {
        "microstep_um": MICROSTEP_UM,
        "zero_microsteps": ZERO,
        "reply_timeout_s": 60.0,
        "settle_timeout_s": 20.0,
        "home_timeout_s": 60.0,
    }
    return ZaberSettings(port=port, **(values | settings))


def hurry(device: ZaberDevice, stage: ZaberStage, message: int) -> None:
    """From message ``message`` on, wait for answers ``REPLY_S`` only; before, as long as a busy machine takes."""
    link = stage._link
    if message == device.messages + 1:
        link._timeout_s = REPLY_S
    else:
        device.at_message(message - 1, lambda: setattr(link, "_timeout_s", REPLY_S))


@contextlib.contextmanager
def hurried(device: ZaberDevice, stage: ZaberStage, message: int):
    """``hurry`` until the context is left."""
    link = stage._link
    patient_s = link._timeout_s
    hurry(device, stage, message)
    try:
        yield
    finally:
        link._timeout_s = patient_s


def heard(device: ZaberDevice) -> list[str]:
    """A growing list of what the device is told."""
    commands, answer = [], device.answer

    def listen(line: bytes) -> list[bytes]:
        commands.append(line.decode().partition(":")[0].split(maxsplit=3)[3:])
        return answer(line)

    device.answer = listen
    return commands
