"""The one error a user can cause."""


class InputError(ValueError):
    """Something the user gave cannot be used; the message names it and says what was expected.

    The commands print the message as one line and exit with code 2; msgspec prefixes the path of
    the key when it is raised while a file is decoded.
    """


def check_kind(name: str, value: object, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise InputError unless `value` is an instance of one of the `kinds`, which the sentence calls `expected`."""
    if not isinstance(value, kinds):
        raise InputError(f"{name}: expected {expected}, got {type(value).__name__}")
