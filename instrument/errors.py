"""The one error that speaks to a person instead of a programmer."""


class InputError(ValueError):
    """What a user gave cannot be used: one sentence, without a full stop, of what, where, allowed range and remedy.

    The command line prints the sentence and exits with 2. Anything else that is raised is a programming error and
    stays a traceback.
    """
