"""The errors that speak to a person instead of a programmer."""


class InputError(ValueError):
    """What a user gave cannot be used: one sentence, without a full stop, of what, where, allowed range and remedy.

    The command line prints the sentence and exits with 2. Anything else that is raised is a programming error and
    stays a traceback.
    """


class FileError(InputError):
    """The machine refused to read or write a file: its disk is full, its folder is missing, it may not be read, ...

    It says nothing about what was captured, computed or given. Whoever takes a refusal for a result, or drops what led
    to it, lets this one pass.
    """
