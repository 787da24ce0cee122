"""The one exception for mistakes in the user's input, and nothing else."""


class InputError(ValueError):
    """Input that cannot be used; the message is one line: the thing and the mend.

    Scripts turn it into that one line and exit code 2; library users catch it as
    a `ValueError`.
    """


class InputWarning(UserWarning):
    """Input that was mended on the way in; the message says how."""
