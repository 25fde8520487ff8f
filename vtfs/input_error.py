"""The one error that a user's input can cause."""


class InputError(ValueError):
    """What the user gave is wrong. The message is one line: what, where, and what would be right.

    The command line prints it on stderr and exits with code 2; nothing else is caught there, so
    that a defect of ours keeps its traceback.
    """
