"""The object as a sum of Gaussians, each with two densities."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.reconstruct.splat.kernels.rotations_cpu import write_rotations


@dataclass(frozen=True, slots=True, kw_only=True)
class Splats:
    """Gaussians exp(−½(x − p)ᵀΣ⁻¹(x − p)), Σ = R diag(s²) Rᵀ, with densities ρa and ρb in 1/mm at their peaks.

    `positions` float32 [splat, 3] (x, y, z) and `scales` float32 [splat, 3] are mm; scales [splat, 1] and no rotation
    mean round splats. `rotations` are quaternions (w, x, y, z), float32 [splat, 4], of any length but zero.
    `densities` float32 [splat, channel], one or two channels. Raises InputError where shapes disagree.
    """

    positions: NDArray[np.float32]
    scales: NDArray[np.float32]
    densities: NDArray[np.float32]
    rotations: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        n = len(self.positions)
        wanted = {"positions": [(n, 3)], "scales": [(n, 1 if self.rotations is None else 3)]}
        wanted |= {"densities": [(n, 1), (n, 2)], "rotations": [(n, 4)]}
        for name, shapes in wanted.items():
            array = getattr(self, name)
            if array is not None and (array.shape not in shapes or array.dtype != np.float32):
                expected = " or ".join(str(s) for s in shapes)
                raise InputError(
                    f"{name} of splats must be float32 of shape {expected}, got {array.dtype} {array.shape}"
                )

    def __len__(self) -> int:
        return len(self.positions)

    def shapes(self) -> NDArray[np.float32]:
        """Return what the kernels take: [4, splat] for round splats, [15, splat] for others."""
        shapes = np.empty((4 if self.rotations is None else 15, len(self)), np.float32)
        shapes[:3], shapes[3 : 3 + self.scales.shape[1]] = self.positions.T, self.scales.T
        if self.rotations is not None:
            write_rotations(self.rotations, shapes[6:])
        return shapes
