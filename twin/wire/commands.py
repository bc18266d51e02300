"""The verb of the emulated devices: serve."""

import sys
import threading
from typing import Annotated

import typer

from greenough.instrument.signals import until_told_to_end
from greenough.instrument.verbs import RunOption, SetOption, show

app = typer.Typer()


@app.command()
def serve(
    rig: Annotated[
        str, typer.Argument(metavar="[RIG]", help="A rig of devices whose addresses are loopback.")
    ] = "wire",
    run: RunOption = "serve",
    exposures_done: Annotated[
        int, typer.Option(min=0, help="Exposures of the run that were served before: noise goes on from there.")
    ] = 0,
    real_time: Annotated[bool, typer.Option("--real-time", help="Let the stage take the time that it takes.")] = False,
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Listen at addresses that other machines can reach.")
    ] = False,
    settings: SetOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print where the devices listen as JSON.")] = False,
) -> None:
    """Emulate a rig's devices around the twin, until interrupted.

    They listen at the rig file's addresses: a LightCrafter on TCP, a GigE Vision camera, a Zaber stage on TCP and on a
    terminal, and a bench that takes placements. Ctrl-C and SIGTERM end it.
    """
    from greenough.instrument.rigfile import load_rig_file

    from .emulated_rig import EmulatedRig
    from .twin_scene import TwinScene

    rig_file = load_rig_file(rig, settings or ())
    scene = TwinScene(rig_file, run)
    emulated = EmulatedRig(
        rig_file,
        scene,
        serial=scene.camera_serial,
        instant_stage=not real_time,
        exposures_done=exposures_done,
        allow_remote=allow_remote,
    )
    with emulated, until_told_to_end():
        show({"rig": rig_file.name, **emulated.addresses}, as_json)
        sys.stdout.flush()
        threading.Event().wait()
