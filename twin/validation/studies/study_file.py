"""Study files: which rig, which experiment, which cases and which drawn instruments."""

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import describe_validation_error
from greenough.instrument.toml_file import names_in, read_toml

from .ablation import Effect, Overrides, cases_of
from .experiments import KINDS, exists

MAX_INSTRUMENTS = 10_000
MAX_SEED = 2**32 - 1

_STUDIES = resources.files("greenough.twin.validation") / "studies"
_STRICT = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _seeds(value: Any) -> Any:
    """A count stands for the seeds 1, 2, ...; "FIRST to LAST" for all between."""
    allowed = (
        f'must be a count from 1 to {MAX_INSTRUMENTS}, "FIRST to LAST", or a list of as many different seeds from 0 to '
        f"{MAX_SEED}"
    )
    if isinstance(value, str):
        first, _, last = value.partition(" to ")
        if not (first.isdecimal() and last.isdecimal() and int(last) <= MAX_SEED):
            raise ValueError(allowed)
        value = list(range(int(first), min(int(last), int(first) + MAX_INSTRUMENTS) + 1))
    if type(value) is int and 1 <= value <= MAX_INSTRUMENTS:
        return tuple(range(1, value + 1))
    if not isinstance(value, list) or not 1 <= len(value) <= MAX_INSTRUMENTS:
        raise ValueError(allowed)
    if any(type(seed) is not int or not 0 <= seed <= MAX_SEED for seed in value) or len(set(value)) < len(value):
        raise ValueError(allowed)
    return tuple(value)


def _flat(value: Any) -> Any:
    """Limits of one line's figures, ``bundle.step_um``, may stand in a section of its own."""
    if not isinstance(value, dict):
        return value
    flat = {}
    for name, limit in value.items():
        flat |= {f"{name}.{figure}": of for figure, of in limit.items()} if isinstance(limit, dict) else {name: limit}
    return flat


_Name = Annotated[str, Field(min_length=1, max_length=200)]
_Seeds = Annotated[tuple[int, ...], BeforeValidator(_seeds)]
_Limits = Annotated[dict[_Name, Annotated[float, Field(ge=0, le=1e9)]], BeforeValidator(_flat)]


class StudyFile(BaseModel):
    """A validated study file.

    ``figures`` are those that the tables show, all by default; ``x`` heads the column of the cases. ``effects`` adds
    the cases of an ablation, see ``ablation.cases_of``. ``repeats`` says how often a case is run on each instrument,
    each time with noise and drifts of its own. A limit is what the root mean square of a figure over all runs may
    reach: of every line with that figure, or, written ``LINE.FIGURE``, of lines of that case or with that text. A rate
    is how often a figure that is 0 or 1 should be 1, over all cases. ``kinds`` and ``instruments`` give a case another
    experiment and other seeds. ``agree`` names figures whose distributions must be the same in two cases.
    """

    model_config = _STRICT
    name: Annotated[str, Field(pattern=r"^\w[\w-]{0,99}$", examples=["stage-error"])]
    kind: Annotated[str, Field(min_length=1, max_length=200, examples=list(KINDS))]
    rig: _Name = "twin"
    settings: Overrides = ()
    seeds: _Seeds
    x: _Name = "case"
    cases: dict[_Name, Overrides] = {}
    effects: dict[_Name, Effect] = {}
    repeats: dict[_Name, Annotated[int, Field(ge=2, le=1000)]] = {}
    figures: tuple[_Name, ...] = ()
    limits: _Limits = {}
    rates: dict[_Name, Annotated[float, Field(gt=0, lt=1)]] = {}
    kinds: dict[_Name, _Name] = {}
    instruments: dict[_Name, _Seeds] = {}
    agree: dict[_Name, tuple[_Name, _Name]] = {}

    @field_validator("kind")
    @classmethod
    def _exists(cls, kind: str) -> str:
        if not exists(kind):
            names = ", ".join(map(json.dumps, KINDS))
            raise ValueError(f'must be {names} or a "package.module:function" that exists, not {json.dumps(kind)}')
        return kind

    @field_validator("kinds")
    @classmethod
    def _exist(cls, kinds: dict[str, str]) -> dict[str, str]:
        return {case: cls._exists(kind) for case, kind in kinds.items()}

    @model_validator(mode="after")
    def _consistent(self) -> "StudyFile":
        for settings in (self.settings, *self.all_cases.values()):
            if any(setting.startswith("twin.seed=") for setting in settings):
                raise ValueError("twin.seed is set by seeds alone: leave it out of settings and cases")
        for name, effect in self.effects.items():
            if effect.within is not None and effect.within not in self.effects:
                raise ValueError(f"effects.{name}.within must name another of the effects, not {effect.within}")
        named = {field: getattr(self, field) for field in ("repeats", "kinds", "instruments")}
        named |= {f"agree.{figure}": cases for figure, cases in self.agree.items()}
        for field, cases in named.items():
            for name in cases:
                if name not in self.all_cases:
                    raise ValueError(f"{field}.{name} must name one of the cases: {', '.join(self.all_cases)}")
        return self

    @property
    def all_cases(self) -> Mapping[str, tuple[str, ...]]:
        """Overrides of each case, those of the effects' ablation included; one without any where there are none."""
        return dict(self.cases) | cases_of(self.effects) or {"as set": ()}


def builtin_studies() -> tuple[str, ...]:
    """Names of the study files that come with the package."""
    return names_in(_STUDIES)


def load_study(name_or_path: str | Path) -> StudyFile:
    """Read and validate a study file.

    Parameters
    ----------
    name_or_path : str or Path
        A built-in name or the path of a TOML file. A name wins over a file of the same name.

    Raises
    ------
    InputError
        For an unknown study, a file that cannot be read, malformed TOML (with its line), and wrong fields (all of them,
        each with what is allowed). Overrides are tried when the runs are drawn up, see ``runs.runs_of``.
    """
    where, document = read_toml(name_or_path, "study", _STUDIES)
    try:
        # JSON knows no tuples, so strictness refuses text for a number without refusing a list for a tuple.
        return StudyFile.model_validate_json(json.dumps(document, default=str), strict=True)
    except ValidationError as error:
        raise InputError(describe_validation_error(error, where, StudyFile)) from None
