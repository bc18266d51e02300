"""The verb ``decode``: frames from files to a phase map in one file."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from greenough.instrument.errors import InputError
from greenough.instrument.verbs import JsonOption, show

from .fringes import PAPER, FringeSet

if TYPE_CHECKING:
    import numpy as np

app = typer.Typer()

_Number = TypeVar("_Number", int, float)

KIND = "greenough phase map"
VERSION = 1

_UNITS = {"absolute": "rad", "modulation": "DN", "background": "DN", "valid": "1", "residual": "rad", "sigma": "rad"}


def _listed(values: Sequence[float]) -> str:
    return ",".join(f"{value:g}" for value in values)


@app.command()
def decode(
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAMES...",
            help="Images in the order of the patterns, or one .npy or .h5 file with the whole stack "
            "(FILE.h5:DATASET where there are several).",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.h5", help="The phase map to write.")],
    periods: Annotated[str, typer.Option("--periods", help="Fringe periods, columns.")] = _listed(PAPER.periods),
    steps: Annotated[str, typer.Option("--steps", help="Phase steps of each period.")] = _listed(PAPER.steps),
    as_json: JsonOption = False,
) -> None:
    """Decode phase-shifted frames to phase, modulation, background."""
    import numpy as np

    from greenough.instrument import hdf5

    from .decode import decode as decode_stack

    fringes = FringeSet(_numbers(periods, "--periods", float), _numbers(steps, "--steps", int))
    if out.suffix != ".h5":
        raise InputError(f"phase map {out}: the name must end in .h5")
    phase_map = decode_stack(read_stack(frames), fringes)
    with hdf5.create(out, KIND, VERSION) as file:
        file.attrs["periods_px"] = fringes.periods
        file.attrs["steps"] = fringes.steps
        for name, units in _UNITS.items():
            hdf5.put(file, name, getattr(phase_map, name), units)
    valid = phase_map.valid
    show(
        {
            "out": out,
            "shape": valid.shape,
            "valid_share": valid.mean(),
            "median_modulation_dn": np.median(phase_map.modulation[valid]) if valid.any() else None,
            "median_sigma_rad": np.median(phase_map.sigma[valid]) if valid.any() else None,
        },
        as_json,
    )


def read_stack(names: Sequence[str]) -> "np.ndarray":
    """Frames from image files, or from one file that holds them all.

    Parameters
    ----------
    names : sequence of str
        Grey images of one size and type; or one ``.npy`` file; or one ``.h5`` file, followed by ``:DATASET`` where it
        holds several stacks.

    Returns
    -------
    (frames, rows, cols) array

    Raises
    ------
    InputError
        If a file is missing or unreadable, or the images do not fit together.
    """
    import numpy as np

    if len(names) == 1:
        path, _, dataset = names[0].partition(".h5:")
        if dataset or path.endswith(".h5"):
            return _read_hdf5(_existing(path + ".h5" if dataset else path), dataset)
        if path.endswith(".npy"):
            try:
                return np.load(_existing(path), allow_pickle=False)
            except (OSError, ValueError, EOFError):
                raise InputError(f"{path} is not a whole .npy file of numbers") from None
    images = [_read_image(_existing(name)) for name in names]
    first = images[0]
    for name, image in zip(names, images, strict=True):
        if image.shape != first.shape or image.dtype != first.dtype:
            raise InputError(
                f"{name} is {image.shape[1]} x {image.shape[0]} {image.dtype}, but {names[0]} is "
                f"{first.shape[1]} x {first.shape[0]} {first.dtype}; all frames must be alike"
            )
    return np.stack(images)


def _read_image(path: Path) -> "np.ndarray":
    import cv2
    import numpy as np

    image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if path.stat().st_size else None
    if image is None:
        raise InputError(f"{path} is not an image; give PNG or TIFF files, or one .npy or .h5 file")
    if image.ndim != 2:
        raise InputError(f"{path} has {image.shape[2]} channels; give grey images")
    return image


def _read_hdf5(path: Path, dataset: str) -> "np.ndarray":
    import h5py
    import numpy as np

    stacks = []
    try:
        with h5py.File(path, "r") as file:
            if not dataset:
                file.visititems(lambda name, item: stacks.append(name) if getattr(item, "ndim", 0) == 3 else None)
                if len(stacks) != 1:
                    found = f"{len(stacks)} stacks ({', '.join(stacks[:3])}, ...)" if stacks else "no stack"
                    raise InputError(f"{path} holds {found}; name one with three dimensions as {path}:DATASET")
                dataset = stacks[0]
            if not isinstance(item := file.get(dataset), h5py.Dataset):
                raise InputError(f"{path} holds no dataset {dataset}")
            return np.asarray(item[()])
    except (OSError, RuntimeError):
        raise InputError(f"{path} is damaged, truncated or not HDF5") from None


def _existing(name: str) -> Path:
    path = Path(name)
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    return path


def _numbers(text: str, option: str, kind: type[_Number]) -> tuple[_Number, ...]:
    try:
        return tuple(kind(item) for item in text.split(","))
    except ValueError:
        whole = "whole " if kind is int else ""
        raise InputError(
            f"{option} {text}: must be {whole}numbers separated by commas, as in {_listed((8, 4))}"
        ) from None
