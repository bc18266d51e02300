import os
from pathlib import Path

import pytest

from greenough.instrument.llvm import VARIABLE, ensure_llvm


def test_the_users_path_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/somewhere/libLLVM.so")
    ensure_llvm()
    assert os.environ[VARIABLE] == "/somewhere/libLLVM.so"


def test_the_library_that_pip_installed_is_found_wherever_it_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv(VARIABLE, raising=False)
    packages = tmp_path / "lib" / "python3" / "site-packages"
    about = packages / "karellen_llvm_core-23.1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: karellen-llvm-core\nVersion: 23.1\n")
    (about / "RECORD").write_text("../../libLLVM.so.23.1,,\n../../libLTO.so.23.1,,\n")
    monkeypatch.setattr("sys.path", [str(packages)])
    ensure_llvm()
    assert VARIABLE not in os.environ  # the file is missing
    library = tmp_path / "lib" / "libLLVM.so.23.1"
    library.touch()
    ensure_llvm()
    assert os.environ.pop(VARIABLE) == str(library)


def test_without_the_wheel_dr_jit_looks_by_itself(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    ensure_llvm()
    assert VARIABLE not in os.environ
