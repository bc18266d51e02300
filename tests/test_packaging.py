"""What pyproject.toml and constraints.txt say agrees with the folders and with each other."""

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["setuptools"]["package-dir"]


def test_every_folder_of_the_packages_is_installed():
    folders = {"instrument", "pipeline", "scenes", "twin"}
    found = {
        path.parent.relative_to(ROOT).as_posix()
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert set(PACKAGES.values()) == found
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == set(PACKAGES)
    assert all(name == "greenough." + folder.replace("/", ".") for name, folder in PACKAGES.items())


def test_every_file_that_is_no_code_is_installed():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for name, folder in PACKAGES.items():
        for path in (ROOT / folder).iterdir():
            if path.is_file() and path.suffix != ".py":
                assert any(path.match(pattern) for pattern in data.get(name, ())), f"{path} is in no package-data"


def test_types_are_announced():
    for folder in ("instrument", "pipeline", "scenes", "twin"):
        assert (ROOT / folder / "py.typed").exists()


def requirements() -> list[Requirement]:
    project = PROJECT["project"]
    lines = [*project["dependencies"], *(line for extra in project["optional-dependencies"].values() for line in extra)]
    return [Requirement(line) for line in lines if not line.startswith("greenough")]


@pytest.mark.parametrize("requirement", requirements(), ids=lambda requirement: requirement.name)
def test_the_known_version_of_a_package_is_one_that_is_asked_for(requirement):
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    known = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    versions = {canonicalize_name(name): version for name, version in known.items()}
    assert requirement.specifier.contains(versions[canonicalize_name(requirement.name)])
