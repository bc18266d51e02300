"""How long a command line waits before anything is computed: imports, and kernels that must be compiled first."""

import subprocess
import sys
from collections.abc import Sequence

from .first_kernels import Step, first_uses
from .rows import Row, interleaved, limited

HELP_LIMIT_S = 0.3
REPEATS = 11

_GREENOUGH = "from greenough.instrument.command import main; main()"


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Start-up of the command and of Python alone, and the first use of a decoding and of a rendering kernel."""
    return [*help_rows(), *kernel_rows("decode", rig_name, overrides), *kernel_rows("capture", rig_name, overrides)]


def help_rows() -> list[Row]:
    """Wall time of ``greenough --help`` in a process of its own, beside one that does nothing."""
    programs = {"greenough --help": [_GREENOUGH, "--help"], "python -c pass": ["pass"]}
    works = {
        name: lambda program=program: subprocess.run(
            [sys.executable, "-c", *program], check=True, stdout=subprocess.DEVNULL
        )
        for name, program in programs.items()
    }
    (command, seconds), (bare, bare_seconds) = interleaved(works, REPEATS).items()
    return [limited(command, seconds, "s", None, None, HELP_LIMIT_S), Row(bare, bare_seconds, "s")]


def kernel_rows(step: Step, rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """What a process that uses a step for the first time waits for, with and without its kernels on disk."""
    empty, filled = first_uses(step, rig_name, overrides)
    first = f"first {step}, no kernel on disk"
    again = f"kernels of a first {step} compiled anew in spite of the disk"
    another = f"kernels of a {step} compiled for another instrument"
    return [
        Row(first, empty.first_s, "s"),
        Row(f"of which compiling, {step}", empty.compile_s, "s", first, empty.compile_s / empty.first_s),
        Row(f"first {step}, kernels on disk", filled.first_s, "s", first, filled.first_s / empty.first_s),
        Row(f"second {step} of a process", filled.second_s, "s", first, filled.second_s / empty.first_s),
        limited(again, filled.compiled, "kernels", None, None, 0),
        limited(another, empty.compiled_for_another, "kernels", None, None, 0),
    ]
