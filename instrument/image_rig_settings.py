"""The rig file of images: what was shown to somebody's camera and projector, and in which files the frames are."""

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from .contract import Procedure
from .rigfile import BoardSection, ProjectorSection, UncertaintySection, settings_sha256

_SECTION = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
_Text = Annotated[str, Field(min_length=1, max_length=1000)]
_Pixels = Annotated[int, Field(ge=4, le=20_000)]
_Height = Annotated[float, Field(ge=-1000, le=1000)]


class ImageCameraSection(BaseModel):
    """``[camera]``: what its frames are. Their noise is told by the frames themselves.

    With ``bits = 0`` frames are float and do not clip; ``exposure_us`` is what it was, if that is known: nothing
    depends on it.
    """

    model_config = _SECTION
    rows: _Pixels
    cols: _Pixels
    bits: Literal[0, 8, 10, 12, 14, 16] = 8
    black_level_dn: Annotated[float, Field(ge=0, le=60_000)] = 0.0
    exposure_us: Annotated[float, Field(gt=0, le=1e9)] = 1.0

    @model_validator(mode="after")
    def _consistent(self) -> "ImageCameraSection":
        if self.black_level_dn > self.full_scale_dn / 2:
            raise ValueError(f"black_level_dn must be at most half of full scale, {self.full_scale_dn / 2:g}")
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @property
    def full_scale_dn(self) -> float:
        return float(2**self.bits - 1) if self.bits else math.inf

    @property
    def pixel_type(self) -> str:
        """NumPy's name of what the files must hold."""
        return "float32" if self.bits == 0 else "uint8" if self.bits == 8 else "uint16"


class ImageProcedureSection(BaseModel):
    """``[procedure]``: the fringes that were shown, and how many postures and planes there should be.

    The n-th of the N frames of a period p is A + B cos(2π x / p + start + sign 2π n / N). Horizontal fringes count the
    projector's rows for x. Periods are in the order of the frames. The stripes of a Gray code are as wide as the finest
    period or ``gray_width_px``, and with ``gray_inverse`` each of its frames is followed by its inverse.
    """

    model_config = _SECTION
    periods_px: Annotated[tuple[Annotated[float, Field(gt=2, le=20_000)], ...], Field(min_length=1, max_length=16)]
    steps: Annotated[tuple[Annotated[int, Field(ge=3, le=64)], ...], Field(min_length=1, max_length=16)]
    direction: Literal["vertical", "horizontal"] = "vertical"
    start_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    sign: Literal[1, -1] = 1
    gray_width_px: Annotated[float, Field(ge=2, le=20_000)] | None = None
    gray_inverse: bool = False
    postures: Annotated[int, Field(ge=4, le=200)] | None = None
    planes: Annotated[int, Field(ge=3, le=1000)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "ImageProcedureSection":
        if len(self.steps) != len(self.periods_px):
            raise ValueError(f"steps must have as many numbers as periods_px, {len(self.periods_px)}")
        if len(set(self.periods_px)) != len(self.periods_px):
            raise ValueError("periods_px must all be different")
        return self


class ImagesSection(BaseModel):
    """``[images]``: where they are, from the folder of the rig file on.

    Parameters
    ----------
    postures : str
        Pattern of the board's, see `image_groups.grouped`. Each has all fringe frames, or one white picture.
    flat : str, optional
        What stands for ``{}`` of the posture that carries the world: z = 0 is the board's face there. The last one, if
        it is left out.
    planes : str, optional
        The same for the blank planes, of fringes.
    heights_mm : list of float
        Of the planes, in the natural order of their names. Heights rise towards the camera; the plane at 0 lies where
        the flat board's face lay.
    heights_file : str
        In its place: a CSV file of two columns, what stands for ``{}`` and the height in mm.
    plane_step_mm, plane_zero : float
        In its place: what stands for ``{}`` is a number, and the height is (number - zero) times step.
    fringe_frames : str, optional
        Which frames of a place show fringes, from 0, in the order of the periods: ``"3-5,0-2"``.
    gray_frames : str, optional
        Which frames show a Gray code, its coarsest bit first.
    """

    model_config = _SECTION
    postures: _Text
    flat: _Text | None = None
    planes: _Text | None = None
    heights_mm: Annotated[tuple[_Height, ...], Field(min_length=1, max_length=1001)] | None = None
    heights_file: _Text | None = None
    plane_step_mm: _Height | None = None
    plane_zero: float = 0.0
    fringe_frames: _Text | None = None
    gray_frames: _Text | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "ImagesSection":
        said = sum(way is not None for way in (self.heights_mm, self.heights_file, self.plane_step_mm))
        if self.planes is not None and said != 1:
            raise ValueError("planes need one of heights_mm, heights_file and plane_step_mm: how high they lay")
        if self.planes is None and said > 0:
            raise ValueError("planes is missing, and must say where the images of the planes are")
        return self


class ImageRigFile(BaseModel):
    """A validated rig file of images."""

    model_config = _SECTION
    name: Annotated[str, Field(min_length=1, max_length=200)]
    driver: Literal["images"]
    camera: ImageCameraSection
    projector: ProjectorSection
    board: BoardSection
    procedure: ImageProcedureSection
    uncertainty: UncertaintySection
    images: ImagesSection

    @property
    def settings_sha256(self) -> str:
        """Digest of every setting."""
        return settings_sha256(self)

    @property
    def projector_shape(self) -> tuple[int, int]:
        """(rows, cols) as fringes see it, which are vertical: of horizontal ones it lies on its side."""
        rows, cols = self.projector.shape
        return (rows, cols) if self.procedure.direction == "vertical" else (cols, rows)

    def contract(
        self, tilted: tuple[str, ...], heights_mm: tuple[float, ...], gray_frames: int, fringes_on_postures: bool
    ) -> Procedure:
        """The procedure that these images followed, its periods the coarsest first."""
        said = self.procedure
        falling = sorted(zip(said.periods_px, said.steps, strict=True), reverse=True)
        steps = sorted(high - low for low, high in pairwise(heights_mm))
        spans = falling[0][0] >= self.projector_shape[1]
        return Procedure(
            periods_px=tuple(period for period, _ in falling),
            steps=tuple(count for _, count in falling),
            postures=len(tilted) + 1,
            planes=len(heights_mm),
            plane_step_mm=steps[len(steps) // 2] if steps else 0.0,
            exposure_share=1.0,
            field_px=None if spans and not gray_frames else float(self.projector_shape[1]),
            start_rad=math.radians(said.start_deg),
            sign=said.sign,
            heights_mm=heights_mm,
            gray_bits=gray_frames // 2 if said.gray_inverse else gray_frames,
            gray_width_px=said.gray_width_px,
            gray_inverse=said.gray_inverse,
            fringes_on_postures=fringes_on_postures,
            posture_names=tilted,
        )
