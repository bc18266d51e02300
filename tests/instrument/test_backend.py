import pytest

from greenough.instrument.backend import VARIABLE, VARIANTS, backend
from greenough.instrument.errors import InputError
from greenough.instrument.libatomic import ensure_libatomic
from greenough.instrument.llvm import ensure_llvm

ensure_libatomic()
ensure_llvm()

import drjit as dr  # noqa: E402  Dr.Jit loads both libraries while it is imported


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_users_choice_is_taken_whatever_the_machine_has(monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    for found in (True, False):
        monkeypatch.setattr(dr, "has_backend", lambda _, found=found: found)
        monkeypatch.setenv(VARIABLE, variant)
        assert f"{backend()}_ad_mono" == variant


@pytest.mark.parametrize(("found", "chosen"), [(True, "cuda"), (False, "llvm")])
def test_a_gpu_is_used_where_there_is_one(monkeypatch: pytest.MonkeyPatch, found: bool, chosen: str) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(dr, "has_backend", lambda asked: found and asked == dr.JitBackend.CUDA)
    assert backend() == chosen


def test_another_variant_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "scalar_rgb")
    with pytest.raises(InputError, match=r"GREENOUGH_VARIANT: .*'scalar_rgb'.*cuda_ad_mono, llvm_ad_mono"):
        backend()
