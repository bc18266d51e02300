"""The verbs of the instrument: check."""

from dataclasses import asdict

import typer

from .verbs import JsonOption, RigArgument, SetOption, show

app = typer.Typer()


@app.command()
def check(rig: RigArgument, settings: SetOption = None, as_json: JsonOption = False) -> None:
    """Connect to a rig, without moving or lighting anything, and report what answers and its limits."""
    from .opening import open_rig

    with open_rig(rig, settings or ()) as opened:
        camera = opened.camera
        result = {
            **asdict(opened.identity),
            "camera_shape": camera.shape,
            "full_scale_dn": camera.full_scale_dn,
            "black_level_dn": camera.black_level_dn,
            **asdict(camera.noise),
            "exposure_limits_us": camera.exposure_limits_us,
            "exposure_us": camera.exposure_us,
            "projector_shape": opened.projector.shape,
            "stage_limits_mm": opened.stage.limits_mm,
            "stage_position_mm": opened.stage.position_mm,
        }
    show(result, as_json)
