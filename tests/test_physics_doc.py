"""``docs/physics.md`` names every setting of the twin with its default, its switch and tests that exist."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from pydantic import BaseModel

from greenough.instrument.rigfile import RigFile, load_rig_file
from greenough.twin.settings import TwinSettings, twin_settings

PAGE = Path(__file__).parent.parent / "docs" / "physics.md"


class Row(NamedTuple):
    effect: str
    setting: str
    default: str
    off: str
    observable: str
    test: str


def rows() -> list[Row]:
    lines = re.findall(r"^\|(.+)\|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    cells = [[cell.strip() for cell in line.split(" | ")] for line in lines]
    assert {len(row) for row in cells if not set("".join(row)) <= {"-", "|"}} == {6}
    return [Row(*row) for row in cells if len(row) == 6 and row[1].startswith("`")]


def value(cell: str) -> object:
    return tomllib.loads(f"value = {cell.strip('`')}")["value"]


@cache
def rig_file_with(*overrides: str) -> RigFile:
    return load_rig_file("twin", overrides)


def at_present(setting: str, *overrides: str) -> object:
    rig_file = rig_file_with(*overrides)
    section, *fields = setting.strip("`").split(".")
    found: object = twin_settings(rig_file) if section == "twin" else getattr(rig_file, section)
    for field in fields:
        found = getattr(found, field)
    return found


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.effect)
def test_a_row_names_a_setting_with_its_default_and_its_switch_and_tests_that_exist(row):
    assert at_present(row.setting) == value(row.default)
    if row.off != "–":
        assert at_present(row.setting, f"{row.setting.strip('`')}={row.off.strip('`')}") == value(row.off)
    links = re.findall(r"\]\(([^)#]+)#([^)]+)\)", row.test)
    assert links
    for file, name in links:
        tree = ast.parse((PAGE.parent / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file}: {name}"


def test_no_setting_of_the_twin_is_left_out():
    named = {row.setting.strip("`") for row in rows()}
    sections = {name: section for name, section in TwinSettings() if isinstance(section, BaseModel)}
    assert len(sections) > 5
    for name, section in sections.items():
        for field in type(section).model_fields:
            assert f"twin.{name}.{field}" in named
