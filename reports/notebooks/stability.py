# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Numerical stability
# How much is lost by computing in float32, and whether threads change a result. The stress suite (`run-benchmark
# stress`) tests this on hard cases; here a small scan shows how.
#
# The folders are `data` and `results`, or what the environment variables `CTSIM_DATA` and `CTSIM_RESULTS` name.

# %%
import os
from pathlib import Path

import numba
import numpy as np
import torch
from matplotlib.figure import Figure

from ctsim.beam.quadrature import energy_rule
from ctsim.beam.spectrum import Tube, spectrum
from ctsim.benchmarks.engine.record import latest
from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.studies.stress.study import Flags, Stress, by_case
from ctsim.dataset.store import list_scans, open_scan
from ctsim.detector.response import Detector
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.reconstruct.fdk import reconstruct
from ctsim.reconstruct.kernels import joseph_reference
from ctsim.reconstruct.projector import adjoint, forward
from ctsim.reports import show
from ctsim.reports.figures import COLOURS

DATA, RESULTS = (Path(os.environ.get(f"CTSIM_{name.upper()}", name)) for name in ("data", "results"))

# %% [markdown]
# ## Line integrals in float32 against float64
# The projector that reconstructions use is float32; its twin is written to be read and is float64. One rounding to
# float32 is 2⁻²⁴ = 6e-8 of a value. A ray that only grazes the volume has a small integral, and where it enters is
# itself rounded, so errors are given relative to the largest integral.

# %%
small = Geometry(
    dso=60.0,
    dsd=100.0,
    n_voxel=(11, 15, 15),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(13, 21),
    d_detector=(1.6, 1.6),
    n_views=9,
)
volume = np.random.default_rng(1).random(small.n_voxel, np.float32)
fast = forward(torch.from_numpy(volume), small).numpy()
exact = np.empty(small.shape)
grid = np.array([*small.d_voxel, *small.off_origin])
rows = np.tile(np.array([0, small.n_detector[0]]), (small.n_views, 1))
columns = np.ascontiguousarray(volume.transpose(1, 2, 0), np.float64)
joseph_reference.project(columns, small.pose_array(), grid, rows, exact)
error = np.abs(fast - exact) / exact.max()
show.table(
    ["rays", "float32 − float64, of the largest integral"],
    [["median", f"{np.median(error):.1e}"], ["worst", f"{error.max():.1e}"]],
)

# %% [markdown]
# ## Is the adjoint the adjoint?
# ⟨A x, y⟩ = ⟨x, Aᵀ y⟩ for random x and y, in float64 sums.

# %%
rays = np.random.default_rng(2).random(small.shape, np.float32)
back = adjoint(torch.from_numpy(rays), small).numpy()
one, other = (float(np.vdot(a.astype(np.float64), b)) for a, b in ((fast, rays), (volume, back)))
show.text(f"⟨A x, y⟩ = {one:.9g}, ⟨x, Aᵀ y⟩ = {other:.9g}, relative difference {abs(one - other) / abs(one):.1e}")

# %% [markdown]
# ## The sum over energies
# A pixel adds up a dozen exponentials in float32. Behind up to 100 mm of water and 10 mm of iron, the logarithm of the
# sum is compared with float64. Photon noise at 1e5 photons is 3e-3 in P on open detector, and more behind an
# object.

# %%
names, most = ("water", "Fe"), (100.0, 10.0)
rule = energy_rule(spectrum(Tube()), Detector(), names, most)
share = np.linspace(0, 1, 200)[:, None]
lengths, mu = share * most, np.stack([attenuation(name, rule.energies) for name in names])
p = -np.log(np.exp(-lengths @ mu) @ rule.w1)
narrow = -np.log(np.exp(-lengths.astype(np.float32) @ mu.astype(np.float32)) @ rule.w1.astype(np.float32))
drawing = Figure(figsize=(5.5, 3.0), layout="constrained")
axes = drawing.subplots()
axes.plot(p, np.abs(narrow - p), ".", ms=3, color=COLOURS[0])
axes.set(xlabel="P of water and iron together", ylabel="|float32 − float64| in P")
show.figure(drawing, "stability-energies")
show.text(f"Up to P = {p.max():.1f} the difference is at most {np.abs(narrow - p).max():.1e}.")

# %% [markdown]
# ## Threads
# FDK of the first scan with one thread and with all: the same bits, since every output is summed by one thread in one
# order.

# %%
scan = open_scan(list_scans(DATA)[0]).scan
before = numba.get_num_threads()
volumes = {}
for threads in sorted({1, before}):
    numba.set_num_threads(threads)
    volumes[threads] = reconstruct(scan).values.numpy()
numba.set_num_threads(before)
same = all(np.array_equal(volumes[1], v) for v in volumes.values())
show.text(f"Threads {', '.join(map(str, volumes))}: {'bitwise equal' if same else 'different'}.")

# %% [markdown]
# ## The stress suite
# What `run-benchmark stress` recorded, if it was run into this results folder: the last record of each row, blue where
# it ended as expected. Other rows are listed with their results.

# %%
rows = latest(Stress().store(Flags(results=RESULTS)).read())
if rows:
    wrong = [r for r in rows if not r.found[0].ok]
    named = "".join(f"- {r.task.case}, {r.task.subject}: {r.found[0].words}\n" for r in wrong)
    show.text(f"{len(rows) - len(wrong)} of {len(rows)} rows are as expected.\n\n{named}")
    show.text(by_case(rows).markdown())
    cases, subjects = (list(dict.fromkeys(getattr(r.task, name) for r in rows)) for name in ("case", "subject"))
    drawing = Figure(figsize=(2.5 + 0.3 * len(subjects), 1.8 + 0.22 * len(cases)), layout="constrained")
    axes = drawing.subplots()
    for ok, colour in ((True, COLOURS[0]), (False, COLOURS[5])):
        at = [(subjects.index(r.task.subject), cases.index(r.task.case)) for r in rows if r.found[0].ok == ok]
        axes.scatter([x for x, _ in at], [y for _, y in at], s=28, marker="s", color=colour)
    axes.set_xticks(range(len(subjects)), labels=[pictured(s) for s in subjects], rotation=90, fontsize=8)
    axes.set_yticks(range(len(cases)), labels=[pictured(c) for c in cases], fontsize=8)
    axes.invert_yaxis()
    show.figure(drawing, "stability-stress")
else:
    show.text(f"There are no stress records in `{RESULTS}`; `run-benchmark stress {RESULTS}` makes them.")
