"""Where the surfaces of one path really stand: what a prescription becomes once it is assembled."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import describe_validation_error

from .prescription import Prescription

Pair = tuple[float, float]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class PathErrors:
    """How a path differs from its prescription, in mm and rad, about and along the path's x and y.

    An element turns about the middle between its first and last vertex; the image about its centre.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    decentres: Mapping[str, Pair] = field(default_factory=dict)  # by element
    tilts: Mapping[str, Pair] = field(default_factory=dict)
    image_tilt: Pair = (0.0, 0.0)


@dataclass(frozen=True)
class PlacedSurface:
    """A sphere or plane anywhere near the axis, in path coordinates."""

    vertex: Triple
    axis: Triple  # unit vector at the vertex along the surface's own axis, towards the image
    curvature: float
    glass_before: str  # on the specimen's side
    glass_behind: str
    semi_diameter: float


@dataclass(frozen=True)
class PlacedImage:
    """The plane of the sensor or of the mirrors, in path coordinates."""

    centre: Triple
    along_x: Triple  # unit vectors in the plane
    along_y: Triple
    normal: Triple


@dataclass(frozen=True)
class PlacedPath:
    """The surfaces of one path from the specimen outwards, and its image."""

    prescription: Prescription
    surfaces: tuple[PlacedSurface, ...]
    image: PlacedImage


def place(prescription: Prescription, errors: PathErrors | None = None) -> PlacedPath:
    """The path with its elements shifted and turned by ``errors``, by default as designed.

    Spheres and planes stay what they are, so that no approximation is made.
    """
    errors = errors or PathErrors()
    vertices = prescription.vertices
    moved = {k: (np.array([0.0, 0.0, z]), np.array([0.0, 0.0, 1.0])) for k, z in enumerate(vertices[:-1])}
    for element, numbers in prescription.elements.items():
        pivot = np.array([0.0, 0.0, (vertices[numbers[0]] + vertices[numbers[-1]]) / 2])
        turn = _turn(errors.tilts.get(element, (0.0, 0.0)))
        shift = np.array([*errors.decentres.get(element, (0.0, 0.0)), 0.0])
        for k in numbers:
            vertex, axis = moved[k]
            moved[k] = pivot + turn @ (vertex - pivot) + shift, turn @ axis
    surfaces = tuple(
        PlacedSurface(_triple(moved[k][0]), _triple(moved[k][1]), surface.curvature, *glasses, surface.semi_diameter)
        for k, (surface, glasses) in enumerate(zip(prescription.surfaces, prescription.glasses, strict=True))
    )
    turn = _turn(errors.image_tilt)
    image = PlacedImage((0.0, 0.0, float(vertices[-1])), *(_triple(axis) for axis in turn.T))
    return PlacedPath(prescription, surfaces, image)


def errors_to_json(errors: PathErrors) -> str:
    """``errors`` as text, exact to the last bit, for a property of a Mitsuba plugin."""
    return json.dumps(asdict(errors))


def errors_from_json(text: str, prescription: Prescription) -> PathErrors:
    """The opposite of ``errors_to_json``.

    Raises InputError for text of another form, and for elements that ``prescription`` does not have.
    """
    try:
        errors = TypeAdapter(PathErrors).validate_json(text)
    except ValidationError as error:
        raise InputError(describe_validation_error(error, "errors of a lens path")) from None
    unknown = sorted({*errors.decentres, *errors.tilts} - set(prescription.elements))
    if unknown:
        raise InputError(
            f"errors of a lens path: prescription {prescription.name} has no element {unknown[0]!r}; "
            f"it has {', '.join(map(repr, prescription.elements))}"
        )
    return errors


def _turn(angles: Pair) -> np.ndarray:
    """Rotation (3, 3) by the vector (x, y, 0) of ``angles``."""
    return Rotation.from_rotvec([*angles, 0.0]).as_matrix()


def _triple(vector: np.ndarray) -> Triple:
    x, y, z = vector
    return float(x), float(y), float(z)
