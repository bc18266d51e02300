"""Chromium without a window, for tests of pages. It draws in software, so that any machine shows the same."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def chromium() -> Iterator[Browser]:
    """The system's browser; skips without one, and fails where GREENOUGH_NEEDS_CHROMIUM says that there is one."""
    found = next((path for path in map(shutil.which, NAMES) if path), None)
    if found is None:
        reason = f"no {', '.join(NAMES)}: apt-get install chromium"
        if os.environ.get("GREENOUGH_NEEDS_CHROMIUM"):
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()


class Opened:
    """A page in a tab of its own without a network, and what it complained of or asked for."""

    def __init__(self, browser: Browser, path: Path, width: int = 1280, scheme: str = "light", height: int = 900):
        self._context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme, offline=True
        )
        self.tab: Page = self._context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda message: self.complaints.append(message.text))
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(path.as_uri())
        if self.tab.query_selector("#viewer"):
            self.tab.wait_for_selector("#viewer[data-ready=yes]", timeout=60_000)
            self.settle()

    def __enter__(self) -> "Opened":
        return self

    def __exit__(self, *exc: object) -> None:
        self._context.close()

    def settle(self) -> None:
        """Wait until the view is drawn from all points."""
        self.tab.wait_for_timeout(250)
        self.tab.wait_for_selector("#space[data-stride='1']", timeout=60_000)
        self.tab.wait_for_timeout(50)
