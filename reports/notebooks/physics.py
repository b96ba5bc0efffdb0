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
# # The physics of one scene
# The spectrum of a scan, beam hardening, the noise of the counts, and the effect of metal on line integrals and on a
# reconstruction. The scene is rebuilt from its `scene.toml`; nothing here is read from a table.
#
# The folder is `data`, or what the environment variable `CTSIM_DATA` names; the first scan in it is shown.

# %%
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ctsim.beam.quadrature import effective_weights, full_rule
from ctsim.benchmarks.scalebar import scale_bar
from ctsim.dataset.store import list_scans, open_scan
from ctsim.detector.noise import detect
from ctsim.materials import attenuation
from ctsim.phantoms.scene import build, load_suite, stream_id
from ctsim.plan import make_plan
from ctsim.reconstruct.fdk import reconstruct
from ctsim.reconstruct.log import line_integrals
from ctsim.reports import show
from ctsim.reports.figures import COLOURS
from ctsim.rng import stream_key
from ctsim.simulate import compact
from ctsim.tracer.project import Response, Tracer, path_lengths, transmit

DATA = Path(os.environ.get("CTSIM_DATA", "data"))
stored = open_scan(list_scans(DATA)[0])
(scene,) = load_suite(stored.folder / "scene.toml")
scanner, phantom = scene.resolve(), build(scene)
plan = make_plan(phantom, scanner, scene.simulation, scene.truth, stream_id(scene))
show.text(f"**{stored.name}**\n\n```\n{plan.text()}\n```")

# %% [markdown]
# ## Spectrum
# The tube's spectrum, the spectrum that the detector measures, and the latter behind the scene's median water path.
# The stems are the few energies of the simulation's quadrature.

# %%
fine = full_rule(plan.spectrum, scanner.detector)
behind = effective_weights(plan.spectrum, scanner.detector, plan.l0)[1]
drawing = Figure(figsize=(6.5, 4.0), layout="constrained")
axes = drawing.subplots()
curves = (
    ("photons that leave the tube", plan.spectrum.energies, plan.spectrum.weights),
    ("signal of the open field", fine.energies, fine.w1),
    (f"signal behind {plan.l0:.1f} mm of water", fine.energies, behind),
)
for colour, (name, energies, weights) in zip(COLOURS, curves, strict=False):
    width = np.gradient(energies) if energies.size > 1 else np.ones(1)
    axes.plot(energies, weights / width, color=colour, label=f"{name}, mean {energies @ weights:.1f} keV")
twin = axes.twinx()
twin.vlines(plan.rule.energies, 0, plan.rule.w1, color=COLOURS[3], lw=1)
twin.set_ylabel("weight of an energy of the rule", color=COLOURS[3])
axes.set(xlabel="energy (keV)", ylabel="share per keV")
drawing.legend(loc="outside upper left", frameon=False, fontsize=8)
show.figure(drawing, "physics-spectrum")

# %% [markdown]
# ## Hardening
# P = −ln(I/I0) of a growing thickness bends away from the straight line of its first millimetres: soft photons are
# absorbed first. The rest is harder, so one more millimetre attenuates less.

# %%
metals = [m for m in stored.info.metal if m in plan.materials]
drawing = Figure(figsize=(8.5, 3.2), layout="constrained")
panels = drawing.subplots(1, 2)
rows = []
for axes, name, most in zip(panels, ("water", *metals[:1]), (2 * plan.l0, 10.0), strict=False):
    mu = attenuation(name, fine.energies)
    length = np.linspace(0, most, 200)
    left = np.exp(-length[:, None] * mu) * fine.w1
    p = -np.log(left.sum(1))
    axes.plot(length, p, color=COLOURS[0], label="P")
    axes.plot(length, length * float(fine.w1 @ mu), "--", color=COLOURS[1], label="first slope")
    axes.set(xlabel=f"{name} (mm)", ylabel="P", ylim=(0, 1.6 * float(p[-1])))
    axes.legend(frameon=False, fontsize=8)
    for k in (0, 50, 199):
        mean = float(left[k] @ fine.energies / left[k].sum())
        slope = float(left[k] @ mu / left[k].sum())
        rows.append([name, f"{length[k]:.1f}", f"{p[k]:.3f}", f"{mean:.1f}", f"{slope:.4f}"])
for axes in panels[1 + len(metals[:1]) :]:
    axes.axis("off")
show.figure(drawing, "physics-hardening")
show.table(["material", "mm", "P", "mean energy left (keV)", "μ of one mm more (1/mm)"], rows)

# %% [markdown]
# ## Line integrals
# The view with the most metal of a dozen: without noise, from the counts, and the part that the metal adds. Where
# hardly a photon comes through, the logarithm of the counts is mostly noise.

# %%
tracer = Tracer.of(compact(phantom, plan.materials))
response = Response.of(plan.rule, tracer.materials)
n_views = scanner.geometry.n_views
is_metal = [m in metals for m in tracer.materials]
shadow = [path_lengths(tracer, scanner.geometry, k)[is_metal].sum() for k in range(0, n_views, max(1, n_views // 12))]
view = int(np.argmax(shadow)) * max(1, n_views // 12)
m1, m2 = transmit(tracer, scanner.geometry, view, response)
bare = transmit(tracer.without_metal(), scanner.geometry, view, response)[0]
p, p_bare = -np.log(m1), -np.log(bare)
counted = line_integrals(stored.scan, view)[0].numpy()
drawing = Figure(figsize=(9.5, 3.0), layout="constrained")
top = float(p.max())
shown = (("noise-free P", p, top), ("P of the counts", counted, top), ("what the metal adds", p - p_bare, None))
for axes, (title, image, high) in zip(drawing.subplots(1, 3), shown, strict=True):
    drawing.colorbar(axes.imshow(image, cmap="gray", origin="lower", vmin=0, vmax=high), ax=axes, fraction=0.046)
    axes.set(title=f"{title}, view {view}", xticks=[], yticks=[])
    scale_bar(axes, image.shape, scanner.geometry.d_detector[1], where="at the detector")
show.figure(drawing, "physics-line-integrals")

# %% [markdown]
# ## Noise
# The view is drawn 100 times with fresh streams. The relative signal's variance should be Σ w2·exp(−τ)/i0, plus the
# electronics', plus a twelfth of a squared count for rounding. 100 draws give a standard deviation to
# 1/√(2·99) = 7 %, so single pixels scatter by that much around the line.

# %%
noise, i0 = scanner.noise, scanner.i0
draws = []
for k in range(100):
    key = stream_key(plan.stream_id, "notebook", k)
    counts = detect(m1, m2, noise=noise, i0=i0, key=key).astype(np.float64)
    draws.append((counts - noise.dark) / noise.gain(i0))
measured = np.std(draws, axis=0, ddof=1)
rounding = 1 / (12 * noise.gain(i0) ** 2) if noise.has_adc else 0.0
electronic = (noise.electronic / i0) ** 2 if noise.model == "compound" else 0.0
predicted = np.sqrt(m2 / i0 * (noise.model == "compound") + electronic + rounding)
drawing = Figure(figsize=(5.0, 3.6), layout="constrained")
axes = drawing.subplots()
axes.plot(p.ravel(), (predicted / m1).ravel(), ".", ms=3, color=COLOURS[1], label="predicted")
axes.plot(p.ravel(), (measured / m1).ravel(), ".", ms=2, alpha=0.4, color=COLOURS[0], label="100 draws")
axes.set(xlabel="P", ylabel="standard deviation over signal", yscale="log")
axes.legend(frameon=False)
show.figure(drawing, "physics-noise")
show.text(f"Measured over predicted standard deviation, median of all pixels: {np.median(measured / predicted):.4f}")

# %% [markdown]
# ## What the metal does
# FDK of the scan and of its metal-free twin, and their difference: both have the same noise streams, so the
# difference comes from the metal alone.

# %%
if stored.metal_free is None:
    show.text("This scene has no metal, or was made without its twin.")
else:
    with_metal, without = (s.scan for s in (stored, stored.metal_free))
    one, other = (reconstruct(scan, window="hann").values.numpy() for scan in (with_metal, without))
    z = int(np.argmax(np.asarray(stored.metal).sum((1, 2))))
    top = 2.5 * float(np.median(stored.reference("effective")[np.asarray(stored.labels) > 0]))
    drawing = Figure(figsize=(9.5, 3.2), layout="constrained")
    slices = (("with metal", one[z], 0, "gray"), ("without", other[z], 0, "gray"))
    slices += (("difference", (one - other)[z], -top / 2.5, "RdBu_r"),)
    for axes, (title, image, low, colours) in zip(drawing.subplots(1, 3), slices, strict=True):
        high = top if low == 0 else -low
        drawing.colorbar(axes.imshow(image, cmap=colours, origin="lower", vmin=low, vmax=high), ax=axes, fraction=0.046)
        axes.set(title=f"{title}, z = {z}", xticks=[], yticks=[])
        scale_bar(axes, image.shape, stored.geometry.d_voxel[2])
    show.figure(drawing, "physics-metal")
