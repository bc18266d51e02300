"""Rig files: which instrument, with which limits and procedure, behind which driver.

A rig file is TOML. Its sections camera, projector, stage, board, procedure and uncertainty are the same for every rig;
every other section belongs to the driver, which validates it (``describe_validation_error`` words the refusal).
"""

import difflib
import hashlib
import json
import tomllib
from collections.abc import Iterator, Sequence
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from .contract import CameraNoise, KnownUncertainty, Procedure, RigIdentity, SpotBoard
from .errors import InputError
from .toml_file import names_in, read_toml

_RIGS = resources.files("greenough.instrument") / "rigs"
_SECTION = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
_Model = TypeVar("_Model", bound=BaseModel)
_Name = Annotated[str, Field(min_length=1, max_length=200)]
_Pixels = Annotated[int, Field(ge=4, le=20_000)]
_Index = Annotated[int, Field(ge=0, le=199)]
_Millimetres = Annotated[float, Field(ge=-1000, le=1000)]
_Size = Annotated[float, Field(gt=0, le=1000)]


class CameraSection(BaseModel):
    """``[camera]``: the size of its frames and its EMVA 1288 data.

    With ``bits = 0`` the frames are float, in the grey values of an 8-bit camera but without quantisation.
    """

    model_config = _SECTION
    rows: _Pixels
    cols: _Pixels
    bits: Literal[0, 8, 16]
    full_well_e: Annotated[float, Field(ge=100, le=10_000_000)]
    read_noise_e: Annotated[float, Field(ge=0, le=10_000)]
    black_level_dn: Annotated[float, Field(ge=0, le=60_000)]
    exposure_min_us: Annotated[float, Field(gt=0, le=1e9)]
    exposure_max_us: Annotated[float, Field(gt=0, le=1e9)]

    @model_validator(mode="after")
    def _consistent(self) -> "CameraSection":
        if self.exposure_max_us < self.exposure_min_us:
            raise ValueError(f"exposure_max_us must be at least exposure_min_us, {self.exposure_min_us:g}")
        if self.black_level_dn > self.full_scale_dn / 2:
            raise ValueError(f"black_level_dn must be at most half of full scale, {self.full_scale_dn / 2:g}")
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @property
    def full_scale_dn(self) -> float:
        return float(2 ** (self.bits or 8) - 1)

    @property
    def noise(self) -> CameraNoise:
        """A full well fills the grey values from the black level to full scale."""
        return CameraNoise(
            full_well_e=self.full_well_e,
            read_noise_e=self.read_noise_e,
            electrons_per_dn=self.full_well_e / (self.full_scale_dn - self.black_level_dn),
        )


class ProjectorSection(BaseModel):
    """``[projector]``: the size of its patterns."""

    model_config = _SECTION
    rows: _Pixels
    cols: _Pixels

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols


class StageSection(BaseModel):
    """``[stage]``: how far it may travel."""

    model_config = _SECTION
    min_mm: _Millimetres
    max_mm: _Millimetres

    @model_validator(mode="after")
    def _consistent(self) -> "StageSection":
        if self.max_mm <= self.min_mm:
            raise ValueError(f"max_mm must be above min_mm, {self.min_mm:g}")
        return self

    @property
    def limits_mm(self) -> tuple[float, float]:
        return self.min_mm, self.max_mm


class BoardSection(BaseModel):
    """``[board]``: the calibration board as its drawing says, with or without big spots."""

    model_config = _SECTION
    rows: Annotated[int, Field(ge=3, le=200)]
    cols: Annotated[int, Field(ge=3, le=200)]
    pitch_mm: _Size
    big_diameter_mm: _Size | None = None
    small_diameter_mm: _Size
    size_mm: _Size
    big: Annotated[tuple[tuple[_Index, _Index], ...], Field(min_length=3, max_length=100)] = ()
    dark_spots: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> "BoardSection":
        if (self.big_diameter_mm is None) != (not self.big):
            raise ValueError("must have both big_diameter_mm and big, or neither where all spots are alike")
        largest = self.big_diameter_mm or self.small_diameter_mm
        if not self.small_diameter_mm <= largest < self.pitch_mm or (largest == self.small_diameter_mm and self.big):
            raise ValueError("must have small_diameter_mm below big_diameter_mm, and that below pitch_mm")
        extent = (max(self.rows, self.cols) - 1) * self.pitch_mm + largest
        if self.size_mm < extent:
            raise ValueError(f"size_mm must be at least {extent:g} to hold all spots")
        for row, col in self.big:
            if row >= self.rows or col >= self.cols:
                raise ValueError(f"big must name spots from [0, 0] to [{self.rows - 1}, {self.cols - 1}]")
        return self

    @property
    def nominal(self) -> SpotBoard:
        fields: dict[str, Any] = {name: getattr(self, name) for name in type(self).model_fields}
        fields["big_diameter_mm"] = self.big_diameter_mm or self.small_diameter_mm
        return SpotBoard(**fields)


class ProcedureSection(BaseModel):
    """``[procedure]``: the fringe set, the calibration's postures and planes, and the exposures."""

    model_config = _SECTION
    periods_px: Annotated[tuple[Annotated[float, Field(ge=2, le=20_000)], ...], Field(min_length=1, max_length=16)]
    steps: Annotated[tuple[Annotated[int, Field(ge=3, le=64)], ...], Field(min_length=1, max_length=16)]
    postures: Annotated[int, Field(ge=4, le=200)]
    planes: Annotated[int, Field(ge=3, le=1000)]
    plane_step_mm: _Size
    exposure_share: Annotated[float, Field(ge=0.05, le=0.95)]
    brackets: Annotated[tuple[Annotated[float, Field(gt=0, le=1000)], ...], Field(min_length=1, max_length=8)] = (1.0,)

    @model_validator(mode="after")
    def _consistent(self) -> "ProcedureSection":
        if len(self.steps) != len(self.periods_px):
            raise ValueError(f"steps must have as many numbers as periods_px, {len(self.periods_px)}")
        if any(longer <= shorter for longer, shorter in zip(self.periods_px, self.periods_px[1:], strict=False)):
            raise ValueError("periods_px must fall from number to number")
        if any(longer <= shorter for longer, shorter in zip(self.brackets, self.brackets[1:], strict=False)):
            raise ValueError("brackets must fall from number to number")
        return self

    @property
    def contract(self) -> Procedure:
        return Procedure(**{name: getattr(self, name) for name in type(self).model_fields})


class UncertaintySection(BaseModel):
    """``[uncertainty]``: standard uncertainties that no calibration shows, see ``contract.KnownUncertainty``.

    There is no default: an uncertainty that nobody states would count as none.
    """

    model_config = _SECTION
    board_scale_ppm: Annotated[float, Field(ge=0, le=100_000)]
    table_drift_um: Annotated[float, Field(ge=0, le=1000)]
    path_drift_um: Annotated[float, Field(ge=0, le=1000)]

    @property
    def contract(self) -> KnownUncertainty:
        return KnownUncertainty(1e-6 * self.board_scale_ppm, 1e-3 * self.table_drift_um, 1e-3 * self.path_drift_um)


class RigFile(BaseModel):
    """A validated rig file. Sections of the driver are kept as they stand: see ``driver_section``."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)
    __pydantic_extra__: dict[str, dict[str, Any]]
    name: _Name
    driver: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$", examples=["package.module:function"])]
    camera: CameraSection
    projector: ProjectorSection
    stage: StageSection
    board: BoardSection
    procedure: ProcedureSection
    uncertainty: UncertaintySection

    @model_validator(mode="after")
    def _consistent(self) -> "RigFile":
        half = (self.procedure.planes - 1) / 2 * self.procedure.plane_step_mm
        if not (self.stage.min_mm <= -half and half <= self.stage.max_mm):
            raise ValueError(
                f"procedure.planes and plane_step_mm ask for heights of ±{half:g} mm, which must lie within "
                f"stage.min_mm to max_mm, {self.stage.min_mm:g} to {self.stage.max_mm:g}"
            )
        return self

    def driver_section(self, name: str) -> dict[str, Any]:
        """A copy of one of the driver's own sections; empty when the file has none of that name."""
        return deepcopy((self.__pydantic_extra__ or {}).get(name, {}))

    @property
    def driver_sections(self) -> tuple[str, ...]:
        """Names of the sections that belong to the driver."""
        return tuple(self.__pydantic_extra__ or {})

    @property
    def settings_sha256(self) -> str:
        """Digest of every setting, overrides included; the order and layout of the file do not count."""
        return settings_sha256(self)

    def identity(self, camera_serial: str, projector_serial: str) -> RigIdentity:
        """The identity of the rig whose devices reported these serial numbers."""
        return RigIdentity(self.name, camera_serial, projector_serial, self.settings_sha256)


def settings_sha256(settings: BaseModel) -> str:
    """Digest of every setting; their order does not count."""
    return hashlib.sha256(json.dumps(settings.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()


def builtin_rigs() -> tuple[str, ...]:
    """Names of the rig files that come with the package."""
    return names_in(_RIGS)


def load_rig_file(name_or_path: str | Path, overrides: Sequence[str] = ()) -> RigFile:
    """Read and validate a rig file.

    Parameters
    ----------
    name_or_path : str or Path
        A built-in name or the path of a TOML file. A name wins over a file of the same name; write ``./twin`` for it.
    overrides : sequence of str
        ``"section.field=value"`` each, the value in TOML; later ones win.

    Raises
    ------
    InputError
        For an unknown rig, a file that cannot be read, malformed TOML (with its line), an override of an unknown
        field (with the nearest known one), and wrong fields (all of them, each with what is allowed).
    """
    return validated_rig(*read_rig(name_or_path, overrides), RigFile)


def read_rig(name_or_path: str | Path, overrides: Sequence[str] = ()) -> tuple[str, dict[str, Any]]:
    """What a rig file says, with the overrides, as yet unjudged; parameters are those of `load_rig_file`.

    Returns
    -------
    where : str
        What to call the file in a sentence.
    document : dict

    Raises
    ------
    InputError
        For an unknown rig, a file that cannot be read, malformed TOML, or an override of an unknown field.
    """
    where, document = read_toml(name_or_path, "rig", _RIGS)
    schema = RigFile.model_json_schema() if overrides else {}
    for override in overrides:
        _apply(override, document, schema)
        where += f" with --set {override}"
    return where, document


def validated_rig(where: str, document: dict[str, Any], model: type[_Model]) -> _Model:
    """What `read_rig` read, judged by a model; raises InputError with all wrong fields."""
    try:
        # JSON knows no tuples, so strictness refuses text for a number without refusing a list for a tuple.
        return model.model_validate_json(json.dumps(document, default=str), strict=True)
    except ValidationError as error:
        raise InputError(describe_validation_error(error, where, model)) from None


def describe_validation_error(error: ValidationError, where: str, model: type[BaseModel] | None = None) -> str:
    """One sentence that names every wrong field and what is allowed there.

    Parameters
    ----------
    error : pydantic.ValidationError
    where : str
        What was validated, for example ``"rig file lab.toml"``.
    model : type of pydantic.BaseModel, optional
        The model that refused. With it the sentence gives each field's whole range and the nearest known field for an
        unknown one.
    """
    schema = model.model_json_schema() if model else {}
    faults = error.errors(include_url=False)
    # A list whose values are wrong is also reported as too short: the values alone say it better.
    parents = {fault["loc"][:depth] for fault in faults for depth in range(len(fault["loc"]))}
    sentences = [_describe_fault(fault, schema) for fault in faults if not fault["loc"] or fault["loc"] not in parents]
    return f"{where}: {'; '.join(sentences)}"


def _apply(override: str, document: dict[str, Any], schema: dict[str, Any]) -> None:
    """Write one ``"section.field=value"`` into the document; ``schema`` is that of a rig file."""
    name, equals, text = override.partition("=")
    keys = name.strip().split(".")
    if not equals or not all(keys):
        raise InputError(f"--set {override}: write section.field=value, for example --set camera.bits=16")
    try:
        parsed = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        parsed = {}
    if list(parsed) != ["value"]:
        raise InputError(f"--set {override}: the value must be written as in TOML, text in quotes")
    if keys[0] not in schema["properties"] and (keys[0] not in document or len(keys) == 1):
        known = [*_known_fields(schema), *(section for section, value in document.items() if isinstance(value, dict))]
        raise InputError(f"--set {override}: there is no field {name.strip()}{_nearest(name.strip(), known)}")
    table = document
    for depth, key in enumerate(keys[:-1], start=1):
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {override}: {'.'.join(keys[:depth])} is a value and holds no fields")
    table[keys[-1]] = parsed["value"]


def _describe_fault(fault: Any, schema: dict[str, Any]) -> str:
    location = fault["loc"]
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if fault["type"] in ("value_error", "assertion_error"):
        message = fault["msg"].partition(", ")[2]
        return f"{name}: {message}" if name else message
    node = _node(schema, location)
    allowed = _allowed(node, schema) if node else None
    if fault["type"] == "missing":
        return f"{name} is missing" + (f" and must be {allowed}" if allowed else "")
    if fault["type"] == "extra_forbidden" or (
        schema and len(location) == 1 and location[0] not in schema["properties"]
    ):
        return f"there is no field {name}{_nearest(name, _known_fields(schema))}"
    reason = f"must be {allowed}" if allowed else fault["msg"][:1].lower() + fault["msg"][1:]
    value = fault["input"]
    shown = f" = {json.dumps(value, default=str)}" if not isinstance(value, dict | list | tuple) else ""
    return f"{name}{shown} {reason}"


def _nearest(name: str, known: Sequence[str]) -> str:
    matches = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    return f", the nearest is {matches[0]}" if matches else ""


def _resolve(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    reference = node.get("$ref")
    return schema["$defs"][reference.rpartition("/")[2]] if reference else node


def _node(schema: dict[str, Any], location: Sequence[int | str]) -> dict[str, Any] | None:
    """The JSON schema of one field; None where the model does not say."""
    node = schema
    for part in location:
        node = _resolve(node, schema)
        if isinstance(part, str):
            child = node.get("properties", {}).get(part, node.get("additionalProperties"))
        else:
            prefix = node.get("prefixItems", [])
            child = prefix[part] if part < len(prefix) else node.get("items")
        if not isinstance(child, dict):
            return None
        node = child
    return _resolve(node, schema)


def _known_fields(schema: dict[str, Any]) -> list[str]:
    def walk(node: dict[str, Any], prefix: str) -> Iterator[str]:
        for name, child in _resolve(node, schema).get("properties", {}).items():
            yield prefix + name
            yield from walk(child, f"{prefix}{name}.")

    return list(walk(schema, ""))


def _allowed(node: dict[str, Any], schema: dict[str, Any]) -> str | None:
    """What a JSON schema allows, in words."""
    if "enum" in node or "const" in node:
        *others, last = (json.dumps(value) for value in node.get("enum", [node.get("const")]))
        return f"{', '.join(others)} or {last}" if others else last
    match node.get("type"):
        case "integer":
            return "a whole number" + _range(node)
        case "number":
            return "a number" + _range(node)
        case "boolean":
            return "true or false"
        case "string":
            examples = node.get("examples")
            return f"text such as {json.dumps(examples[0])}" if examples else "text in quotes, not empty"
        case "object":
            return "a section"
        case "array":
            low, high = node.get("minItems"), node.get("maxItems")
            count = "" if low is None or high is None else f"{low} " if low == high else f"{low} to {high} "
            items = node.get("prefixItems", [node.get("items")])[0]
            inner = _allowed(_resolve(items, schema), schema) if isinstance(items, dict) else None
            return f"a list of {count}values" + (f", each {inner}" if inner else "")
    return None


def _range(node: dict[str, Any]) -> str:
    low, above = node.get("minimum"), node.get("exclusiveMinimum")
    high, below = node.get("maximum"), node.get("exclusiveMaximum")
    start = f" from {low:g}" if low is not None else f" above {above:g}" if above is not None else ""
    if high is None and below is None:
        return start
    end = f"below {below:g}" if high is None else f"{high:g}"
    joint = " to " if low is not None else " up to " if high is not None else " and " if start else " "
    return start + joint + end
