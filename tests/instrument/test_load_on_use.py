import importlib
import sys
from pathlib import Path

import pytest

PACKAGE = """
from greenough.instrument.load_on_use import load_on_use
load_on_use(__name__, {"decode": "decode", "Map": "decode", "other": "elsewhere"})
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package of which a function is named like the module it is in."""
    folder = tmp_path / "lazy_specimen"
    folder.mkdir()
    (folder / "__init__.py").write_text(PACKAGE)
    (folder / "decode.py").write_text("class Map: pass\ndef decode(): return Map()\n")
    (folder / "elsewhere.py").write_text("from .decode import decode\nother = decode\nunlisted = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield folder.name
    for name in [name for name in sys.modules if name.partition(".")[0] == folder.name]:
        del sys.modules[name]


def test_nothing_is_loaded_until_a_name_is_used(package: str) -> None:
    imported = importlib.import_module(package)
    assert f"{package}.decode" not in sys.modules
    assert isinstance(imported.decode(), imported.Map)
    assert f"{package}.elsewhere" not in sys.modules


@pytest.mark.parametrize("first", ["", ".decode", ".elsewhere"])
def test_a_name_wins_over_its_module_whatever_was_loaded_first(package: str, first: str) -> None:
    importlib.import_module(package + first)
    imported = importlib.import_module(package)
    for _ in range(2):
        assert imported.decode is sys.modules[f"{package}.decode"].decode
        importlib.import_module(f"{package}.elsewhere")


def test_other_modules_are_bound_as_always(package: str) -> None:
    imported = importlib.import_module(package)
    assert not hasattr(imported, "elsewhere")
    importlib.import_module(f"{package}.elsewhere")
    assert imported.elsewhere.unlisted == 1


def test_an_unknown_name_is_an_attribute_error_that_names_the_package(package: str) -> None:
    with pytest.raises(AttributeError, match="module 'lazy_specimen' has no attribute 'unlisted'"):
        importlib.import_module(package).unlisted  # noqa: B018  the access is the test
