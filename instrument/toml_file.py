"""TOML files that are built-in names or paths, read with sentences that say what is wrong and where."""

import re
import tomllib
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from .errors import InputError
from .file_errors import cannot_read


def names_in(folder: Traversable) -> tuple[str, ...]:
    """Names of the TOML files that come with a package in ``folder``."""
    return tuple(sorted(file.name[:-5] for file in folder.iterdir() if file.name.endswith(".toml")))


def read_toml(name_or_path: str | Path, kind: str, builtin: Traversable) -> tuple[str, dict[str, Any]]:
    """Read a built-in file or one of the user's.

    Parameters
    ----------
    name_or_path : str or Path
        A name wins over a file of the same name; write ``./NAME`` for it.
    kind : str
        What the file is, for sentences: "rig".
    builtin : Traversable
        The folder of the built-in files.

    Returns
    -------
    where : str
        What to call the file in a sentence.
    document : dict

    Raises
    ------
    InputError
        For an unknown name, a file that cannot be read, and malformed TOML (with its line).
    """
    names = names_in(builtin)
    if isinstance(name_or_path, str) and name_or_path in names:
        where = f"built-in {kind} file {name_or_path}"
        return where, _parse((builtin / f"{name_or_path}.toml").read_text(encoding="utf-8"), where)
    path = Path(name_or_path)
    where = f"{kind} file {path}"
    try:
        return where, _parse(path.read_text(encoding="utf-8"), where)
    except FileNotFoundError:
        raise InputError(
            f"no {kind} {path}: give a built-in name ({', '.join(names)}) or the path of a {kind} file"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{where} is not UTF-8 text, so it is not a {kind} file in TOML") from None
    except OSError as error:
        raise cannot_read(path, error, where) from None


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        match = re.fullmatch(r"(.*) \(at (?:line (\d+), column \d+|end of document)\)", str(error), re.DOTALL)
        reason = match[1] if match else str(error)
        line = match[2] if match and match[2] else str(text.count("\n") + 1)
        raise InputError(f"{where} is not valid TOML at line {line}: {reason[:1].lower()}{reason[1:]}") from None
