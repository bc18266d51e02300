import io
import sys

import pytest

from greenough.instrument.progress import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, quiet: bool) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with progress(3, "capturing planes", quiet=quiet) as advance:
        for _ in range(3):
            advance(1)
    return stream.getvalue()


def test_a_terminal_shows_the_description_and_the_count(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown(monkeypatch, Terminal(), quiet=False)
    assert "capturing planes" in text
    assert "3/3" in text


def test_it_is_silent_when_asked_or_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, Terminal(), quiet=True) == ""
    assert shown(monkeypatch, io.StringIO(), quiet=False) == ""
