"""Which files belong together: one pattern for all postures, or all planes, tells them apart by their names."""

import re
from glob import escape, glob
from pathlib import Path

from .errors import InputError
from .frame_files import natural_key

MARK = "{}"
"""What stands in a pattern for that part of the names by which places are told apart."""

_ANY = {"*": "[^/]*", "?": "[^/]", MARK: "([^/]+?)"}


def grouped(pattern: str, folder: Path, what: str) -> dict[str, list[str]]:
    """Paths that match a pattern such as ``board/pose_{}`` or ``planes/z{}_*.png``, by what stands for ``{}``.

    Parameters
    ----------
    pattern : str
        ``{}`` stands for one or more characters, as few as will do, and ``*`` and ``?`` are those of the shell. None of
        them goes beyond one folder. All that match with the same ``{}`` are of one place: a folder, a file, or several.
    folder : Path
        Where relative patterns begin.
    what : str
        Name of the setting, for sentences.

    Returns
    -------
    dict of str to list of str
        In natural order, 2 before 10.

    Raises
    ------
    InputError
        If the pattern has not one ``{}``, or nothing matches.
    """
    if pattern.count(MARK) != 1:
        raise InputError(
            f'{what} = "{pattern}" must have one {MARK} for what tells them apart, as in "board/pose_{MARK}"'
        )
    parts = re.split(r"(\*|\?|\{\})", (folder / pattern).as_posix())
    wanted = "".join("*" if part == MARK else part if part in _ANY else escape(part) for part in parts)
    told_apart = re.compile("".join(_ANY.get(part, re.escape(part)) for part in parts), re.DOTALL)
    groups: dict[str, list[str]] = {}
    for path in sorted(glob(wanted), key=natural_key):
        match = told_apart.fullmatch(Path(path).as_posix())
        if match is not None:
            groups.setdefault(match[1], []).append(path)
    if not groups:
        raise InputError(f'{what} = "{pattern}": nothing in {folder} matches it')
    return {name: groups[name] for name in sorted(groups, key=natural_key)}
