"""The one error a user can cause."""


class InputError(ValueError):
    """Something the user gave cannot be used; the message names it and says what was expected.

    The commands print the message as one line and exit with code 2; msgspec prefixes the path of
    the key when it is raised while a file is decoded.
    """
