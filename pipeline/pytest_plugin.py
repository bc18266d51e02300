"""For pytest: the fixture `assert_matches_mesh`, and where its pictures go.

pytest loads this wherever greenough is installed, so nothing else is imported until the fixture is asked for.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

    from .compare import Comparison

_OPTION = "--greenough-pictures"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("greenough").addoption(
        _OPTION,
        metavar="DIR",
        help="Folder for the error maps of clouds that do not match. [default: greenough-failures in the root folder]",
    )


@pytest.fixture
def assert_matches_mesh(request: pytest.FixtureRequest) -> "Callable[..., Comparison]":
    """`greenough.pipeline.assert_matches_mesh` with its pictures in the folder of --greenough-pictures."""
    from .assert_matches_mesh import PICTURES, assert_matches_mesh

    asked = request.config.getoption(_OPTION)
    folder = request.config.rootpath / PICTURES if asked is None else Path(request.config.invocation_params.dir, asked)
    return partial(assert_matches_mesh, pictures=folder)
