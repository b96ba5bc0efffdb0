"""How far apart rounding alone may bring two ways to the same scan."""

import numpy as np

from ctsim.plan import Plan
from ctsim.shadow import MOST_TIMES
from ctsim.simulate import simulate_views
from ctsim.types import Phantom, Scanner

HALF_ULP = 2.0**-24  # of float32, relative


def rounding(plan: Plan, phantom: Phantom, scanner: Scanner) -> float:
    """Bound |ΔP| of two ways that take the same rays, or equal ones more often, under a plan that skips nothing.

    Each way rounds, in float32: a product and a sum a material in every τ; exp(−τ), within 4e-7·max(1, τ/4)
    (tests/test_project.py); a product and a sum an energy; a division by the open field; the logarithm, within 4 ulp
    (NumPy states 3.83), which are at most 8 half ulps of P. The signal's error is the mean of those of its energies,
    weighted by what each lets through, and the mean τ under these weights is at most P (Gibbs' inequality). A pixel
    has up to `subrays`·`MOST_TIMES` rays, summed in a row; beyond a shadow one with the skip, and as many equal ones
    without it.
    """
    views = simulate_views(plan, phantom, scanner)
    p = max(0.0, *(float(np.max(images["noise_free"])) for _, images in views))
    materials, energies = len(plan.materials), len(plan.rule.energies)
    rays = plan.settings.subrays * MOST_TIMES
    return 2 * ((materials * p + energies + rays + 1 + 8 * p) * HALF_ULP + 4e-7 * (1 + p / 4))
