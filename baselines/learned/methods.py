"""Methods with trained weights: `fusion`, three unrolled networks on axial slices, and the ablation of either kind.

All were trained on the suite `train` (`ctsim.benchmarks.tools.train_learned`). Networks work in multiples of the scan's
water; volumes are in 1/mm.
"""

from collections.abc import Callable
from typing import Annotated, cast

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.learned import fusion as net_3d
from ctsim.baselines.learned.dictionary import Unrolled
from ctsim.baselines.learned.fusion import Residual
from ctsim.baselines.learned.inputs import Inputs, blind, told
from ctsim.baselines.learned.weights import OWN, Card, trained
from ctsim.baselines.limar import Bridging
from ctsim.baselines.metal import reinsert
from ctsim.baselines.prior import NO_BODY
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.log import finite_or_not
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import about as parameter
from ctsim.reconstruct.settings import keywords
from ctsim.types import Scan, Status, Volume

SLAB = 32  # slices of a volume that a 3-D network sees at a time in addition to its halo
SLICES = 8  # axial slices at a time
Trained = Annotated[str, parameter("trained weights: shipped, or a safetensors file with its JSON next to it")]
Array = NDArray[np.float32]


class Settings(Bridging, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Those of `ctsim.baselines.limar.Bridging`, for LIMAR, NMAR and the metal; and the trained weights."""

    network: Trained = OWN


class Blind(Filter, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The filter of FDK, and the trained weights."""

    network: Trained = OWN


@keywords(Settings)
@primary
def fusion(scan: Scan, settings: Settings) -> Volume:
    """Add to NMAR what a small 3-D network makes of FDK, LIMAR, NMAR and the metal mask, at most one water.

    Without metal, and where the mask is not to be relied on, LIMAR and NMAR are FDK and the network only denoises.
    Where FDK fails or shows no body the result is FDK's. Raises InputError as LIMAR does, and for wrong weights.
    """
    net, card = trained("fusion", settings.network)
    seen = told(scan, settings)
    return _finished(seen, card, settings.insert, lambda: _in_slabs(cast(Residual, net), seen))


@keywords(Blind)
@primary
def denoise(scan: Scan, settings: Blind) -> Volume:
    """Add to FDK what the network of `fusion` makes of FDK alone: the same training, no metal mask, LIMAR or NMAR.

    Where FDK fails or shows no body the result is FDK's. Raises InputError as FDK does, and for wrong weights.
    """
    net, card = trained("denoise", settings.network)
    seen = blind(scan, settings)
    return _finished(seen, card, "none", lambda: _in_slabs(cast(Residual, net), seen))


@keywords(Settings)
@primary
def dicdnet_lite(scan: Scan, settings: Settings) -> Volume:
    """Remove artefacts from axial slices: filters that are the same for every image (`Fixed` of `dictionary`).

    Slices start from LIMAR. Without metal it only denoises. Raises InputError as LIMAR does, and for wrong weights.
    """
    return _slice_by_slice("dicdnet-lite", scan, settings)


@keywords(Settings)
@primary
def acdnet_lite(scan: Scan, settings: Settings) -> Volume:
    """Remove artefacts from axial slices: filters mixed for each image from atoms (`Mixed`); else as `dicdnet_lite`."""
    return _slice_by_slice("acdnet-lite", scan, settings)


@keywords(Settings)
@primary
def oscnet_lite(scan: Scan, settings: Settings) -> Volume:
    """Remove artefacts from axial slices: four filters at eight angles each (`Turned`); else as `dicdnet_lite`."""
    return _slice_by_slice("oscnet-lite", scan, settings)


@keywords(Blind)
@primary
def denoise_lite(scan: Scan, settings: Blind) -> Volume:
    """Do as `dicdnet_lite` from FDK alone: the same network and training, neither metal mask nor LIMAR.

    Where FDK fails or shows no body the result is FDK's. Raises InputError as FDK does, and for wrong weights.
    """
    net, card = trained("denoise-lite", settings.network)
    seen = blind(scan, settings)
    return _finished(seen, card, "none", lambda: _slices(cast(Unrolled, net), seen))


def _slice_by_slice(name: str, scan: Scan, settings: Settings) -> Volume:
    net, card = trained(name, settings.network)
    seen = told(scan, settings, ("fdk", "limar"))
    return _finished(seen, card, settings.insert, lambda: _slices(cast(Unrolled, net), seen))


def _finished(seen: Inputs, card: Card, insert: str, work: Callable[[], Array]) -> Volume:
    """Return the volume that `work` gives in 1/mm, with the metal put back; FDK's where there is nothing to work on."""
    first, said = seen.first, {"weights": card.sha256[:12]}
    if first.status is not Status.OK or seen.water <= 0:
        why = {"uncorrected_reason": f"{NO_BODY}: the volume is FDK's"} if first.status is Status.OK else {}
        details = seen.details() | said | why
        return Volume(values=first.values, status=first.status, reason=first.reason, details=details)
    x_0 = first.values.numpy()
    values = torch.from_numpy(np.where(x_0 == 0, np.float32(0), work()))  # 0: outside the field of view
    if seen.metal is not None and seen.metal.found:
        reinsert(values, x_0, seen.metal, insert)
    status, reason = finite_or_not(values.numpy())
    return Volume(values=values, status=status, reason=reason, details=seen.details() | said)


@torch.no_grad()
def _in_slabs(net: Residual, seen: Inputs) -> Array:
    """Return the last source and what the network adds to it, in 1/mm, some slices at a time."""
    scaled, last = {name: seen.scaled(name) for name in seen.sources}, [*seen.sources][-1]
    mask, n_z, changes = seen.mask, len(seen.mask), list[Array]()
    for first in range(0, n_z, SLAB):
        begin, end = max(first - net_3d.HALO, 0), min(first + SLAB + net_3d.HALO, n_z)
        sources = torch.from_numpy(np.stack([scaled[name][begin:end] for name in scaled])[None])
        metal = torch.from_numpy(mask[None, None, begin:end].astype(np.float32))
        change = net.change(sources, metal)[0, 0, first - begin : first - begin + SLAB]
        changes.append((change * seen.water).numpy())
    return seen.sources[last] + np.concatenate(changes)


@torch.no_grad()
def _slices(net: Unrolled, seen: Inputs) -> Array:
    """Return the network's volume in 1/mm."""
    y, start = (torch.from_numpy(seen.scaled(name))[:, None] for name in ("fdk", [*seen.sources][-1]))
    keep = torch.from_numpy(~seen.mask[:, None]).float()
    parts = [slice(k, k + SLICES) for k in range(0, len(y), SLICES)]
    found = [net(y[part], start[part], keep[part])[-1][0][:, 0] * seen.water for part in parts]
    return torch.cat(found).numpy()
