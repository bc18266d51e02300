import subprocess
import sys

import pytest

# In a process of its own: in this one a work may take what others have left free.
PEAKS = """
import numpy as np
from greenough.twin.validation.benchmarks.peak_memory import peak_mb

given = np.ones(4_000_000, np.float32)  # 16 MB


def work() -> float:
    twice = np.concatenate([given, given])  # 32 MB
    return float(np.concatenate([twice, given])[0])  # 48 MB more


print(peak_mb(work), peak_mb(lambda: float(given[0])))
"""


def test_what_a_work_takes_beyond_its_input_is_its_peak() -> None:
    done = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True, check=True)
    taken, nothing = (float(value) for value in done.stdout.split())
    assert taken == pytest.approx(80, rel=0.1)
    assert nothing < 8
