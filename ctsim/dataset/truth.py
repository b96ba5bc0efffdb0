"""A scan with its ground truth: what stored scans and scans in memory have in common."""

import abc
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.scaninfo import TWIN, ScanInfo

if TYPE_CHECKING:
    from ctsim.types import Scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanWithTruth(abc.ABC):
    """A scan and what judges a reconstruction of it. `scan` is what a method gets; the rest is ground truth.

    `info` is what scan.json says. `metal_free` is the paired twin without metal, or None; the names of a twin's arrays
    begin with its `prefix`. Arrays are handed out fresh each time: what a caller writes into one reaches no other.
    """

    name: str
    scene_id: str
    info: ScanInfo
    prefix: str = ""
    metal_free: Self | None = None

    @abc.abstractmethod
    def file(self, name: str) -> NDArray[Any]:
        """Return an array by its full name, such as "metal_free/counts". Raises InputError where there is none."""

    @abc.abstractmethod
    def text(self, name: str) -> str | None:
        """Return a text by its file's name, such as "scene.toml"; None where the scan comes without."""

    @property
    def scan(self) -> "Scan":
        """Return the readings: what is written into them stays with the one who asked.

        Raises
        ------
        InputError
            When an array cannot be read, and when the open field has no usable pixel.
        """
        import torch  # seconds that listing and verifying do without

        from ctsim.types import Scan

        counts, flat = (torch.from_numpy(self.file(name)) for name in readings(self.prefix))
        info, name = self.info, f"{self.name}/{self.prefix}".rstrip("/")
        try:
            return Scan(
                geometry=info.geometry,
                counts=counts,
                flat=flat,
                dark=info.dark,
                i0=info.i0,
                e_max=info.e_max,
                name=name,
            )
        except InputError as error:
            raise InputError(f"{self.place}: {error}") from None

    @property
    def place(self) -> str:
        """Return where the scan is, for messages."""
        return self.name

    @property
    def has_truth(self) -> bool:
        """Whether there is a truth to judge volumes by, as of every simulated scan and of no measured one."""
        return True

    @property
    def is_twin(self) -> bool:
        """Whether this is the twin without metal of another scan."""
        return self.prefix == TWIN

    @property
    def geometry(self) -> Geometry:
        """Return the scan's geometry."""
        return self.info.geometry

    @property
    def l0(self) -> float:
        """Return the scene's median water-equivalent path in mm."""
        return self.info.l0

    @property
    def kerma(self) -> float | None:
        """Return the scan's air kerma (mGy) at the isocentre; None where scan.json of an older scan lacks it."""
        return self.info.scan_kerma

    @property
    def labels(self) -> NDArray[np.uint8]:
        """Return the label volume, uint8 [z, y, x]."""
        return self.array("labels")

    @property
    def metal(self) -> NDArray[np.uint8]:
        """Return the metal mask, uint8 [z, y, x]."""
        return self.array("metal")

    def reference(self, which: str) -> NDArray[np.float32]:
        """Return the true attenuation, "effective" (effective spectrum) or "50kev": float32 [z, y, x] in 1/mm."""
        return self.array(f"reference_{which}")

    def array(self, name: str) -> NDArray[Any]:
        """Return one array, such as "noise_free".

        Raises
        ------
        InputError
            When the scan was made without it.
        """
        return self.file(self.prefix + name)


def readings(prefix: str) -> tuple[str, str]:
    """Return the names of a scan's counts and of its open field, which a twin shares."""
    return f"{prefix}counts", "flat"
