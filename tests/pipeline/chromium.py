"""Chromium without a window, for tests of pages. It draws in software, so that any machine shows the same."""

import importlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def chromium() -> "Iterator[Browser]":
    """The system's browser, driven by playwright.

    Where either is missing it skips, or fails if GREENOUGH_NEEDS_CHROMIUM says that they are there.
    """
    found = next((path for path in map(shutil.which, NAMES) if path), None)
    if found is None:
        _lack(f"none of {', '.join(NAMES)} is found: apt-get install chromium")
    try:
        driver = importlib.import_module("playwright.sync_api")
    except ImportError as error:
        _lack(f"playwright cannot be imported ({error}): pip install '.[peers]'")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()


def _lack(reason: str) -> NoReturn:
    if os.environ.get("GREENOUGH_NEEDS_CHROMIUM"):
        pytest.fail(reason)
    pytest.skip(reason)


class Opened:
    """A page in a tab of its own without a network, and what it complained of or asked for."""

    def __init__(self, browser: "Browser", path: Path, width: int = 1280, scheme: str = "light", height: int = 900):
        self._context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme, offline=True
        )
        self._context.set_default_timeout(120_000)  # ms
        self.tab: Page = self._context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda message: self.complaints.append(message.text))
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(path.as_uri())
        if self.tab.query_selector("#viewer"):
            self.tab.wait_for_selector("#viewer[data-ready=yes]")
            self.settle()

    def __enter__(self) -> "Opened":
        return self

    def __exit__(self, *exc: object) -> None:
        self._context.close()

    def settle(self) -> None:
        """Wait until the view is drawn from all points."""
        self.tab.wait_for_timeout(250)
        self.tab.wait_for_selector("#space[data-stride='1']")
        self.tab.wait_for_timeout(50)
