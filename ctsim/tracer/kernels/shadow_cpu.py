"""Where the hulls of projected corners lie in every detector row."""

import numpy as np
from numba import njit


@njit(cache=True)
def cast_hulls(us, vs, behind, margin_v, margin_u, n_u, out):
    """Join the shadows' corners in pairs: the outermost of these lines in a row are the hull's border."""
    n_v = out.shape[0]
    for p in range(us.shape[0]):
        out[:, p, 0], out[:, p, 1] = n_u, -1
        if behind[p]:
            out[:, p, 0], out[:, p, 1] = -1, n_u
            continue
        for i in range(us.shape[1]):
            for j in range(us.shape[1]):
                u0, v0, u1, v1 = us[p, i], vs[p, i], us[p, j], vs[p, j]
                if v0 > v1 or i == j:
                    continue
                slope = (u1 - u0) / (v1 - v0) if v1 > v0 else 0.0
                for v in range(int(min(max(v0 - margin_v, 0.0), n_v)), int(min(max(v1 + margin_v + 1.0, 0.0), n_v))):
                    # the part of the line within the margin
                    low, high = min(max(v - margin_v, v0), v1), max(min(v + margin_v, v1), v0)
                    a, b = u0 + slope * (low - v0), u0 + slope * (high - v0)
                    if v1 == v0:
                        b = u1
                    left, right = min(max(min(a, b), -1e6), n_u + 1e6), min(max(max(a, b), -1e6), n_u + 1e6)
                    out[v, p, 0] = min(out[v, p, 0], max(int(np.floor(left)) - margin_u, -1))
                    out[v, p, 1] = max(out[v, p, 1], min(int(np.ceil(right)) + margin_u, n_u))
        for v in range(n_v):
            if out[v, p, 1] < 0 or out[v, p, 0] > n_u - 1:  # off the detector
                out[v, p, 0], out[v, p, 1] = n_u, -1
