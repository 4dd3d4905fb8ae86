"""What goes wrong with a control cage."""


class CageError(ValueError):
    """A control cage that cannot be used; the message says what is wrong, where, and what was expected."""


class CageWarning(UserWarning):
    """A control cage that can be used, but is probably not what its author meant."""
