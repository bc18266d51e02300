"""Lens prescriptions: the surfaces of a path as they were designed, as data."""

import tomllib
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import describe_validation_error

from .glasses import AIR, GLASSES

BUILT_IN = ("camera", "projector")

_STRICT = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
_Length = Annotated[float, Field(gt=0, le=10_000)]


class Surface(BaseModel):
    """A sphere or plane centred on the axis, and what lies behind it as seen from the specimen."""

    model_config = _STRICT
    element: Annotated[str, Field(min_length=1, max_length=100)]
    radius: Annotated[float, Field(ge=-1e6, le=1e6)]  # positive: centre on the far side from the specimen; 0: plane
    thickness: _Length  # to the next vertex, or to the image
    glass: str
    semi_diameter: _Length
    is_stop: bool = False

    @field_validator("glass")
    @classmethod
    def _known(cls, value: str) -> str:
        if value != AIR and value not in GLASSES:
            raise ValueError(f"must be one of {', '.join((AIR, *GLASSES))}, not {value!r}")
        return value

    @property
    def curvature(self) -> float:
        """1 / radius, in 1/mm."""
        return 1 / self.radius if self.radius else 0.0


class Image(BaseModel):
    """The sensor or the mirror array: its lit area in mm and in pixels."""

    model_config = _STRICT
    width: _Length
    height: _Length
    cols: Annotated[int, Field(ge=1, le=20_000)]
    rows: Annotated[int, Field(ge=1, le=20_000)]

    @property
    def pitch(self) -> tuple[float, float]:
        """(column, row) pitch in mm."""
        return self.width / self.cols, self.height / self.rows


class Prescription(BaseModel):
    """A lens path from the specimen outwards.

    In path coordinates the specimen's middle is the origin, z is the axis and points outwards, to the image.
    """

    model_config = _STRICT
    name: Literal["camera", "projector"]
    working_distance: _Length
    image: Image
    surfaces: tuple[Surface, ...]

    @model_validator(mode="after")
    def _consistent(self) -> "Prescription":
        stops = [k for k, surface in enumerate(self.surfaces) if surface.is_stop]
        if len(stops) != 1:
            raise ValueError(f"exactly one surface must have is_stop = true, not {len(stops)}")
        k = stops[0]
        if self.surfaces[k].radius or k == 0 or self.surfaces[k].glass != AIR or self.surfaces[k - 1].glass != AIR:
            raise ValueError("the stop must be a plane in air, behind at least one surface")
        if self.surfaces[-1].glass != AIR:
            raise ValueError("the image must lie in air")
        return self

    @cached_property
    def vertices(self) -> np.ndarray:
        """z of each surface and, as the last one, of the image, (n + 1,)."""
        return np.cumsum([self.working_distance, *(surface.thickness for surface in self.surfaces)])

    @property
    def stop(self) -> int:
        """Number of the stop among the surfaces."""
        return next(k for k, surface in enumerate(self.surfaces) if surface.is_stop)

    @property
    def stop_radius(self) -> float:
        return self.surfaces[self.stop].semi_diameter

    @property
    def glasses(self) -> tuple[tuple[str, str], ...]:
        """Glass before and behind each surface."""
        names = [AIR, *(surface.glass for surface in self.surfaces)]
        return tuple(pairwise(names))

    @property
    def elements(self) -> dict[str, tuple[int, ...]]:
        """Numbers of the surfaces of each element; the stop is none."""
        found: dict[str, list[int]] = {}
        for k, surface in enumerate(self.surfaces):
            if not surface.is_stop:
                found.setdefault(surface.element, []).append(k)
        return {name: tuple(numbers) for name, numbers in found.items()}


def load_prescription(name_or_path: str | Path) -> Prescription:
    """A built-in prescription, "camera" or "projector", or a TOML file of the same form.

    Raises InputError for a file that cannot be read, is no TOML, or says what no lens can be.
    """
    built_in = name_or_path in BUILT_IN
    path = Path(__file__).with_name(f"{name_or_path}.toml") if built_in else Path(name_or_path)
    try:
        return Prescription.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError:
        raise InputError(
            f"cannot read prescription {path}; choose one of {', '.join(BUILT_IN)} or give a TOML file"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"prescription {path} is no TOML: {error}") from None
    except ValidationError as error:
        raise InputError(describe_validation_error(error, f"prescription {path}", Prescription)) from None
