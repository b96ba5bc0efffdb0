"""The label volume traversed brick by brick, for rays of any direction.

Uniform bricks are crossed in one step, mixed ones voxel by voxel (see `ctsim.tracer.bricks`). What runs once a ray
is inlined: a call would count references of its arrays atomically, which costs more than the ray.
"""

import math

import numpy as np
from numba import njit, prange

SIDE = 4  # voxels along a brick: one brick of labels is one cache line
MIXED = 255  # code of a brick that holds more than one label or density
CODE_BITS = np.uint16(255)
CELLS = SIDE**3
SHIFT = SIDE.bit_length() - 1
FIXED = 2.0**40  # ray parameter as an integer in 2⁻⁴⁰ mm inside a mixed brick
FARTHEST = 1e6  # mm; no ray is longer, and crossings of a parallel plane lie beyond
TINY = 1e-12  # a direction cosine below this counts as parallel to the axis


@njit(cache=True)
def reach(kind):
    """Edge, in bricks, of the largest cube of one label ahead of each brick: [octant, bz, by, bx].

    Octant bit 0, 1, 2 is set where the ray runs towards larger x, y, z. Beyond the grid nothing
    differs. A cube of edge r + 1 fits where the seven neighbours ahead hold cubes of edge r.
    """
    mz, my, mx = kind.shape
    code = np.empty((8, mz, my, mx), np.uint16)
    for octant in range(8):
        sx, sy, sz = 2 * (octant & 1) - 1, (octant & 2) - 1, (octant & 4) // 2 - 1
        for i in range(mz):
            z = mz - 1 - i if sz > 0 else i
            for j in range(my):
                y = my - 1 - j if sy > 0 else j
                for k in range(mx):
                    x = mx - 1 - k if sx > 0 else k
                    cube = 255
                    for n in range(1, 8):
                        zn, yn, xn = z + sz * (n >> 2), y + sy * ((n >> 1) & 1), x + sx * (n & 1)
                        if 0 <= zn < mz and 0 <= yn < my and 0 <= xn < mx:
                            same = kind[zn, yn, xn] == kind[z, y, x]
                            cube = min(cube, 1 + (code[octant, zn, yn, xn] >> 8) if same else 1)
                    code[octant, z, y, x] = kind[z, y, x] | (cube << 8)
    return code


@njit(cache=True, error_model="numpy")
def walk(code, slot, pool, density, grid, ray, t_from, t_to, pieces):
    """List what a ray crosses between t_from and t_to (mm along it) as pieces (end, label, density); return how many.

    The first piece is air and ends where the volume begins. `pieces` has room for nx + ny + nz + 8 of them.
    """
    # positions in voxels; the ray parameter stays in mm
    ox, oy, oz = (ray[0] - grid[6]) * grid[3], (ray[1] - grid[7]) * grid[4], (ray[2] - grid[8]) * grid[5]
    dx, dy, dz = ray[3] * grid[3], ray[4] * grid[4], ray[5] * grid[5]
    dx = TINY if abs(dx) < TINY else dx
    dy = TINY if abs(dy) < TINY else dy
    dz = TINY if abs(dz) < TINY else dz
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    ux, uy, uz = 1 if dx > 0 else 0, 1 if dy > 0 else 0, 1 if dz > 0 else 0
    x0, x1, y0, y1, z0, z1 = -ox * ix, (grid[0] - ox) * ix, -oy * iy, (grid[1] - oy) * iy, -oz * iz, (grid[2] - oz) * iz
    t = max(max(t_from, x0 if ux else x1), max(y0 if uy else y1, z0 if uz else z1))
    end = min(min(t_to, x1 if ux else x0), min(y1 if uy else y0, z1 if uz else z0))
    if not t < end:
        return 0
    dense = density.size > 0
    n, last = 0, 0
    pieces[0, 0], pieces[0, 1], pieces[0, 2] = t, 0.0, 1.0
    octant = ux + 2 * uy + 4 * uz
    _, mz, my, mx = code.shape
    sx, sy, sz = 2 * ux - 1, 2 * uy - 1, 2 * uz - 1
    step_x = np.int64(min(abs(ix), FARTHEST) * FIXED)
    step_y = np.int64(min(abs(iy), FARTHEST) * FIXED)
    step_z = np.int64(min(abs(iz), FARTHEST) * FIXED)
    scale = 1.0 / SIDE
    bx = min(max(int((ox + dx * t) * scale), 0), mx - 1)
    by = min(max(int((oy + dy * t) * scale), 0), my - 1)
    bz = min(max(int((oz + dz * t) * scale), 0), mz - 1)
    while True:
        entry = code[octant, bz, by, bx]
        label = entry & CODE_BITS
        if label != MIXED:
            # the same label fills the cube of `reach` bricks ahead; `more` is its far end from here
            more = int(entry >> np.uint16(8)) - 1
            tx = ((bx + ux + sx * more) * SIDE - ox) * ix
            ty = ((by + uy + sy * more) * SIDE - oy) * iy
            tz = ((bz + uz + sz * more) * SIDE - oz) * iz
            leave = min(tx, min(ty, tz))
            if leave > t:
                n += int(label != last or dense)
                last = label
                pieces[n, 0], pieces[n, 1], pieces[n, 2] = min(leave, end), label, 1.0
                if leave >= end:
                    return n + 1
                t = leave
            if more == 0:
                bx += sx if tx == leave else 0
                by += sy if ty == leave else 0
                bz += sz if tz == leave else 0
            else:
                ex, ey, ez = bx + sx * more, by + sy * more, bz + sz * more
                px, py, pz = int((ox + dx * t) * scale), int((oy + dy * t) * scale), int((oz + dz * t) * scale)
                bx = ex + sx if tx == leave else min(max(px, min(bx, ex)), max(bx, ex))
                by = ey + sy if ty == leave else min(max(py, min(by, ey)), max(by, ey))
                bz = ez + sz if tz == leave else min(max(pz, min(bz, ez)), max(bz, ez))
        else:
            base = np.int64(slot[bz, by, bx]) * CELLS
            x = min(max(int(ox + dx * t) - bx * SIDE, 0), SIDE - 1)
            y = min(max(int(oy + dy * t) - by * SIDE, 0), SIDE - 1)
            z = min(max(int(oz + dz * t) - bz * SIDE, 0), SIDE - 1)
            # fixed point: the chain of one step is half as long in integers as in floating point
            cx = np.int64(min((bx * SIDE + x + ux - ox) * ix, FARTHEST) * FIXED)
            cy = np.int64(min((by * SIDE + y + uy - oy) * iy, FARTHEST) * FIXED)
            cz = np.int64(min((bz * SIDE + z + uz - oz) * iz, FARTHEST) * FIXED)
            at, stop = np.int64(t * FIXED), np.int64(end * FIXED)
            cell = base + (z * SIDE + y) * SIDE + x
            while True:
                leave = min(cx, min(cy, cz))
                at = max(at, leave)
                label = pool[cell]
                n += int(label != last or dense)
                last = label
                pieces[n, 0], pieces[n, 1] = min(at, stop) * (1.0 / FIXED), label
                pieces[n, 2] = density[cell] if dense else 1.0
                # no branch distinguishes the axes: a wrong guess costs more than the additions
                gx, gy, gz = -np.int64(cx == leave), -np.int64(cy == leave), -np.int64(cz == leave)
                x += sx & gx
                y += sy & gy
                z += sz & gz
                cx += step_x & gx
                cy += step_y & gy
                cz += step_z & gz
                if (x | y | z) & ~(SIDE - 1):
                    break
                cell += (sx & gx) + (sy * SIDE & gy) + (sz * SIDE * SIDE & gz)
            t = at * (1.0 / FIXED)
            if at >= stop:
                return n + 1
            bx += x >> SHIFT
            by += y >> SHIFT
            bz += z >> SHIFT
        if bx < 0 or by < 0 or bz < 0 or bx >= mx or by >= my or bz >= mz:
            return n + 1


@njit(inline="always", error_model="numpy")
def add_pieces(pieces, n, t_from, t_to, lengths):
    """Add to `lengths` [material] what n pieces of `walk` hold between t_from and t_to."""
    t = t_from
    for k in range(n):
        end = min(pieces[k, 0], t_to)
        if end > t:
            lengths[int(pieces[k, 1])] += (end - t) * pieces[k, 2]
            t = end


@njit(inline="always", error_model="numpy")
def towards(pose, u, v):
    """Return the unit direction from the source to detector position (u, v), and the distance (mm)."""
    dx = pose[3] + u * pose[6] + v * pose[9] - pose[0]
    dy = pose[4] + u * pose[7] + v * pose[10] - pose[1]
    dz = pose[5] + u * pose[8] + v * pose[11] - pose[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length, length


@njit(inline="always", error_model="numpy")
def aim(pose, u, v, ray):
    """Fill `ray` with the source, the unit direction to detector position (u, v), and the distance."""
    ray[0], ray[1], ray[2] = pose[0], pose[1], pose[2]
    ray[3], ray[4], ray[5], ray[6] = towards(pose, u, v)


@njit(cache=True, error_model="numpy")
def _fill_row(volume, pose, v, span, lengths):
    code, slot, pool, density, grid = volume
    n_m, n_v, n_u = lengths.shape
    ray, row = np.empty(7), np.empty(n_m)
    pieces = np.empty((int(grid[:3].sum()) + 8, 3))
    lengths[1:, v] = 0
    for u in range(span[0], span[1]):
        aim(pose, u - (n_u - 1) / 2, v - (n_v - 1) / 2, ray)
        row[:] = 0.0
        add_pieces(pieces, walk(code, slot, pool, density, grid, ray, 0.0, ray[6], pieces), 0.0, ray[6], row)
        for m in range(1, n_m):
            lengths[m, v, u] = row[m]


@njit(parallel=True, cache=True, error_model="numpy")
def fill_view(volume, pose, order, spans, lengths):
    """Fill `lengths` [material, v, u] (mm, float32) of one view with what the central rays cross in the volume.

    `volume` is (code, slot, pool, density, grid) of `ctsim.tracer.bricks.Bricks`; `pose` [12]; `order` [row] is the
    order of work; outside columns spans[row] = (from, to) the lengths are 0. Material 0 is left alone.
    """
    for index in prange(order.size):
        _fill_row(volume, pose, order[index], spans[order[index]], lengths)
