import os
from pathlib import Path

import pytest

from greenough.instrument.llvm import VARIABLE, ensure_llvm


def test_the_users_path_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/somewhere/libLLVM.so")
    ensure_llvm()
    assert os.environ[VARIABLE] == "/somewhere/libLLVM.so"


def test_the_environments_library_is_found_where_there_is_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    ensure_llvm()
    assert VARIABLE not in os.environ
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libLLVM.so.23.1").touch()
    ensure_llvm()
    assert os.environ.pop(VARIABLE) == str(tmp_path / "lib" / "libLLVM.so.23.1")
