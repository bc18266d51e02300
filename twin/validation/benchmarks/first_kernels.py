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
from typing import Literal, cast

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
    """

    first_s: float
    second_s: float
    compile_s: float
    compiled: int
    cached: int


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
    work = {"decode": _decode, "capture": _capture}[step](rig_name, overrides)
    from greenough.pipeline.jit import dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        first_s = _seconds(work)
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    return FirstUse(
        first_s=first_s,
        second_s=_seconds(work),
        compile_s=1e-3 * sum(kernel["backend_time"] for kernel in kernels),
        compiled=sum(not kernel["cache_hit"] for kernel in kernels),
        cached=sum(bool(kernel["cache_disk"]) for kernel in kernels),
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


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    step, rig_name, *overrides = sys.argv[1:]
    json.dump(asdict(use(cast(Step, step), rig_name, overrides)), sys.stdout)
