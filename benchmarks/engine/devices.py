"""Whether the device that was asked for is there: known before the first run, not from every record."""

from ctsim.errors import InputError


def check_device(device: str) -> None:
    """Refuse a device on which this machine cannot compute.

    Raises
    ------
    InputError
        When the name is none of torch's, or the device is not there.
    """
    if device == "cpu":
        return
    import torch  # seconds that the usual case does without

    expected = "expected cpu" + (", cuda or cuda:N" if torch.cuda.is_available() else "")
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise InputError(f"--device {device!r}: no such kind of device; {expected}") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"--device {device}: this machine, or this build of torch, has no such device; {expected}")
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = " ".join(str(error).split()).partition(". ")[0] or type(error).__name__
        raise InputError(f"--device {device}: cannot be used ({reason}); {expected}") from None
