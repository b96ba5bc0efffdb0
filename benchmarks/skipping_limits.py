"""How far apart rounding alone may bring two ways to the same scan."""

import numpy as np

from ctsim.plan import Plan
from ctsim.shadow import MOST_TIMES
from ctsim.simulate import simulate_views
from ctsim.types import Phantom, Scanner

HALF_ULP = 2.0**-24  # of float32, relative


def rounding(plan: Plan, phantom: Phantom, scanner: Scanner) -> float:
    """Bound |ΔP| of two ways that take the same rays, one of which may take the mean of equal ones for a single one.

    Each way rounds, in float32: a product and a sum a material in every τ; exp(−τ), within 4e-7·max(1, τ/4)
    (tests/test_project.py); a product and a sum an energy; a division by the open field; the logarithm, within 4 ulp
    (NumPy states 3.83), which are at most 8 half ulps of P. The signal's error is the mean of those of its energies,
    weighted by what each lets through, and the mean τ under these weights is at most P (Gibbs' inequality). A pixel
    beyond a shadow has one ray with the skip, and without it up to `subrays`·`MOST_TIMES` equal ones, summed in a row.
    """
    views = simulate_views(plan, phantom, scanner)
    p = max(0.0, *(float(np.max(images["noise_free"])) for _, images in views))
    materials, energies = len(plan.materials), len(plan.rule.energies)
    way = (materials * p + energies + 1 + 8 * p) * HALF_ULP + 4e-7 * (1 + p / 4)
    return 2 * way + plan.settings.subrays * MOST_TIMES * HALF_ULP
