"""The errors that a user can cause."""


class InputError(ValueError):
    """Something the user gave cannot be used; the message names it and says what was expected.

    The commands print the message as one line and exit with code 2; msgspec prefixes the path of
    the key when it is raised while a file is decoded.
    """


class Unsuited(InputError):
    """A method is not made for a scan of this kind, whatever its values: a benchmark skips it instead of failing."""


def check_kind(name: str, value: object, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise InputError unless `value` is an instance of one of the `kinds`, which the sentence calls `expected`."""
    if not isinstance(value, kinds):
        raise InputError(f"{name}: expected {expected}, got {type(value).__name__}")
