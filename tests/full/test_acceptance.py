"""The whole acceptance on coarse pixels: every row comes, and what coarse pixels can do holds."""

import json
from importlib.metadata import entry_points

import pytest

from greenough.instrument.command import GROUP, run
from greenough.twin.validation.acceptance.table import GROUPS

COARSE = (
    "camera.rows=360", "camera.cols=480", "twin.optics.camera_focal_px=8506.125", "twin.render.nodes_edges=16",
    "procedure.postures=10", "procedure.planes=10", "procedure.plane_step_mm=0.3",
)  # fmt: skip

COARSE_METAL = ("bga_", "noise_coin", "noise_bga")
"""How names of rows about metal begin: over so coarse a pixel its brightness changes too much."""


@pytest.fixture(scope="module")
def accepted(tmp_path_factory) -> tuple[int, dict]:
    """Exit code and table."""
    out = tmp_path_factory.mktemp("acceptance") / "table.json"
    settings = [word for setting in COARSE for word in ("--set", setting)]
    code = run(["accept", "twin", "--out", str(out), *settings], entry_points(group=GROUP))
    return code, json.loads(out.read_text(encoding="utf-8"))


def test_every_row_comes_and_the_exit_code_says_whether_all_hold(accepted):
    code, table = accepted
    found = [row["name"] for row in table["rows"]]
    assert len(set(found)) == len(found)
    assert set(found) == {name for group in GROUPS.values() for name in group.names}
    assert not table["missing"]
    assert code == int(any(row["holds"] is False for row in table["rows"]))


def test_all_but_metal_holds_on_coarse_pixels(accepted):
    _, table = accepted
    judged = [row for row in table["rows"] if not row["name"].startswith(COARSE_METAL)]
    assert [row for row in judged if row["holds"] is False] == []
    assert sum(row["holds"] is True for row in judged) > len(judged) / 2


def test_figures_have_their_uncertainty_and_peers_their_ratio(accepted):
    _, table = accepted
    for row in table["rows"]:
        if row["name"].startswith(("sphere_size", "sphere_spacing_x", "step_300", "alpha_", "lateral_period")):
            assert row["u"] > 0, row
        assert (row["ratio"] is None) == (row["peer"] is None or row["value"] is None), row
