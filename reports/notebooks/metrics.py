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
# # One volume, many scores
# PSNR and SSIM depend on a convention as well as on the volume. Here one kept volume is scored under the protocol
# `tissue`, then with one convention changed at a time. The same table comes from `run-benchmark inspect`.
# Conventions with the reference of 50 keV score a method's own volume at 50 keV, if it has one, here and below.
#
# The folders are `data` and `results`, or what the environment variables `CTSIM_DATA` and `CTSIM_RESULTS` name.

# %%
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ctsim.benchmarks.studies.inspect import study as inspector
from ctsim.reports import kept, show
from ctsim.reports.figures import COLOURS, INK

DATA, RESULTS = (Path(os.environ.get(f"CTSIM_{name.upper()}", name)) for name in ("data", "results"))
case = kept.open_case(DATA, RESULTS)

kept_volumes = [
    inspector.Inspected(label=k.record.label, values=np.asarray(k.values), at_50kev=k.at_50kev) for k in case.kept
]
first = kept_volumes[0]

# %%
show.text(inspector.markdown(first, case.stored))

# %% [markdown]
# ## How far each convention moves the scores
# A bar is the change against `tissue`. A larger range adds 20·log10 of its ratio to PSNR and changes nothing in the
# volume.

# %%
base = inspector.score(first, case.truth, inspector.BASE)
named = [(what, how) for what, group in (*inspector.SINGLE.items(), ("all of it", inspector.WHOLE)) for how in group]
moved = [(what, how, inspector.score(first, case.truth, how)) for what, how in named]
kinds = list(dict.fromkeys(what for what, _ in named))

drawing = Figure(figsize=(9.5, 0.27 * len(moved) + 1.2), layout="constrained")
left, right = drawing.subplots(1, 2, sharey=True)
for axes, name, title in ((left, "psnr", "PSNR3D (dB)"), (right, "ssim", "SSIM3D")):
    start = getattr(base, name)
    for line, (what, _, found) in enumerate(moved):
        value = getattr(found, name)
        if value is not None and start is not None:
            axes.barh(line, value - start, color=COLOURS[kinds.index(what) % len(COLOURS)])
    axes.axvline(0, color=INK, lw=0.8)
    axes.set_xlabel(f"change in {title}" + ("" if start is None else f"; tissue: {start:.3g}"))
left.set_yticks(range(len(moved)), labels=[how.title for _, how, _ in moved], fontsize=8)
left.invert_yaxis()
show.figure(drawing, "metrics-conventions")

# %% [markdown]
# ## Does a convention change who wins?
# The order of the methods by PSNR under each convention, best first. Where it differs, the ranking depends on the
# convention.

# %%
rows = []
for how in (inspector.BASE, *(how for _, how in named)):
    found = {volume.label: inspector.score(volume, case.truth, how).psnr for volume in kept_volumes}
    known = {label: psnr for label, psnr in found.items() if psnr is not None}
    rows.append([how.title, " > ".join(sorted(known, key=lambda label: -known[label])) or "–"])
show.table(["convention", "order by PSNR3D"], rows)
