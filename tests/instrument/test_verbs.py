import json
import re
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument.verbs import show

RESULT = {
    "rmse_um": np.float32(0.25),
    "count": np.int64(7),
    "skipped": None,
    "holds": np.bool_(False),
    "share": np.nan,
    "limits": (np.inf, 2.0),
    "file": Path("a.ply"),
    "matrix": np.eye(2),
    "rows": [{"name": "plane", "value": 1.5}, {"name": "coin", "unit": "um"}],
}


def test_json_keeps_every_value_that_json_knows(capsys: pytest.CaptureFixture[str]) -> None:
    show(RESULT, as_json=True)
    assert json.loads(capsys.readouterr().out) == {
        "rmse_um": 0.25,
        "count": 7,
        "skipped": None,
        "holds": False,
        "share": None,
        "limits": [None, 2.0],
        "file": "a.ply",
        "matrix": [[1.0, 0.0], [0.0, 1.0]],
        "rows": [{"name": "plane", "value": 1.5}, {"name": "coin", "unit": "um"}],
    }


def test_text_lines_up_names_and_tables(capsys: pytest.CaptureFixture[str]) -> None:
    show(RESULT, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"rmse_um +0\.25", lines[0])
    assert re.fullmatch(r"holds +no", lines[3])
    start = lines.index("rows:")
    assert [line.split() for line in lines[start + 1 :]] == [
        ["name", "value", "unit"],
        ["plane", "1.5", "-"],
        ["coin", "-", "um"],
    ]
    assert lines[start + 1].index("unit") == lines[start + 3].index("um")
