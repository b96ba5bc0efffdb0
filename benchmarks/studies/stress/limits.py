"""What the rows of the stress suite are allowed, and which methods have something in common. Loads nothing."""

FULL, SHORT = 24, 16  # voxels along a side
P_SURE = 1.2e-4  # |ΔP|: 1e-4 of the energies where P ≤ 14.6, a tenth more between the paths tried, float32's 1e-5
CLAMP = 81.0  # of P: exponents end at 80, and the weight of one node
MASS = 0.01  # of a rod on the grid: 1/250 of every voxel that its surface crosses, of 216 cm³ for its 94 at worst
FLOAT32 = 2e-5  # |ΔP|: exp is good to 4e-7·max(1, P/4) and so are the sums; lengths of 50 mm to 8e-6 mm, by 0.5/mm
NEAR = 0.7  # of an empty volume's error
SAME = 1e-3  # of the greatest value: float32
SAME_BY_DESCENT = 0.03
BOUNDS = {"ibhc": 10.0}  # adds to P what its own volume says of hardening, streaks included
PROJECTED, VOXELISED, RESPONDED = 1e-5, 1e-5, 2e-6  # splats: of the peak, of the greatest voxel, of the response

SPLATS = ("splat", "splat-paper", "splat-r2")
GROUPS: dict[str, tuple[str, ...]] = {
    "by-mask": ("limar", "nmar", "bhc-poly"),
    # their steps are of one length whatever the gradient of TV, in flat regions rounding
    "descent": ("asd-pocs", "awpcsd"),
    "ordered": ("sart", "os-sart", "asd-pocs", "awpcsd", *SPLATS),  # a view that comes twice moves them twice
    "sampled": ("bhc-poly",),  # fits in 64 views, other ones where there are twice as many
    "physical": (*SPLATS, "ibhc"),  # take materials from tables in 1/mm
}
"""Methods that have something in common, by the names that a scene's `unlike` may give."""


def bound_of(method: str) -> float:
    """Return how far values may exceed FDK's closed-form bound."""
    return BOUNDS.get(method, 1.0)


def same_of(method: str) -> float:
    """Return how far two forms of one scan may be from each other, of the greatest value."""
    return SAME_BY_DESCENT if method in GROUPS["descent"] else SAME
