"""Height maps come back from their files in metres, the right way round, with their voids and what is known of them.

The readers are Gwyddion's format library, ISO 25178-72's, and for GSF what its specification says, byte by byte.
"""

import hashlib
import zipfile
from xml.etree import ElementTree

import gwyfile
import numpy as np
import pytest
import x3pio

from greenough.pipeline.height_map import HeightMap
from greenough.pipeline.height_map_files import write_gsf, write_gwy, write_x3p

HOSTILE = {
    "rig": "<script>alert('&')</script>",
    "note": "two\nlines\x00and\x1bmore",
    "é": "µm",
    "x": "1",
    "run": "",
    "XRes": "7",
    "lo cal": "gap = 3",
}


def lopsided(**changes):
    """5 rows and 8 columns 20 µm apart, like no mirror image of themselves, with two voids."""
    z = 1e-3 * np.arange(40.0).reshape(5, 8) ** 1.5
    z[0, 7] = z[3, 2] = np.nan
    return HeightMap(**({"z": z, "pitch": 0.02, "left": -0.4, "top": 1.6, "facts": {"rig": "twin"}} | changes))


def read_gsf(path):
    data = path.read_bytes()
    end = data.index(b"\0")
    lines = data[:end].decode().splitlines()
    assert lines[0] == "Gwyddion Simple Field 1.0"
    header = dict(line.split(" = ", 1) for line in lines[1:])
    start = end + 4 - end % 4
    assert data[end:start] == bytes(start - end)
    rows, cols = int(header["YRes"]), int(header["XRes"])
    assert len(data) == start + 4 * rows * cols
    return header, np.frombuffer(data[start:], "<f4").reshape(rows, cols)


def test_gwy_holds_metres_seen_from_above_and_masks_voids(tmp_path):
    heights = lopsided()
    write_gwy(heights, tmp_path / "h.gwy")
    file = gwyfile.load(str(tmp_path / "h.gwy"))
    field, mask = file["/0/data"], file["/0/mask"]
    np.testing.assert_array_equal(mask.data == 1, heights.voids)
    np.testing.assert_allclose(field.data[~heights.voids], 1e-3 * heights.z[~heights.voids], rtol=1e-15)
    assert np.isfinite(field.data).all()
    for each in (field, mask):
        assert (each.xreal, each.yreal) == pytest.approx((8 * 20e-6, 5 * 20e-6))
        # The middle of the first node's square is the node, and y has the other sign.
        assert (each.xoff + 10e-6, each.yoff + 10e-6) == pytest.approx((-0.4e-3, -1.6e-3))
        assert each.si_unit_xy.unitstr == "m"
    assert field.si_unit_z.unitstr == "m"
    assert dict(file["/0/meta"]) == {"rig": "twin"}


def test_a_map_without_voids_has_no_mask(tmp_path):
    write_gwy(lopsided(z=np.ones((3, 4))), tmp_path / "h.gwy")
    assert "/0/mask" not in gwyfile.load(str(tmp_path / "h.gwy"))


@pytest.mark.parametrize("title", ["", "a", "ab", "abc", "abcd"])
def test_gsf_holds_metres_seen_from_above_and_nan(tmp_path, title):
    heights = lopsided(facts={"note": title})
    write_gsf(heights, tmp_path / "h.gsf")
    header, z = read_gsf(tmp_path / "h.gsf")
    np.testing.assert_array_equal(z, (1e-3 * heights.z).astype(np.float32))
    lengths = [float(header[name]) for name in ("XReal", "YReal", "XOffset", "YOffset")]
    assert lengths == pytest.approx([160e-6, 100e-6, -0.4e-3 - 10e-6, -1.6e-3 - 10e-6])
    assert header["XYUnits"] == header["ZUnits"] == "m"
    assert header["note"] == title


def test_x3p_holds_our_coordinates_in_metres(tmp_path):
    heights = lopsided()
    write_x3p(heights, tmp_path / "h.x3p")
    file = x3pio.read(tmp_path / "h.x3p")
    found = file.layers[0].points(coordinate_system=x3pio.CoordinateSystem.GLOBAL)
    x, y = np.meshgrid(-0.4 + 0.02 * np.arange(8), 1.6 - 0.02 * np.arange(5))
    expected = np.stack([x, y, heights.z], axis=-1)[~heights.voids]
    found = found[np.isfinite(found[..., 2])]
    order = [np.lexsort(points.round(9).T) for points in (1e3 * found, expected)]
    np.testing.assert_allclose(1e3 * found[order[0]], expected[order[1]], atol=1e-12)


def test_an_x3p_archive_is_as_the_standard_asks(tmp_path):
    write_x3p(lopsided(), tmp_path / "h.x3p")
    with zipfile.ZipFile(tmp_path / "h.x3p") as archive:
        main = archive.read("main.xml")
        assert archive.read("md5checksum.hex").split()[0].decode().lower() == hashlib.md5(main).hexdigest()
        root = ElementTree.fromstring(main)
        assert [child.tag for child in root] == ["Record1", "Record2", "Record3", "Record4"]
        binary = archive.read(root.findtext("Record3/DataLink/PointDataLink"))
        checksum = root.findtext("Record3/DataLink/MD5ChecksumPointData").lower()
    assert hashlib.md5(binary).hexdigest() == checksum
    stored = np.frombuffer(binary, "<f8").reshape(5, 8)
    np.testing.assert_array_equal(stored, 1e-3 * lopsided().z[::-1])  # the lowest row first
    assert [root.findtext(f"Record1/Axes/{axis}/AxisType") for axis in ("CX", "CY", "CZ")] == ["I", "I", "A"]
    assert [float(root.findtext(f"Record1/Axes/{axis}/Increment")) for axis in ("CX", "CY")] == pytest.approx(
        [20e-6] * 2
    )
    assert root.findtext("Record1/FeatureType") == "SUR"
    assert root.findtext("Record2/ProbingSystem/Type") == "NonContacting"


def test_what_facts_hold_cannot_break_a_file(tmp_path):
    heights = lopsided(facts=HOSTILE)
    for write, name in ((write_gwy, "h.gwy"), (write_gsf, "h.gsf"), (write_x3p, "h.x3p")):
        write(heights, tmp_path / name)
    meta = gwyfile.load(str(tmp_path / "h.gwy"))["/0/meta"]
    assert (meta["rig"], meta["note"]) == (HOSTILE["rig"], "two?lines?and?more")
    assert (meta["é"], meta["x"], meta["run"]) == ("µm", "1", "")
    header, z = read_gsf(tmp_path / "h.gsf")
    assert header["XRes"] == "8"
    assert "lo cal" not in header
    assert z.shape == (5, 8)
    with zipfile.ZipFile(tmp_path / "h.x3p") as archive:
        main = archive.read("main.xml")
    assert b"<script" not in main
    comment = ElementTree.fromstring(main).findtext("Record2/Comment")
    assert f"rig={HOSTILE['rig']}" in comment
    assert x3pio.read(tmp_path / "h.x3p").metadata.instrument.model == HOSTILE["rig"]
