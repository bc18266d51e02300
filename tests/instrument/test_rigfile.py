import json
import re
from importlib import resources
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import (
    RigFile,
    _known_fields,
    builtin_rigs,
    describe_validation_error,
    load_rig_file,
)

TWIN = (resources.files("greenough.instrument") / "rigs" / "twin.toml").read_text(encoding="utf-8")


def refusal(*overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_rig_file("twin", overrides)
    return str(caught.value)


def test_every_builtin_rig_loads() -> None:
    assert "twin" in builtin_rigs()
    for name in builtin_rigs():
        assert load_rig_file(name).name == name


def test_a_path_loads_what_the_file_says(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TWIN.replace('name = "twin"', 'name = "lab"'))
    rig_file = load_rig_file(path)
    assert rig_file.name == "lab"
    assert load_rig_file(str(path)) == rig_file


def test_sections_translate_into_the_contract() -> None:
    rig_file = load_rig_file("twin", ["board.pitch_mm=0.7", "camera.rows=480", "procedure.planes=7"])
    assert rig_file.board.nominal.pitch_mm == 0.7
    assert rig_file.board.nominal.centres().shape == (99, 2)
    assert rig_file.procedure.contract.planes == 7
    assert rig_file.procedure.contract.steps == (4, 4, 4, 12)
    assert rig_file.camera.shape == (480, 1280)
    assert rig_file.stage.limits_mm == (-1.6, 1.6)
    assert rig_file.identity("c", "p").settings_sha256 == rig_file.settings_sha256


@pytest.mark.parametrize(("bits", "full_scale"), [(8, 255.0), (16, 65535.0), (0, 255.0)])
def test_a_full_well_fills_the_grey_values_above_black(bits: int, full_scale: float) -> None:
    camera = load_rig_file("twin", [f"camera.bits={bits}"]).camera
    assert camera.full_scale_dn == full_scale
    filled = camera.black_level_dn + camera.full_well_e / camera.noise.electrons_per_dn
    assert filled == pytest.approx(full_scale)


def test_the_drivers_sections_are_kept_as_they_stand() -> None:
    rig_file = load_rig_file("twin", ["twin.stage.position_sd_um=0", 'twin.names=["a", 1.5, true]'])
    section = rig_file.driver_section("twin")
    assert section["stage"] == {"position_sd_um": 0}
    assert section["names"] == ["a", 1.5, True]
    section["stage"]["position_sd_um"] = 5
    assert rig_file.driver_section("twin")["stage"] == {"position_sd_um": 0}
    assert rig_file.driver_section("absent") == {}
    assert rig_file.driver_sections == ("twin",)


def test_the_last_override_wins() -> None:
    assert load_rig_file("twin", ["twin.seed=2", "twin.seed=3"]).driver_section("twin")["seed"] == 3


def test_the_digest_follows_the_settings_and_not_the_layout(tmp_path: Path) -> None:
    original = load_rig_file("twin").settings_sha256
    path = tmp_path / "same.toml"
    path.write_text("# another comment\n" + TWIN.replace("min_mm = -1.6", "min_mm   =  -1.60"))
    assert load_rig_file(path).settings_sha256 == original
    assert load_rig_file("twin", ["camera.rows=960"]).settings_sha256 == original
    digests = {
        load_rig_file("twin", [override]).settings_sha256
        for override in ("twin.seed=2", "twin.new=1", "camera.rows=961", "board.pitch_mm=0.6500001")
    }
    assert len(digests | {original}) == 5


def test_every_wrong_field_is_named_with_what_is_allowed() -> None:
    sentence = refusal(
        "camera.rows=0", "camera.bits=12", 'stage.max_mm="far"', "procedure.steps=[4,4,4,2]", "board.big=[[4,5]]"
    )
    assert "camera.rows = 0 must be a whole number from 4 to 20000" in sentence
    assert "camera.bits = 12 must be 0, 8 or 16" in sentence
    assert 'stage.max_mm = "far" must be a number from -1000 to 1000' in sentence
    assert "procedure.steps[3] = 2 must be a whole number from 3 to 64" in sentence
    assert "board.big must be a list of 3 to 100 values" in sentence
    assert sentence.startswith("built-in rig file twin")
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("camera.rows=true", "whole number"),
        ("camera.rows=960.5", "whole number"),
        ("camera.full_well_e=nan", "number from"),
        ("camera.full_well_e=inf", "number from"),
        ("camera.exposure_max_us=1.0", "at least exposure_min_us, 8333"),
        ("camera.black_level_dn=200.0", "at most half of full scale, 127.5"),
        ("stage.min_mm=2.0", "above min_mm, 2"),
        ("board.small_diameter_mm=0.5", "below big_diameter_mm"),
        ("board.size_mm=6.0", "at least 6.9"),
        ("board.big=[[4,5],[4,6],[9,0]]", r"\[0, 0\] to \[8, 10\]"),
        ("procedure.steps=[4,4,4]", "as many numbers as periods_px, 4"),
        ("procedure.periods_px=[40.0,152.0,608.0,12.0]", "fall from number to number"),
        ("procedure.brackets=[1.0,4.0]", "fall from number to number"),
        ("procedure.planes=40", "±1.95 mm.*-1.6 to 1.6"),
        ('driver="twin"', "package.module:function"),
        ("camera=3", "camera = 3 must be a section"),
    ],
)
def test_a_wrong_value_is_refused_with_its_range(override: str, expected: str) -> None:
    assert re.search(expected, refusal(override))


@pytest.mark.parametrize(
    ("override", "nearest"),
    [
        ("camera.rwos=3", "camera.rows"),
        ("camra.rows=3", "camera.rows"),
        ("exposure_max_us=3.0", "camera.exposure_max_us"),
        ("procedure.plane_step=0.1", "procedure.plane_step_mm"),
        ("naem='x'", "name"),
        ("twni.seed=2", "twin"),
    ],
)
def test_an_unknown_field_names_the_nearest_known_one(override: str, nearest: str) -> None:
    sentence = refusal(override)
    assert f"there is no field {override.partition('=')[0]}, the nearest is {nearest}" in sentence


@pytest.mark.parametrize("override", ["camera.rows", "=3", "camera.=3", "camera.rows=", "camera.rows=1\nname=2", "a.b"])
def test_a_malformed_override_is_refused(override: str) -> None:
    assert refusal(override).startswith(f"--set {override}")


def test_an_override_cannot_reach_into_a_value() -> None:
    assert "camera.rows is a value" in refusal("camera.rows.x=3")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('name = "x"\n[camera\nrows = 1\n', 2),
        ('name = "x"\n\n\nrows = = 3\n', 4),
        ('name = "x"\nname = "y"\n', 2),
        ('a = 1\nb = """never closed', 2),
    ],
)
def test_malformed_toml_names_its_line(tmp_path: Path, text: str, line: int) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"bad\.toml is not valid TOML at line {line}: .*[^.]$"):
        load_rig_file(path)


@given(position=st.integers(0, len(TWIN) - 1), character=st.characters(codec="utf-8"))
def test_any_damaged_rig_file_loads_or_gives_one_sentence(
    tmp_path_factory: pytest.TempPathFactory, position: int, character: str
) -> None:
    path = tmp_path_factory.mktemp("rig") / "damaged.toml"
    path.write_text(TWIN[:position] + character + TWIN[position + 1 :], encoding="utf-8", newline="")
    sentence = f"{path} is fine"
    try:
        load_rig_file(path)
    except InputError as error:
        sentence = str(error)
    assert str(path) in sentence
    assert not sentence.endswith(".")


def test_missing_fields_and_unknown_top_level_values_are_all_named(tmp_path: Path) -> None:
    path = tmp_path / "short.toml"
    path.write_text('name = "short"\ncolour = 3\n[camera]\nrows = 10\n')
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    sentence = str(caught.value)
    for name in ("driver", "stage", "board", "procedure", "uncertainty", "projector", "camera.cols", "camera.bits"):
        assert f"{name} is missing" in sentence
    assert "there is no field colour" in sentence


def test_an_unknown_rig_lists_the_builtin_names(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no rig twni.*twin"):
        load_rig_file("twni")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load_rig_file(tmp_path / "binary.toml")
    with pytest.raises(InputError, match="it is a folder"):
        load_rig_file(tmp_path)


def test_every_number_of_the_schema_is_bounded() -> None:
    schema = RigFile.model_json_schema()

    def numbers(node: object) -> list[dict]:
        if isinstance(node, dict):
            own = [node] if node.get("type") in ("integer", "number") and "enum" not in node else []
            return own + [number for child in node.values() for number in numbers(child)]
        return [number for child in node for number in numbers(child)] if isinstance(node, list) else []

    found = numbers(schema)
    assert len(found) >= 20
    for number in found:
        assert {"minimum", "exclusiveMinimum"} & number.keys(), number
        assert {"maximum", "exclusiveMaximum"} & number.keys(), number
    assert "camera.rows" in _known_fields(schema)


class Settings(BaseModel):
    model_config = ConfigDict(extra="forbid")
    seed: Annotated[int, Field(ge=0, lt=100)] = 1
    ideal: bool = False


def test_another_models_error_is_described_with_and_without_its_model() -> None:
    with pytest.raises(ValidationError) as caught:
        Settings.model_validate_json(json.dumps({"seed": 100, "ideal": "x", "sede": 1}))
    sentence = describe_validation_error(caught.value, "section twin", Settings)
    assert sentence.startswith("section twin: ")
    assert "seed = 100 must be a whole number from 0 to below 100" in sentence
    assert 'ideal = "x" must be true or false' in sentence
    assert "there is no field sede, the nearest is seed" in sentence
    bare = describe_validation_error(caught.value, "section twin")
    assert "seed = 100 input should be less than 100" in bare
    assert "there is no field sede" in bare


def test_a_board_may_have_no_big_spots(tmp_path: Path) -> None:
    lines = [line for line in TWIN.splitlines() if not line.startswith("big")]
    path = tmp_path / "plain.toml"
    path.write_text("\n".join(lines))
    board = load_rig_file(path).board.nominal
    assert board.big == ()
    assert set(board.diameters()) == {0.175}
    path.write_text(TWIN.replace("big_diameter_mm = 0.4\n", ""))
    with pytest.raises(InputError, match="both big_diameter_mm and big, or neither"):
        load_rig_file(path)
