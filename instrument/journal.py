"""What a recording holds beside its frames: the rig as it described itself, and what was asked of it, in order."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from .contract import CameraNoise, KnownUncertainty, Placement, Procedure, Rig, RigIdentity, SpotBoard
from .errors import InputError

KIND = "greenough recording"
VERSION = 2


@dataclass(frozen=True)
class RigDescription:
    """All that a rig tells about itself, at the moment it was connected."""

    identity: RigIdentity
    board: SpotBoard
    procedure: Procedure
    uncertainty: KnownUncertainty
    camera_shape: tuple[int, int]
    full_scale_dn: float
    black_level_dn: float
    noise: CameraNoise | None
    exposure_limits_us: tuple[float, float]
    exposure_us: float
    projector_shape: tuple[int, int]
    stage_limits_mm: tuple[float, float]
    stage_position_mm: float


@dataclass(frozen=True)
class Placed:
    """The operator placed a part."""

    placement: Placement
    event: Literal["placed"] = "placed"


@dataclass(frozen=True)
class Moved:
    """The stage was sent to ``target_mm`` and then read ``reported_mm``."""

    target_mm: float
    reported_mm: float
    event: Literal["moved"] = "moved"


@dataclass(frozen=True)
class Exposed:
    """The exposure time was set to ``target_us`` and then read ``reported_us``."""

    target_us: float
    reported_us: float
    event: Literal["exposed"] = "exposed"


@dataclass(frozen=True)
class Captured:
    """A sequence was captured; the targets are the last ones asked for, the others are those of its Frames."""

    placement: Placement | None
    target_mm: float
    target_us: float
    patterns_sha256: str
    full_scale_dn: float
    black_level_dn: float
    exposure_us: float
    gain_db: float
    stage_position_mm: float
    run: str
    event: Literal["captured"] = "captured"


Event = Placed | Moved | Exposed | Captured

_description = TypeAdapter(RigDescription)
_events = TypeAdapter(list[Event])


def describe(rig: Rig) -> RigDescription:
    """Ask a rig for everything that it tells about itself."""
    camera, stage = rig.camera, rig.stage
    return RigDescription(
        identity=rig.identity,
        board=rig.board,
        procedure=rig.procedure,
        uncertainty=rig.uncertainty,
        camera_shape=camera.shape,
        full_scale_dn=float(camera.full_scale_dn),
        black_level_dn=float(camera.black_level_dn),
        noise=camera.noise,
        exposure_limits_us=camera.exposure_limits_us,
        exposure_us=float(camera.exposure_us),
        projector_shape=rig.projector.shape,
        stage_limits_mm=stage.limits_mm,
        stage_position_mm=float(stage.position_mm),
    )


def to_json(entry: RigDescription | Sequence[Event]) -> str:
    """JSON text; floats keep every bit."""
    plain = asdict(entry) if isinstance(entry, RigDescription) else [asdict(event) for event in entry]
    return json.dumps(plain, ensure_ascii=False)


def description_from_json(text: str, where: str) -> RigDescription:
    """The reverse of ``to_json``; raises InputError when a field is missing or wrong."""
    try:
        return _description.validate_python(json.loads(text))
    except (ValidationError, json.JSONDecodeError):
        raise InputError(f"{where} is damaged: its description of the rig is not of this version") from None


def events_from_json(text: str, where: str) -> list[Event]:
    """The reverse of ``to_json``; raises InputError when a field is missing or wrong."""
    try:
        return _events.validate_python(json.loads(text))
    except (ValidationError, json.JSONDecodeError):
        raise InputError(f"{where} is damaged: its journal is not of this version") from None


def patterns_sha256(patterns: np.ndarray) -> str:
    """Digest by which a replay knows a sequence of patterns, (N, rows, cols) uint8."""
    digest = hashlib.sha256(f"{patterns.shape} ".encode())
    digest.update(np.ascontiguousarray(patterns).data)
    return digest.hexdigest()


def capture_group(index: int) -> str:
    """Where the frames of the capture with this number lie in the file."""
    return f"captures/{index:06d}"
