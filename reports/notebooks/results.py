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
# # What a results folder says
# Tables and figures from the records, and each scene's slices. Nothing is reconstructed here.
#
# The folders are `data` and `results`, or what the environment variables `CTSIM_DATA` and `CTSIM_RESULTS` name.

# %%
import os
from pathlib import Path

from ctsim.benchmarks.studies.methods.records import read
from ctsim.benchmarks.studies.methods.tables import render
from ctsim.errors import InputError
from ctsim.reports import figures, kept, show

DATA, RESULTS = (Path(os.environ.get(f"CTSIM_{name.upper()}", name)) for name in ("data", "results"))
records = read(RESULTS)
if not records:
    raise InputError(f"{RESULTS}: there are no records; run `run-benchmark {DATA} {RESULTS}` first")

# %% [markdown]
# ## Scores
# `tissue` is the primary protocol. The gains are over no correction (FDK) and over NMAR; an anchored score is 0 for
# FDK without the metal and 1 for FDK with it, uncorrected.

# %%
show.text(render(records, "md", ("tissue", "against", "anchored", "cost")))

# %% [markdown]
# ## Figures

# %%
for number, (_, drawing) in enumerate(figures.drawn(records)):
    show.figure(drawing, f"results-{number}")

# %% [markdown]
# ## Slices
# One slice, window and level for all methods, and their signed errors; first the slice through the most metal. In
# Jupyter there are sliders around it.

# %%
for case in kept.first_cases(DATA, records, RESULTS):
    if isinstance(case, kept.Case):  # the viewer shows errors too, and a measured scan has no truth
        show.slices(case, f"results-{case.stored.name}")
