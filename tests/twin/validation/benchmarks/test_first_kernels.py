import pytest

from greenough.twin.validation.benchmarks.first_kernels import first_uses

COARSE = ("camera.rows=48", "camera.cols=64")


@pytest.mark.slow
def test_a_kernel_is_compiled_by_the_first_process_and_found_on_disk_by_the_next() -> None:
    empty, filled = first_uses("decode", "twin", COARSE)
    assert empty.compiled > 0
    assert empty.cached == 0
    assert empty.compile_s > 0
    assert filled.compiled == 0
    assert filled.cached == empty.compiled
    assert filled.compile_s == 0
    assert empty.compiled_for_another == 0
