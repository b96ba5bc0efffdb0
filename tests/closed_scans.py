"""Scans of ellipsoids in closed form: quick to make, and exact but for noise."""

import numpy as np

from ctsim.geometry import Geometry

GEOMETRY = Geometry(
    dso=150.0,
    dsd=300.0,
    n_voxel=(16, 24, 20),
    d_voxel=(2.0, 1.5, 1.5),
    n_detector=(32, 40),
    d_detector=(1.6, 1.6),
    n_views=24,
    start_deg=10.0,
    arc_deg=-360.0,
    off_detector=(1.2, 0.0),
)
LEVEL, PHOTONS = 40000.0, 2e5
BODY = (((1, 2, 0), (11, 9, 8), 0.02), ((4, -3, 2), (2, 3, 3), 0.03), ((-4, 3, -1), (2, 2, 3), -0.01))
BEAN = (((-3, 0, 1), (8, 12, 7), 0.02), ((-5, 4, 0), (3, 2, 4), 0.025), ((2, -5, 1), (2, 3, 2), -0.015))
METAL = (((3, 4, 0), (1.2, 1.2, 6), 1.5), ((-5, -2, 1), (1.0, 1.5, 5), 1.5))
WIDE = (((2, 1, 0), (40, 34, 20), 0.02), *BODY[1:])
"""Wider than the detector."""


def line_integrals(geometry: Geometry, solids=BODY):
    """Integrate ellipsoids (centre x y z, half axes, attenuation in 1/mm) along the rays: [view, v, u]."""
    pose = geometry.pose_array()
    (n_v, n_u), out = geometry.n_detector, np.zeros(geometry.shape)
    v, u = np.arange(n_v) - (n_v - 1) / 2, np.arange(n_u) - (n_u - 1) / 2
    for k, (source, centre, e_u, e_v) in enumerate(pose.reshape(-1, 4, 3)):
        ray = centre + u[None, :, None] * e_u + v[:, None, None] * e_v - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        for place, half, mu in solids:
            o, d = (source - np.array(place)) / half, ray / half
            a, b, c = (d * d).sum(2), (d * o).sum(2), (o * o).sum() - 1
            out[k] += mu * 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a
    return out


def counts_of(p, *, level=LEVEL, photons=PHOTONS, seed=3):
    """Draw 16-bit readings of which an open pixel has `level`, with the noise of so many photons."""
    drawn = np.random.default_rng(seed).poisson(photons * np.exp(-p))
    return np.rint(drawn * (level / photons)).clip(0, 65535).astype(np.uint16)
