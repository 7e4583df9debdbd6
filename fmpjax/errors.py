"""The one error a user may cause."""


class UserError(ValueError):
    """Bad input: one sentence naming the thing, its value and what was expected.

    The command line prints the sentence and exits with code 2; as a library the exception carries it.
    """
