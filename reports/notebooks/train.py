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
# # Train a network on simulated slices
# One table of a scene file becomes 280 fan-beam scans with metal and their twins without it. A small U-Net learns from
# 192 of them to remove artefacts (10 more have no voxel of metal in their mask). It is then compared with LIMAR on
# individuals that it has never seen.
#
# Two controls tell how much of its gain has to do with metal. Any network that is trained on the true attenuation also
# takes away noise, blur and the wrong level that beam hardening leaves. LIMAR does not attempt that.
#
# It needs `ctsim[io]` and two CPU cores. Data and shards go into the folder that `CTSIM_TRAINING` names, else
# `training`; scans that are there are kept. `CTSIM_TRAINING_SIZE=tiny` runs everything in seconds, with useless scores.

# %%
import os
import time
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

import ctsim
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.benchmarks.shards.work import main as make_shards
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.errors import InputError
from ctsim.reports import show
from ctsim.reports.figures import COLOURS
from ctsim.torch import Scans

FOLDER = Path(os.environ.get("CTSIM_TRAINING", "training"))
DATA, SHARDS = FOLDER / "data", FOLDER / "shards"


# scans, scans of an individual, voxels, pixels and views of a slice; passes, slices a step, channels of the network
SIZES = {"full": (280, 2, 128, 192, 180, 20, 8, 24), "tiny": (12, 1, 64, 96, 24, 8, 2, 8)}
SCANS, EACH, VOXELS, PIXELS, VIEWS, PASSES, BATCH, CHANNELS = SIZES[os.environ.get("CTSIM_TRAINING_SIZE", "full")]
SEED, RATE = 0, 3e-3

# %% [markdown]
# ## Data
# Both scans of an individual are of the same body. Metal, tube and dose differ, and `split` takes whole individuals:
# nobody's body is in two splits.

# %%
TABLE = f"""
[defaults.scanner]
preset = "ideal"
n_views = {VIEWS}
n_detector = [1, {PIXELS}]
n_voxel = [1, {VOXELS}, {VOXELS}]

[[scene]]
name = "body"
count = {SCANS}
scans_each = {EACH}
split = {{ train = 0.72, val = 0.08, test = 0.2 }}
phantom = {{ recipe = "random", n_voxel = {[3 * VOXELS // 4] * 3} }}

[scene.vary]
phantom.metal = ["Fe", "Ti", "Au"]
phantom.insert_mm = {{ uniform = [2.0, 8.0] }}
scanner.tube.kvp = {{ uniform = [80, 140] }}
scanner.i0 = {{ log = [2e4, 5e5] }}
"""

FOLDER.mkdir(parents=True, exist_ok=True)
(FOLDER / "body.toml").write_text(TABLE, encoding="utf-8")
for command, words in ((make_dataset, [FOLDER / "body.toml", DATA]), (make_shards, [DATA, SHARDS])):
    if command([str(word) for word in words]) != 0:
        raise InputError(f"{FOLDER}: the data could not be made; see the message above")

# %% [markdown]
# ## Read
# `Scans` reads FDK of the scan, FDK of its twin, the true attenuation and the metal's mask. LIMAR is not in the shards.
# It is reconstructed here from the counts and the true mask, as `run-benchmark` does. So is the region that is judged.
#
# Metal can be so thin that it fills no voxel by half. Then the mask is empty, LIMAR has nothing to correct, and the
# slice is left out. These few slices fit into memory. For more, keep the `DataLoader` and give it workers.

# %%
Slices = dict[str, Tensor]  # item -> [slice, y, x]
ITEMS = ("fdk", "twin", "reference", "metal")


def read(split: str) -> tuple[Slices, list[str], list[str]]:
    """Return the slices of a split, the names of their scans, and whose bodies they are."""
    samples = Scans(SHARDS, ITEMS, plane="z", split=split)
    batches = list(DataLoader(samples, batch_size=64))
    found = {item: torch.cat([batch[item] for batch in batches]) for item in ITEMS}
    kept = torch.nonzero(found["metal"].any(2).any(1)).ravel()
    names, individuals, _ = zip(*(samples.where(k) for k in kept.tolist()), strict=True)
    scans = [open_scan(DATA / name) for name in names]
    slices = {item: images[kept] for item, images in found.items()}
    slices["limar"] = torch.stack([ctsim.reconstruct_scan(scan, "limar").values[0] for scan in scans])
    slices["judged"] = torch.from_numpy(np.stack([truth_of(scan).tissue[0] for scan in scans]))
    return slices, list(names), list(individuals)


splits = {split: read(split) for split in ("train", "val", "test")}
train, val, test = (slices for slices, _, _ in splits.values())
show.table(
    ["split", "slices", "individuals"],
    [[split, str(len(names)), str(len({*bodies}))] for split, (_, names, bodies) in splits.items()],
)

# %% [markdown]
# ## Network
# A U-Net with four resolutions. It works on 2 × 2 pixels as four channels, which halves its time. It adds what it
# finds to its first input. Its last layer starts at 0, so an untrained network returns that input.

# %%
WATER = 0.025  # 1/mm, about that of water; inputs are divided by it
LOWEST, HIGHEST = -4.0, 12.0  # times water; beyond lie metal and the worst streaks only


def convolutions(n_in: int, n_out: int) -> nn.Sequential:
    """Return two 3 × 3 convolutions, each normalised and rectified."""
    layers = []
    for n in (n_in, n_out):
        layers += [nn.Conv2d(n, n_out, 3, padding=1, bias=False), nn.GroupNorm(n_out // 8, n_out), nn.ReLU()]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Images [slice, input, y, x] in 1/mm to images [slice, y, x]; y and x are multiples of 16."""

    def __init__(self, n_inputs: int, channels: int) -> None:
        super().__init__()
        widths = [channels * 2**level for level in range(4)]
        self.down = nn.ModuleList(convolutions(a, b) for a, b in zip([4 * n_inputs, *widths], widths, strict=False))
        self.up = nn.ModuleList(nn.ConvTranspose2d(2 * a, a, 2, stride=2) for a in widths[:-1])
        self.merge = nn.ModuleList(convolutions(2 * a, a) for a in widths[:-1])
        self.last = nn.Conv2d(channels, 4, 1)
        for weights in self.last.parameters():
            nn.init.zeros_(weights)

    def forward(self, images: Tensor) -> Tensor:
        """Return the first input, clamped, plus what the network finds."""
        scaled = (images / WATER).clamp(LOWEST, HIGHEST)
        x, kept = functional.pixel_unshuffle(scaled, 2), []
        for level, layer in enumerate(self.down):
            x = layer(functional.max_pool2d(x, 2) if level else x)
            kept.append(x)
        for level in (2, 1, 0):
            x = self.merge[level](torch.cat((kept[level], self.up[level](x)), 1))
        return WATER * (scaled[:, 0] + functional.pixel_shuffle(self.last(x), 2)[:, 0])


# %% [markdown]
# ## Training
# Three networks of the same kind. What differs is what they get, and on what they are trained:
#
# - **U-Net on LIMAR** gets the LIMAR image, the FDK image and the true metal mask. It corrects the LIMAR image.
# - **U-Net without LIMAR** gets the FDK image and the mask: what LIMAR is told, but as an image instead of counts.
# - **Denoiser** gets one image and sees no metal in training: it learns from FDK of the twins. It is then applied to
#   the LIMAR image.
#
# A fifth of the samples of the first two are twins with an empty mask, so that they also know a body without metal.
# Slices are turned and mirrored at random. The loss is the RMSE where the score's protocol counts: inside the body
# dilated by 4 voxels, outside the metal dilated by 2. Metal that fills less than half of a voxel is in no mask, but
# counts as metal there: else it would rule the loss. The number of passes is fixed; validation chooses nothing here.

# %%
INPUTS = {  # the one that is corrected comes first
    "U-Net on LIMAR": ("limar", "fdk", "metal"),
    "U-Net without LIMAR": ("fdk", "metal"),
    "denoiser": ("fdk",),
}
TWINS = {"U-Net on LIMAR": 0.2, "U-Net without LIMAR": 0.2, "denoiser": 1.0}  # share of the samples


def without_metal(slices: Slices, chosen: Tensor) -> Slices:
    """Return the slices with the twin in place of those that are `chosen` [slice]; LIMAR of a twin is its FDK."""
    pick = chosen[:, None, None]
    images = {item: torch.where(pick, slices["twin"], slices[item]) for item in ("fdk", "limar")}
    return slices | images | {"metal": torch.where(pick, 0, slices["metal"])}


def losses(net: UNet, inputs: tuple[str, ...], slices: Slices, twins: Tensor) -> Tensor:
    """Return the RMSE of every slice in multiples of water; `twins` [slice] are replaced by their twins."""
    seen = without_metal(slices, twins)
    error = (net(torch.stack([seen[item] for item in inputs], 1)) - slices["reference"]) / WATER
    return ((error**2 * slices["judged"]).sum((1, 2)) / slices["judged"].sum((1, 2)) + 1e-6).sqrt()


def turned(slices: Slices, draws: torch.Generator) -> Slices:
    """Return the slices turned by a random multiple of 90°, and mirrored or not."""
    turns, mirror = (int(torch.randint(n, (), generator=draws)) for n in (4, 2))
    images = {item: torch.rot90(image, turns, (1, 2)) for item, image in slices.items()}
    return {item: image.flip(2) if mirror else image for item, image in images.items()}


def fit(name: str) -> tuple[UNet, list[float], list[float]]:
    """Return a trained network, and its mean loss in every pass on training and validation."""
    torch.manual_seed(SEED)
    draws = torch.Generator().manual_seed(SEED)
    net, n = UNet(len(INPUTS[name]), CHANNELS), len(train["fdk"])
    starts = range(0, n - n % BATCH, BATCH)
    optimiser = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-4)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=PASSES * len(starts))
    trained, validated = [], []
    for _ in range(PASSES):
        order, found = torch.randperm(n, generator=draws), []
        for start in starts:
            chosen = order[start : start + BATCH]
            batch = turned({item: images[chosen] for item, images in train.items()}, draws)
            loss = losses(net, INPUTS[name], batch, torch.rand(len(chosen), generator=draws) < TWINS[name]).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rate.step()
            found.append(loss.item())
        trained.append(float(np.mean(found)))
        with torch.no_grad():
            all_twins = torch.full((len(val["fdk"]),), TWINS[name] == 1)
            validated.append(float(losses(net, INPUTS[name], val, all_twins).mean()))
    return net, trained, validated


# %%
nets: dict[str, UNet] = {}
rows = []
drawing = Figure(figsize=(6.0, 3.4), layout="constrained")
axes = drawing.subplots()
for colour, name in zip(COLOURS, INPUTS, strict=False):
    wall, busy = time.perf_counter(), time.process_time()
    nets[name], trained, validated = fit(name)
    spent = [f"{time.perf_counter() - wall:.0f}", f"{time.process_time() - busy:.0f}"]
    axes.plot(trained, color=colour, label=f"{name}, training")
    axes.plot(validated, "--", color=colour, label=f"{name}, validation")
    n_weights = sum(weights.numel() for weights in nets[name].parameters())
    rows.append([name, f"{n_weights}", f"{trained[0]:.4f}", f"{trained[-1]:.4f}", f"{validated[-1]:.4f}", *spent])
axes.set(xlabel="pass over the training slices", ylabel="RMSE over water", yscale="log")
axes.legend(frameon=False, fontsize=7)
show.figure(drawing, "train-loss")
show.table(["network", "weights", "first loss", "last loss", "validation", "seconds", "CPU seconds"], rows)

# %% [markdown]
# ## Scores
# All methods are scored by `ctsim.score_volume`, as in `run-benchmark`, on the slices of the split `test`:
#
# - **PSNR** and **RMSE** against the true attenuation, protocol `tissue`. They count artefacts, noise, blur and level.
# - **Artefact** is the RMS of the scan's image minus the twin's image by the same method, protocol `artefact`. Noise,
#   blur and level that the method has on both cancel.
# - **Twin** is the method's PSNR on the twin. What lies between it and the PSNR is what metal costs the method. For
#   LIMAR it is that of FDK without metal: the bound for a method that only takes artefacts away.
#
# Means over slices ± standard deviation over slices.


# %%
def run(name: str, slices: Slices) -> Tensor:
    """Return a network's images."""
    with torch.no_grad():
        return nets[name].eval()(torch.stack([slices[item] for item in INPUTS[name]], 1))


bare = without_metal(test, torch.ones(len(test["fdk"]), dtype=torch.bool))
pairs = {"FDK": (test["fdk"], test["twin"]), "LIMAR": (test["limar"], test["twin"])}
pairs["denoiser on LIMAR"] = run("denoiser", {"fdk": test["limar"]}), run("denoiser", bare)
pairs |= {name: (run(name, test), run(name, bare)) for name in ("U-Net without LIMAR", "U-Net on LIMAR")}


def numbers(scan: StoredScan, image: Tensor, twin: Tensor) -> list[float]:
    """Score a method's slices of a scan and of its twin: PSNR, RMSE, artefact, PSNR of the twin."""
    volume, bare = image.numpy()[None], twin.numpy()[None]
    found = ctsim.score_volume(volume, scan, twin=bare, protocols=("tissue", "artefact"))
    alone = ctsim.score_volume(bare, scan, variant="metal_free", protocols="tissue")
    tissue, artefact = found["tissue"].values, found["artefact"].values
    values = tissue["psnr3d"], tissue["rmse"], artefact["rmse"], alone["tissue"].values["psnr3d"]
    if None in values:
        raise InputError(f"{scan.name}: a score is missing; expected a scan with metal and a twin")
    known = [value for value in values if value is not None]
    known[1] *= 1000 / water_of(scan)
    return known


def water_of(scan: StoredScan) -> float:
    """Return the attenuation of water for a scan's spectrum, 1/mm."""
    return effective_attenuation(scan, "water") or WATER


scores: dict[str, list[list[float]]] = {name: [] for name in pairs}
metals = []
for k, scan_name in enumerate(splits["test"][1]):
    stored = open_scan(DATA / scan_name)
    metals.append(stored.info.metal[0])
    for name, (images, twins) in pairs.items():
        scores[name].append(numbers(stored, images[k], twins[k]))


def spread(values: NDArray[np.float64], digits: int) -> str:
    """Write mean ± standard deviation."""
    return f"{values.mean():.{digits}f} ± {values.std(ddof=1):.{digits}f}"


gets = dict(zip(pairs, ("counts", "counts, mask", "LIMAR", "FDK, mask", "LIMAR, FDK, mask"), strict=True))
table = {name: np.array(found) for name, found in scores.items()}
show.table(
    ["method", "gets", "PSNR (dB)", "RMSE (HU)", "artefact (HU)", "twin (dB)"],
    [[name, gets[name], *(spread(t[:, c], d) for c, d in enumerate((2, 0, 0, 2)))] for name, t in table.items()],
)

# %% [markdown]
# Differences of a slice's PSNR, mean ± standard error over individuals, and the share of slices that are better.
# An individual's two slices are averaged first, since they are of the same body.

# %%
bodies = np.array(splits["test"][2])
COMPARED = [(name, "LIMAR") for name in list(pairs)[2:]] + [("U-Net on LIMAR", "denoiser on LIMAR")]
rows = []
for one, other in COMPARED:
    gain, less = table[one][:, 0] - table[other][:, 0], table[other][:, 2] - table[one][:, 2]
    cells = []
    for values in (gain, less):
        means = np.array([values[bodies == body].mean() for body in dict.fromkeys(bodies)])
        cells.append(f"{means.mean():.2f} ± {means.std(ddof=1) / len(means) ** 0.5:.2f}")
        cells.append(f"{100 * np.mean(values > 0):.0f} %")
    rows.append([f"{one} over {other}", *cells])
show.table(["gain", "PSNR (dB)", "slices", "less artefact (HU)", "slices"], rows)

rows = []
for name, t in table.items():
    parts = [t[np.array(metals) == metal] for metal in sorted({*metals})]
    rows.append([name, *(f"{part[:, 0].mean():.2f}, {part[:, 2].mean():.0f}" for part in parts)])
show.table(
    ["PSNR (dB), artefact (HU)", *(f"{metal} ({metals.count(metal)} slices)" for metal in sorted({*metals}))], rows
)

# %% [markdown]
# ## One slice
# Chosen by a rule: a quarter of the test slices has more artefact with LIMAR. One window for all, and errors against
# the reference.

# %%
shown = int(np.argsort(table["LIMAR"][:, 2])[3 * len(metals) // 4])
stored = open_scan(DATA / splits["test"][1][shown])
half = [n * d / 2 for n, d in zip(stored.geometry.n_voxel[:0:-1], stored.geometry.d_voxel[:0:-1], strict=True)]
extent = (-half[0], half[0], -half[1], half[1])
truth, outside = test["reference"][shown].numpy(), test["metal"][shown].numpy() == 0


def hounsfield(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return attenuation in HU."""
    return 1000 * (image / np.float32(water_of(stored)) - 1)


drawing = Figure(figsize=(3.0 * (1 + len(pairs)), 6.4), layout="constrained")
above, below = drawing.subplots(2, 1 + len(pairs), sharex=True, sharey=True)
below[0].axis("off")
images = {"reference": truth} | {name: image[shown].numpy() for name, (image, _) in pairs.items()}
greys, errors = [], []
for axes, name in zip(above, images, strict=True):
    image = hounsfield(images[name])
    greys.append(axes.imshow(image, cmap="gray", origin="lower", extent=extent, vmin=-1000, vmax=1500))
    axes.contour(~outside, [0.5], colors=COLOURS[1], linewidths=0.8, extent=extent)
    axes.set_title(name, fontsize=9)
for axes, name in zip(below[1:], pairs, strict=True):
    wrong = np.where(outside, hounsfield(images[name]) - hounsfield(truth), 0)
    errors.append(axes.imshow(wrong, cmap="RdBu_r", origin="lower", extent=extent, vmin=-500, vmax=500))
    psnr, rmse = scores[name][shown][:2]
    axes.set_title(f"{psnr:.1f} dB, {rmse:.0f} HU", fontsize=9)
drawing.supxlabel("x (mm)", fontsize=9)
above[0].set_ylabel("y (mm)", fontsize=9)
drawing.colorbar(greys[0], ax=above, label="HU", fraction=0.02)
drawing.colorbar(errors[0], ax=below, label="error (HU)", fraction=0.02)
show.figure(drawing, "train-slices")
show.text(
    f"{stored.name}, {metals[shown]}; metal outlined, and its error not shown. Outside the body nothing is judged."
)

# %% [markdown]
# ## What this does not show
# - Bodies, metal and scanner are simulated, and test individuals come from the recipe of the training individuals.
#   Whether the network helps on other anatomy, another scanner or a measured scan is not tested.
# - The scanner has no scatter and no blur, and LIMAR and networks get the true mask, which nobody has.
# - One seed, one size, one training of each network. Other seeds would move the scores; how far was not measured.
# - The true attenuation is known in training. It is not for a real scan.
# - Metal itself is not scored, and no reader looked for lesions: a network can draw tissue that is not there.
