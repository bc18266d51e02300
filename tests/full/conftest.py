"""Claims at full resolution, minutes each: ``make test-full`` runs them and prints their figures."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "full" in item.path.parts:
            item.add_marker("full")


@pytest.fixture
def figure(capsys):
    """Prints a measured figure past pytest's capture, with the bar that it is held to."""

    def show(name: str, value: float, bar: float, unit: str) -> None:
        with capsys.disabled():
            print(f"\n{name}: {value:.4g} {unit} (bar {bar:g})", end="", flush=True)

    return show
