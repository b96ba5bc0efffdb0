"""What `run-benchmark skipping` finds of one pair: the same result with a skip and without it."""

from statistics import median

from ctsim.benchmarks.engine.record import Found

CORE = "core"  # the size that says something about speed


class Skip(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One skip: seconds "skipping" and "whole", run by run in pairs, and the largest difference of the result.

    `difference` is in what `unit` says, None where it is not finite; `limit` is what `stated` allows it, None where
    the two are meant to differ.
    """

    scene: str = ""
    what: str = ""
    difference: float | None = None
    unit: str = ""
    limit: float | None = None
    stated: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        pairs = [self.seconds.get(way, ()) for way in ("skipping", "whole")]
        if self.seconds and not (len(self.seconds) == 2 and len(pairs[0]) == len(pairs[1]) > 0):
            raise ValueError('seconds must be as many for "skipping" as for "whole", and for nothing else')
        if not all(second > 0 for seconds in pairs for second in seconds):
            raise ValueError("seconds must be positive")

    @property
    def gain(self) -> float:
        """Median over pairs of neighbouring runs of the time without the skip over that with it."""
        return median(b / a for a, b in zip(self.seconds["skipping"], self.seconds["whole"], strict=True))
