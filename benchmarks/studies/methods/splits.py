"""Whether a method that was trained may have been trained on the very scan that it is scored on."""

from collections.abc import Mapping
from typing import Any

KEY = "trained_on"
FITTED = ("train", "val")
"""The splits of the suite `train` that weights are fitted to and chosen by."""


def with_split(details: Mapping[str, Any], inputs: str, split: str) -> dict[str, Any]:
    """Return a method's details, with the scan's split under "trained_on" where weights may have been fitted to it.

    `inputs` is the method's class; those of trained methods begin with "training".
    """
    return {**details, KEY: split} if split in FITTED and inputs.startswith("training") else dict(details)


def trained_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Say in one sentence which runs are of scans that networks are trained on, of {run: its details}; "" for none."""
    runs = [f"{name} ({details[KEY]})" for name, details in found.items() if KEY in details]
    told = "the scan is of a split that networks are trained on or chosen by, which flatters them"
    return f"{told}: {', '.join(runs)}" if runs else ""
