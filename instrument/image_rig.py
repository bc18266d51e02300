"""A rig that once was: somebody's images of a board, of planes and of parts, behind the contract.

Whoever asks for a posture, a height or a part gets the frames that lie in the files, in the order of the patterns. A
posture is a place that ``images.postures`` tells apart, a height is a plane's, and a part is named by the files that
show it. The exposure is what it was, so there is none to set, and the camera's noise is what the frames show. Nothing
but the fringes of the procedure can have been projected, or white light where a place holds one picture alone; any
other pattern is refused. A folder that holds too few frames or too many is refused when it is asked for, and what is
missing altogether when the rig is opened.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Literal, Self

import numpy as np

from .contract import (
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
from .errors import InputError
from .frame_files import FrameFiles, read_frames
from .frame_order import guess_order, selected
from .image_groups import grouped
from .image_rig_settings import ImageCameraSection, ImageRigFile
from .limits import check_patterns, check_within
from .plane_heights import plane_heights

_SAME_MM = 1e-6  # heights that differ by less are one
_NAMED = 3  # files in a sentence


@dataclass(frozen=True)
class Place:
    """What was under the lenses while frames were taken, and where these are.

    Parameters
    ----------
    kind : "posture", "plane" or "part"
    name : str
        As the files call it.
    files : tuple of str
    height_mm : float
        Of a plane; 0 for all else.
    """

    kind: Literal["posture", "plane", "part"]
    name: str
    files: tuple[str, ...]
    height_mm: float = 0.0

    def __str__(self) -> str:
        first, *others = self.files
        return f"{self.kind} {self.name} ({first}{f' and {len(others)} more' if others else ''})"


class ImageRig:
    """Frames in files as a rig. Until frames are asked for only names are looked at, and the flat board's frames.

    Parameters
    ----------
    settings : ImageRigFile
    folder : Path
        Where relative patterns begin.
    run : str
    exposures_done : int
        Exposures that the run has taken already; counting goes on from there.

    Raises
    ------
    InputError
        If there are not the postures and planes that the rig file states, a plane has no height, or none lies at 0.
    """

    def __init__(self, settings: ImageRigFile, folder: Path, run: str = "default", exposures_done: int = 0):
        self._settings, self._run, self._serial = settings, run, exposures_done
        self.tilted, self.flat = _postures(settings, folder)
        self.planes = _planes(settings, folder)
        heights = tuple(height for height in self.planes if abs(height) > _SAME_MM)
        fringes = len(read_frames(self.flat.files).stack) > 1
        names = tuple(place.name for place in self.tilted)
        self.procedure: Procedure = settings.contract(names, heights, _gray_frames(settings), fringes)
        self.camera = _ImageCamera(settings.camera)
        self.projector = _ImageProjector(settings.projector_shape)
        self.stage = _ImageStage(heights)
        self.operator = _ImageOperator()

    @property
    def places(self) -> tuple[Place, ...]:
        """All that a calibration can ask for: the tilted postures, the flat one, and the planes from the lowest up."""
        return (*self.tilted, self.flat, *self.planes.values())

    @property
    def identity(self) -> RigIdentity:
        name = self._settings.name
        return RigIdentity(name, f"camera of {name}", f"projector of {name}", self._settings.settings_sha256)

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        return ()

    @property
    def board(self) -> SpotBoard:
        return self._settings.board.nominal

    @property
    def uncertainty(self) -> KnownUncertainty:
        return self._settings.uncertainty.contract

    def capture(self, patterns: np.ndarray) -> Frames:
        """The frames that the files hold of what was placed, at the height that the stage was sent to.

        Raises
        ------
        InputError
            When there are none, or not as many as patterns, when they do not fit the camera or are damaged, and when
            the patterns are not those that were shown.
        """
        check_patterns(patterns, self.projector.shape)
        place = self._place()
        if len(patterns) == 1 and (patterns == 255).all():
            return self.white(place)
        if self._shown(patterns):
            frames, _, _ = self.fringes(place)
            return frames
        raise InputError(
            f"{place}: the files show the fringes of the rig file's procedure, and nothing is known of {len(patterns)} "
            "other patterns"
        )

    def fringes(self, place: Place) -> tuple[Frames, tuple[str, ...], str]:
        """The frames of a place, the coarsest fringes first, a Gray code last; their names, and why this order.

        Raises InputError as `capture`.
        """
        files, said, images = self._read(place), self._settings.procedure, self._settings.images
        count, wanted = len(files.stack), sum(said.steps)
        gray = selected(images.gray_frames, count, "images.gray_frames") if images.gray_frames else []
        if images.fringe_frames:
            chosen, why = selected(images.fringe_frames, count, "images.fringe_frames"), "images.fringe_frames"
        else:
            chosen, why = [k for k in range(count) if k not in gray], ""
        if len(chosen) != wanted:
            held = f"{count} frames" if len(chosen) == count else f"{len(chosen)} frames of fringes among {count}"
            raise InputError(
                f"{place} holds {held}, but the procedure's steps {list(said.steps)} need {wanted}: add what is "
                "missing, or let images.fringe_frames say which of them show fringes"
            )
        if not why:
            order, why = guess_order([files.names[k] for k in chosen], said.periods_px, said.steps)
            chosen = [chosen[k] for k in order]
        starts = [0, *accumulate(said.steps)]
        coarsest_first = sorted(range(len(said.steps)), key=lambda k: -said.periods_px[k])
        order = [chosen[n] for k in coarsest_first for n in range(starts[k], starts[k + 1])] + gray
        return self._frames(files.stack[order]), tuple(files.names[k] for k in order), why

    def white(self, place: Place) -> Frames:
        """The one white picture of a place; raises InputError as `capture`."""
        files = self._read(place)
        if len(files.stack) != 1:
            raise InputError(
                f"{place} holds {len(files.stack)} frames, where one white picture is asked for; all postures must "
                "hold one, or all the fringes"
            )
        return self._frames(files.stack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def _frames(self, stack: np.ndarray) -> Frames:
        serials = self._serial + np.arange(len(stack), dtype=np.int64)
        self._serial += len(stack)
        return Frames(
            stack=stack,
            full_scale_dn=self.camera.full_scale_dn,
            black_level_dn=self.camera.black_level_dn,
            exposure_us=self.camera.exposure_us,
            gain_db=0.0,
            stage_position_mm=self.stage.position_mm,
            serials=serials,
            times_s=np.full(len(stack), np.nan),  # nobody wrote them down
            run=self._run,
        )

    def _place(self) -> Place:
        """What the files show of the present state."""
        placement = self.operator.placement
        if placement is None:
            raise InputError(f"rig {self._settings.name}: nothing was placed, so there are no images of it")
        if placement.part != "board":
            return Place("part", Path(placement.part).name, (placement.part,))
        if placement.face == BLANK:
            for height, place in self.planes.items():
                if abs(height - self.stage.position_mm) < _SAME_MM:
                    return place
            raise InputError(f"rig {self._settings.name}: images.planes has no plane at {self.stage.position_mm:g} mm")
        if placement.posture is None:
            return self.flat
        if not 0 <= placement.posture < len(self.tilted):
            raise InputError(f"rig {self._settings.name}: images.postures has no posture {placement.posture}")
        return self.tilted[placement.posture]

    def _read(self, place: Place) -> FrameFiles:
        try:
            files, camera = read_frames(place.files), self._settings.camera
        except InputError as error:
            raise InputError(f"{place.kind} {place.name}: {error}") from None
        stack = files.stack
        if stack.ndim != 3 or stack.shape[1:] != camera.shape:
            raise InputError(
                f"{place}: frames are {_size(stack.shape[1:])}, but the rig file's camera has {_size(camera.shape)} "
                "(columns x rows); all must be as that camera took them"
            )
        if camera.bits == 0 and stack.dtype.kind == "f":
            stack = stack.astype(np.float32, copy=False)
        if str(stack.dtype) != camera.pixel_type or stack.max() > camera.full_scale_dn:
            raise InputError(
                f"{place}: frames are {stack.dtype} up to {stack.max():g}, but camera.bits = {camera.bits} are "
                f"{camera.pixel_type} up to {camera.full_scale_dn:g}; set camera.bits to what the camera gave"
            )
        if not np.isfinite(stack).all():
            raise InputError(f"{place}: frames hold values that are not finite")
        return FrameFiles(stack, files.names)

    def _shown(self, patterns: np.ndarray) -> bool:
        """Whether these are the fringes that the procedure says were shown."""
        procedure, column = self.procedure, np.arange(self.projector.shape[1])
        sets = zip(procedure.periods_px, procedure.steps, strict=True)
        turns = [column / p + procedure.sign * n / steps for p, steps in sets for n in range(steps)]
        ideal = 127.5 * (1 + np.cos(2 * np.pi * np.array(turns) + procedure.start_rad))
        if procedure.gray_bits:
            stripe = (column // (procedure.gray_width_px or procedure.periods_px[-1])).astype(int)
            code = [255 * ((stripe ^ (stripe >> 1)) >> bit & 1) for bit in reversed(range(procedure.gray_bits))]
            shown = [values for bit in code for values in ((bit, 255 - bit) if procedure.gray_inverse else (bit,))]
            ideal = np.concatenate([ideal, shown])
        return len(patterns) == len(ideal) and bool((np.abs(patterns[:, 0] - ideal) < 1).all())  # rounding is less


class _ImageCamera:
    """As it was: nothing of it can be set any more."""

    noise: CameraNoise | None = None

    def __init__(self, section: ImageCameraSection):
        self.shape: tuple[int, int] = section.shape
        self.full_scale_dn: float = section.full_scale_dn
        self.black_level_dn: float = section.black_level_dn
        self.exposure_limits_us = (section.exposure_us, section.exposure_us)
        self._exposure_us = section.exposure_us

    @property
    def exposure_us(self) -> float:
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self.exposure_limits_us, "exposure time", "us")


class _ImageProjector:
    def __init__(self, shape: tuple[int, int]):
        self.shape = shape


class _ImageStage:
    """Goes anywhere between the planes: only a capture where there is none has no answer."""

    def __init__(self, heights: Sequence[float]):
        self.limits_mm = min((0.0, *heights)), max((0.0, *heights))
        self.position_mm = 0.0

    def move_to_mm(self, position: float) -> None:
        check_within(position, self.limits_mm, "stage position", "mm")
        self.position_mm = float(position)


class _ImageOperator:
    def __init__(self) -> None:
        self.placement: Placement | None = None

    def place(self, placement: Placement) -> None:
        """Raises InputError when a part's images are to be anything else than read."""
        plain = Placement(placement.part, placement.posture, placement.face)
        if placement != plain:
            raise InputError(f"{placement.part} lies where it lay when its images were taken: leave unit and pose out")
        self.placement = placement


def _gray_frames(settings: ImageRigFile) -> int:
    """How many show a Gray code."""
    chosen, what = settings.images.gray_frames, "images.gray_frames"
    count = len(selected(chosen, 10**6, what)) if chosen else 0
    if count > 60 or (settings.procedure.gray_inverse and count % 2):
        raise InputError(f"{what} = {chosen}: there must be at most 60, and with gray_inverse an even number of them")
    return count


def _postures(settings: ImageRigFile, folder: Path) -> tuple[tuple[Place, ...], Place]:
    """The tilted ones, and the flat one that carries the world."""
    groups = grouped(settings.images.postures, folder, "images.postures")
    _check_count(list(groups), settings.procedure.postures, "postures")
    flat = settings.images.flat or list(groups)[-1]
    if flat not in groups:
        raise InputError(f'images.flat = "{flat}" is no posture; there are {_listed(list(groups))}')
    places = {name: Place("posture", name, tuple(files)) for name, files in groups.items()}
    return tuple(place for name, place in places.items() if name != flat), places[flat]


def _planes(settings: ImageRigFile, folder: Path) -> dict[float, Place]:
    """By height, from the lowest up; none where the rig file names none."""
    if settings.images.planes is None:
        return {}
    groups = grouped(settings.images.planes, folder, "images.planes")
    _check_count(list(groups), settings.procedure.planes, "planes")
    heights = plane_heights(settings.images, list(groups), folder)
    if min(abs(height) for height in heights.values()) > _SAME_MM:
        raise InputError(
            f"none of the {len(heights)} planes is at height 0, where the board's face lay in the flat posture: add "
            "it, or count heights from a plane that lay there; for the bundle any plane near it will do"
        )
    return {height: Place("plane", name, tuple(groups[name]), height) for name, height in heights.items()}


def _check_count(names: list[str], stated: int | None, what: str) -> None:
    if stated is not None and len(names) != stated:
        raise InputError(
            f"images.{what} matches {len(names)} {what}, but procedure.{what} is {stated}; there are {_listed(names)}"
        )


def _listed(names: list[str]) -> str:
    if len(names) <= 2 * _NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:_NAMED])}, ..., {names[-1]}"


def _size(shape: Sequence[int]) -> str:
    return " x ".join(str(length) for length in reversed(shape))
