"""What a profilometer offers, whether it is made of glass, of a renderer, or of a recording.

The pipeline is written against this module alone. Lengths are mm and times s unless a name says otherwise.
"""

from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Protocol, Self

import numpy as np

PRINTED: Literal["printed"] = "printed"
BLANK: Literal["blank"] = "blank"


@dataclass(frozen=True)
class Placement:
    """What a person lays under the microscope.

    Parameters
    ----------
    part : str
        ``"board"`` (the calibration board), the name of a sample the rig knows (``"coin"``), or the path of a mesh
        file.
    posture : int or None
        For a board held tilted: the number of the posture, from 0. None for a part that lies flat on the table; the
        board lying flat is the posture that carries the z = 0 plane.
    face : "printed" or "blank"
        Which side of the board is up.
    unit : str
        Unit of a mesh file: ``"mm"``, ``"um"``, ``"m"`` or ``"inch"``.
    pose_mm_deg : tuple of 6 floats
        Where a person puts a sample or a mesh file: rotations about x, y, z in degrees, applied in that order, after
        which it is shifted by x, y, z in mm.
    material : str or None
        What the part of a mesh file is made of, by a name that the rig knows; None leaves it to the rig.
    """

    part: str
    posture: int | None = None
    face: Literal["printed", "blank"] = PRINTED
    unit: str = "mm"
    pose_mm_deg: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    material: str | None = None


@dataclass(frozen=True)
class Frames:
    """One captured sequence: an exposure per pattern.

    Parameters
    ----------
    stack : (frames, rows, cols) uint8, uint16 or float32
        Grey values.
    full_scale_dn : float
        Grey value at which the camera clips; infinite where it does not.
    black_level_dn : float
        Grey value without light.
    exposure_us, gain_db : float
        As the camera reported them.
    stage_position_mm : float
        The stage's own reading, not the truth.
    serials : (frames,) int64
        The camera's frame counter; it goes on from sequence to sequence and names each exposure of a run.
    times_s : (frames,) float64
        Start of each exposure since the rig was opened.
    run : str
        Name of the run that the counter belongs to.
    """

    stack: np.ndarray
    full_scale_dn: float
    black_level_dn: float
    exposure_us: float
    gain_db: float
    stage_position_mm: float
    serials: np.ndarray
    times_s: np.ndarray
    run: str = ""

    def _repr_html_(self) -> str:
        from .notebook import frames_html

        return frames_html(self)


@dataclass(frozen=True)
class CameraNoise:
    """The camera's data sheet by EMVA 1288, as the rig file states it: what weights a merge, never a correction."""

    full_well_e: float
    read_noise_e: float
    electrons_per_dn: float


@dataclass(frozen=True)
class KnownUncertainty:
    """What no calibration can show of its own errors, as the rig file states it: certificates and experience.

    Parameters
    ----------
    board_scale : float
        Relative standard uncertainty of the calibration board's mean pitch, from its certificate.
    table_drift_mm : float
        Drift of the specimen table against the microscope, along each axis: standard deviation after as many exposures
        as a whole calibration takes, of a random walk that begins with the run.
    path_drift_mm : float
        The same of the projected picture against the camera, along its columns, at the specimen.
    """

    board_scale: float
    table_drift_mm: float
    path_drift_mm: float


@dataclass(frozen=True)
class SpotBoard:
    """Nominal calibration board: white spots on dark ink, or dark ones on white, as its drawing says.

    ``big`` lists the (row, col) indices of the large spots, which break the symmetry of the grid; where there are none,
    the whole grid must be seen, and its columns run to the right in every picture rather than to the left.

    Spot (row, col) is nominally at ``((col - (cols - 1) / 2) * pitch_mm, ((rows - 1) / 2 - row) * pitch_mm)``: columns
    along +x, rows downwards along -y, the origin in the middle of the grid.
    """

    rows: int
    cols: int
    pitch_mm: float
    big_diameter_mm: float
    small_diameter_mm: float
    size_mm: float
    big: tuple[tuple[int, int], ...]
    dark_spots: bool = False

    def centres(self) -> np.ndarray:
        """Nominal centres, (rows * cols, 2) in mm, row by row."""
        row, col = np.divmod(np.arange(self.rows * self.cols), self.cols)
        x = (col - (self.cols - 1) / 2) * self.pitch_mm
        y = ((self.rows - 1) / 2 - row) * self.pitch_mm
        return np.stack([x, y], axis=-1)

    def diameters(self) -> np.ndarray:
        """Nominal diameters, (rows * cols,) in mm, row by row."""
        diameters = np.full(self.rows * self.cols, self.small_diameter_mm)
        diameters[[row * self.cols + col for row, col in self.big]] = self.big_diameter_mm
        return diameters


@dataclass(frozen=True)
class Procedure:
    """How this rig is calibrated and measured: the paper's Table 1 and section 4, as the rig file states them.

    The n-th of the N frames of a period p is A + B cos(2π x / p + start + sign 2π n / N) on the projector's column x.
    """

    periods_px: tuple[float, ...]
    steps: tuple[int, ...]
    postures: int
    planes: int
    plane_step_mm: float  # between neighbours; their median where heights_mm is given
    exposure_share: float  # of full scale, for the brightest part that counts
    brackets: tuple[float, ...] = field(default=(1.0,))  # exposure ratios for shiny parts, the longest first
    field_px: float | None = None  # lit columns, where no period spans them
    start_rad: float = 0.0
    sign: int = 1
    heights_mm: tuple[float, ...] = ()  # of the planes, rising, where they are not evenly spaced about 0
    gray_bits: int = 0  # of a Gray code that is shown after the fringes, its coarsest bit first
    gray_width_px: float | None = None  # columns of its stripes; a finest period where it is not given
    gray_inverse: bool = False  # each bit is followed by its inverse
    fringes_on_postures: bool = True  # without, the board's postures are shown in white light alone
    posture_names: tuple[str, ...] = ()  # of the tilted ones, in sentences, where they are not called by their numbers

    @property
    def exposures(self) -> int:
        """Of a whole calibration: every posture and plane with every pattern."""
        patterns = sum(self.steps) + self.gray_bits * (2 if self.gray_inverse else 1)
        return self.postures * (patterns if self.fringes_on_postures else 1) + self.planes * patterns


@dataclass(frozen=True)
class RigIdentity:
    """Which instrument this is: a calibration belongs to one identity.

    ``settings_sha256`` is the digest of the rig file with all its overrides; a run is resumed only if it is the same.
    """

    name: str
    camera_serial: str
    projector_serial: str
    settings_sha256: str


@dataclass(frozen=True)
class DeviceReport:
    """A device that answers, as it says itself; ``firmware`` is empty where it does not say."""

    role: Literal["projector", "camera", "stage"]
    name: str
    identity: str
    firmware: str


class Camera(Protocol):
    """A monochrome camera."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        ...

    @property
    def full_scale_dn(self) -> float: ...

    @property
    def black_level_dn(self) -> float: ...

    @property
    def noise(self) -> CameraNoise | None:
        """None where nobody states it: the frames themselves then have to show it."""
        ...

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        """Both are the same where frames are as they were once taken."""
        ...

    @property
    def exposure_us(self) -> float: ...

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        """Raises InputError outside ``exposure_limits_us``, before anything is sent."""
        ...


class Projector(Protocol):
    """A pattern projector; ``shape`` is (rows, cols) of its mirrors."""

    @property
    def shape(self) -> tuple[int, int]: ...


class Stage(Protocol):
    """A linear stage along z, upwards positive."""

    @property
    def limits_mm(self) -> tuple[float, float]: ...

    @property
    def position_mm(self) -> float: ...

    def move_to_mm(self, position: float) -> None:
        """Move and wait. Raises InputError outside ``limits_mm``, before anything is sent."""
        ...


class Operator(Protocol):
    """The hands: asks a person at the real rig, moves the part in the twin, picks the recording in a replay."""

    def place(self, placement: Placement) -> None: ...


class Rig(Protocol):
    """A profilometer. Connecting neither moves nor lights anything; leaving the context is safe."""

    @property
    def identity(self) -> RigIdentity: ...

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        """Which devices answer, as they say themselves; none in a replay."""
        ...

    @property
    def board(self) -> SpotBoard: ...

    @property
    def procedure(self) -> Procedure: ...

    @property
    def uncertainty(self) -> KnownUncertainty: ...

    @property
    def camera(self) -> Camera: ...

    @property
    def projector(self) -> Projector: ...

    @property
    def stage(self) -> Stage: ...

    @property
    def operator(self) -> Operator: ...

    def capture(self, patterns: np.ndarray) -> Frames:
        """Project each of ``patterns``, (N, rows, cols) uint8, for one exposure and return the N frames."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None: ...
