"""Opens a rig by the name of its file: the one place where a driver meets the contract."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from .contract import Rig
from .errors import InputError

IMAGES = "images"
"""In place of a driver: what the rig saw lies in files, which need neither a stage nor a camera's data sheet, so that
their rig file is another."""


def open_rig(
    name_or_path: str | Path, overrides: Sequence[str] = (), run: str = "default", exposures_done: int = 0
) -> Rig:
    """Open the rig that a rig file describes, be it of devices or of images, or replay a recording.

    Parameters
    ----------
    name_or_path : str or Path
        A built-in name, the path of a rig file, or the path of a recording (``.h5``).
    overrides : sequence of str
        Settings that replace those of the file, ``"twin.seed=2"`` each. A recording takes none.
    run : str
        Name of the run whose exposures are counted. A replay keeps the name that was recorded.
    exposures_done : int
        Exposures that an interrupted run has already taken; counting goes on from there.

    Raises
    ------
    InputError
        For an unknown rig, a wrong rig file or recording, or a driver that is not installed.
    """
    if Path(name_or_path).suffix == ".h5":
        from .replay import open_recording

        if overrides:
            raise InputError(f"recording {name_or_path} cannot be changed by --set {overrides[0]}; leave --set out")
        return open_recording(name_or_path, exposures_done)

    from .rigfile import RigFile, read_rig, validated_rig

    where, document = read_rig(name_or_path, overrides)
    if document.get("driver") == IMAGES:
        from .image_rig import ImageRig
        from .image_rig_settings import ImageRigFile

        return ImageRig(validated_rig(where, document, ImageRigFile), Path(name_or_path).parent, run, exposures_done)
    rig_file = validated_rig(where, document, RigFile)
    module_name, _, function_name = rig_file.driver.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # A module missing inside an installed driver is that driver's bug and stays a traceback.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise InputError(
            f"rig {name_or_path} needs the driver {rig_file.driver}, but there is no module {error.name}; install it"
        ) from None
    function = getattr(module, function_name, None)
    if function is None:
        raise InputError(f"rig {name_or_path} needs the driver {rig_file.driver}, but there is no such function")
    return cast(Rig, function(rig_file, run=run, exposures_done=exposures_done))
