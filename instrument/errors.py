"""The one error that speaks to a person instead of a programmer."""


class InputError(ValueError):
    """What a user gave cannot be used: one sentence that says what, where, the allowed range and the remedy.

    The command line prints the sentence and exits with 2. Anything else that is raised is a programming error and
    stays a traceback.
    """
