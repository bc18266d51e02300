"""Which frame of somebody's files is which step of which period, as their names say it."""

import re
from collections import Counter
from collections.abc import Sequence

from .errors import InputError
from .frame_files import natural_key

_STEP_WORDS = ("step", "shift", "phase", "ph", "n")
_SET_WORDS = ("freq", "frequency", "period", "set", "f", "p", "fringe", "wavelength", "lambda")


def selected(text: str, count: int, option: str) -> list[int]:
    """Numbers of frames, from 0, as in ``0-5,8``; a range may run backwards.

    Raises InputError where this is something else, or no frame has such a number.
    """
    numbers: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})(?:\s*-\s*(\d{1,6}))?\s*", part)
        if match is None:
            raise InputError(f"{option} {text}: give numbers of frames, from 0, as in 0-5,8")
        first, last = int(match[1]), int(match[2] or match[1])
        step = 1 if last >= first else -1
        numbers += range(first, last + step, step)
    if max(numbers) >= count:
        raise InputError(f"{option} {text}: there are {count} frames, so that numbers go from 0 to {count - 1}")
    return numbers


def guess_order(names: Sequence[str], periods: Sequence[float], steps: Sequence[int]) -> tuple[list[int], str]:
    """The order in which frames belong to the periods and steps as listed, and the reason in words.

    Names with two numbers that vary, one counting periods and one counting steps, tell it, whichever comes first.
    Others are taken in the order that they have, but where this is that of the letters (``10`` before ``2``) in the
    order of their numbers.

    Returns
    -------
    order : list of int
        Indices into ``names``.
    reason : str
    """
    order, reason = list(range(len(names))), "the order of the files"
    natural = sorted(order, key=lambda k: natural_key(names[k]))
    if list(names) == sorted(names) and natural != order:
        order, reason = natural, "numbers in the names"
    fields = [tuple(int(number) for number in re.findall(r"\d+", name)) for name in names]
    if len({len(numbers) for numbers in fields}) != 1:
        return order, reason
    varying = [k for k in range(len(fields[0])) if len({numbers[k] for numbers in fields}) > 1]
    if len(varying) != 2:
        return order, reason
    words = re.split(r"\d+", names[0])
    fits = [k for k in varying if _counts_sets([numbers[k] for numbers in fields], periods, steps)]
    if not fits:
        return order, reason
    named = [k for k in fits if _word(words[k]) in _SET_WORDS or _word(words[_other(k, varying)]) in _STEP_WORDS]
    of_set = (named or fits)[0]
    of_step = _other(of_set, varying)
    values = sorted({numbers[of_set] for numbers in fields})
    if set(values) == {round(period) for period in periods} and len(values) == len(periods):
        values = [round(period) for period in periods]  # the names hold the periods themselves
    order = sorted(order, key=lambda k: (values.index(fields[k][of_set]), fields[k][of_step]))
    place = "first" if of_set < of_step else "second"
    what = f" after '{words[of_set]}'" if words[of_set] else ""
    return order, f"the {place} number that varies in the names{what} counts periods, the other one steps"


def _counts_sets(numbers: Sequence[int], periods: Sequence[float], steps: Sequence[int]) -> bool:
    """Whether each value comes as often as its period has steps."""
    counts = Counter(numbers)
    if set(counts) == {round(period) for period in periods} and len(counts) == len(periods):
        return all(counts[round(period)] == step for period, step in zip(periods, steps, strict=True))
    return [counts[value] for value in sorted(counts)] == list(steps)


def _other(k: int, two: Sequence[int]) -> int:
    return two[1] if k == two[0] else two[0]


def _word(text: str) -> str:
    """The last word before a number, in small letters."""
    found = re.findall(r"[a-z]+", text.lower())
    return found[-1] if found else ""
