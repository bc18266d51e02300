"""What the first use of a step costs a new process, of which Dr.Jit compiles the kernels or finds them on disk.

Run as a module it is that process.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, cast

Step = Literal["decode", "capture"]


@dataclass(frozen=True)
class FirstUse:
    """The first and the second use of a step by a process.

    Parameters
    ----------
    first_s, second_s : float
        Wall times.
    compile_s : float
        How long LLVM, or the driver of a GPU, compiled for the first use.
    compiled, cached : int
        Kernels that were compiled for the first use, and that an earlier process had left on disk.
    compiled_for_another : int
        Kernels that were then compiled for the same step of another instrument, from its opening on, after the first
        was given up.
    """

    first_s: float
    second_s: float
    compile_s: float
    compiled: int
    cached: int
    compiled_for_another: int


def first_uses(step: Step, rig_name: str, overrides: Sequence[str]) -> tuple[FirstUse, FirstUse]:
    """The same step in two new processes: the first finds no kernel on disk, the second those of the first.

    Dr.Jit keeps its kernels under the home folder, which is a temporary one here.
    """
    command = [sys.executable, "-m", __name__, step, rig_name, *overrides]
    with tempfile.TemporaryDirectory() as home:
        environment = os.environ | {"HOME": home}
        empty, filled = (
            FirstUse(**json.loads(subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE).stdout))
            for _ in range(2)
        )
    return empty, filled


def use(step: Step, rig_name: str, overrides: Sequence[str]) -> FirstUse:
    """Use a step twice in this process, which has not used it before."""
    prepare = {"decode": _decode, "capture": _capture}[step]
    work = prepare(rig_name, overrides)
    first_s, kernels = _kernels(work)
    second_s, _ = _kernels(work)
    del work  # Dr.Jit numbers the materials of all scenes alive, and writes the numbers into kernels
    _, more = _kernels(lambda: prepare(rig_name, [*overrides, *_another(rig_name, overrides)])())
    return FirstUse(
        first_s=first_s,
        second_s=second_s,
        compile_s=1e-3 * sum(kernel["backend_time"] for kernel in kernels),
        compiled=_compiled(kernels),
        cached=sum(bool(kernel["cache_disk"]) for kernel in kernels),
        compiled_for_another=_compiled(more),
    )


def _decode(rig_name: str, overrides: Sequence[str]) -> Callable[[], object]:
    from greenough.instrument.rigfile import load_rig_file
    from greenough.pipeline.decode import decode
    from greenough.pipeline.fringes import FringeSet

    from .synthetic import frames

    rig_file = load_rig_file(rig_name, overrides)
    fringes = FringeSet(rig_file.procedure.periods_px, rig_file.procedure.steps)
    stack = frames(fringes, rig_file.camera.shape, noise_dn=2.0)
    return lambda: decode(stack, fringes, rig_file.camera.noise)


def _capture(rig_name: str, overrides: Sequence[str]) -> Callable[[], object]:
    from greenough.instrument.contract import Placement

    from ...rig import fringe_patterns
    from ...rig import open as open_twin

    rig, _ = open_twin(rig_name, overrides, run="benchmark")
    patterns = fringe_patterns(rig)
    rig.operator.place(Placement("board"))
    return lambda: rig.capture(patterns)


def _another(rig_name: str, overrides: Sequence[str]) -> list[str]:
    """Overrides that make another instrument of the same kind."""
    from ...settings import load_twin_file

    _, settings = load_twin_file(rig_name, overrides)
    return [f"twin.seed={settings.seed + 1}"]


def _kernels(work: Callable[[], object]) -> tuple[float, list[dict[str, Any]]]:
    """Wall time of ``work``, and Dr.Jit's notes about the kernels that it launched."""
    from greenough.pipeline.jit import dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        work()
        seconds = time.perf_counter() - start
        return seconds, [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]


def _compiled(kernels: list[dict[str, Any]]) -> int:
    return sum(not kernel["cache_hit"] for kernel in kernels)


if __name__ == "__main__":
    step, rig_name, *overrides = sys.argv[1:]
    json.dump(asdict(use(cast(Step, step), rig_name, overrides)), sys.stdout)
