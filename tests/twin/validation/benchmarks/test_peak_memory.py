import numpy as np
import pytest

from greenough.twin.validation.benchmarks.peak_memory import peak_mb


def test_what_a_work_takes_beyond_its_input_is_its_peak() -> None:
    given = np.ones(4_000_000, np.float32)  # 16 MB

    def work() -> float:
        twice = np.concatenate([given, given])  # 32 MB
        return float(np.concatenate([twice, given])[0])  # 48 MB more

    assert peak_mb(work) == pytest.approx(80, rel=0.1)
    assert peak_mb(lambda: float(given[0])) < 8
