"""Methods of another package, mbirtorch (BSD): model-based iterative reconstruction (MBIR) of a cone beam.

They run its code as it is, with its own defaults, on our line integrals. Needs `ctsim[peers-methods]`. MBIR with a
qGGMRF prior: Thibault et al., Med. Phys. 34, 2007, doi:10.1118/1.2789499.
"""

import importlib
import importlib.metadata
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.log import how_it_ended, line_integrals
from ctsim.reconstruct.primary import Readings, primary
from ctsim.reconstruct.settings import about, keywords
from ctsim.types import Scan, Volume

INPUTS = "counts only, external"
QUIET: dict[str, Any] = {"logfile_path": None, "print_logs": False}
Count = Annotated[int, msgspec.Meta(ge=1, le=1000)]


class Settings(Readings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Defaults are the package's; `seed` is that of its random order of voxels."""

    iterations: Annotated[Count, about("iterations at most; it stops where the volume changes by less than 0.2 %")] = 15
    sharpness: Annotated[float, about("larger is sharper and noisier", ge=-5, le=5)] = 1.0
    weights: Annotated[
        Literal["transmission", "transmission_root", "unweighted"], about("of a reading: exp(-P), exp(-P/2), or 1")
    ] = "transmission"
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**32)] = 0
    compiled: Annotated[bool, about("let torch compile the projectors, minutes once on a machine")] = True


class WithMetal(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Those of `mbir`, the package's defaults for metal among them."""

    weights: Annotated[
        Literal["transmission", "transmission_root", "unweighted"], about("of a reading: exp(-P), exp(-P/2), or 1")
    ] = "transmission_root"
    passes: Annotated[Count, about("corrections, with a reconstruction after each")] = 3
    metals: Annotated[int, about("how many metals are segmented", ge=1, le=5)] = 1


@keywords(Settings)
@primary
def mbir(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan` by MBIR with a qGGMRF prior; keywords as `Settings`.

    Raises InputError where mbirtorch is not installed or cannot take the geometry.
    """
    package = _package()
    model, p = _model(package, scan.geometry, settings), line_integrals(scan, slice(None))[0].numpy()
    weights, rng = package.gen_weights(p, settings.weights), np.random.default_rng(settings.seed)
    found, _ = model.recon(p, weights, max_iterations=settings.iterations, rng=rng, **QUIET)
    return _volume(found, scan)


@keywords(WithMetal)
@primary
def mbir_mar(scan: Scan, settings: WithMetal) -> Volume:
    """Reconstruct `scan` by MBIR with the package's correction of beam hardening in plastic and metal.

    It segments both in its own volume, corrects the projections by a polynomial of both paths, and reconstructs again.
    Raises InputError as `mbir` does.
    """
    package = _package()
    model, p = _model(package, scan.geometry, settings), line_integrals(scan, slice(None))[0].numpy()
    np.random.seed(settings.seed)  # noqa: NPY002 - the package draws from the global state here
    found, _ = model.recon_plastic_metal(
        p,
        package.gen_weights(p, settings.weights),
        num_BH_iterations=settings.passes,
        num_metal=settings.metals,
        max_iterations=settings.iterations,
        logfile_path=None,
    )
    return _volume(found, scan)


def skip(scan: Scan) -> str | None:
    """Return why the package cannot take a scan; None where it can."""
    return _unfit(scan.geometry)


def _unfit(geometry: Geometry) -> str | None:
    if geometry.poses is not None:
        return "mbirtorch takes circular orbits only"
    if len(set(geometry.d_voxel)) > 1 or any(geometry.off_origin[1:]):
        return "mbirtorch takes cubic voxels around the axis only"
    return None


def _package() -> Any:
    try:
        return importlib.import_module("mbirtorch")
    except ModuleNotFoundError as error:
        raise InputError(f"this method needs {error.name}; pip install 'ctsim[peers-methods]' installs it") from None


def _model(package: Any, geometry: Geometry, settings: Settings) -> Any:
    """Return the package's cone beam. Its angles are ours, its detector's offsets have the other sign."""
    if unfit := _unfit(geometry):
        raise InputError(unfit)
    n_z, n_y, n_x = geometry.n_voxel
    model = package.ConeBeamModel(
        geometry.shape,
        geometry.angles,
        source_detector_dist=geometry.dsd,
        source_iso_dist=geometry.dso,
        compile_mode="auto" if settings.compiled else "off",
    )
    model.set_params(
        delta_det_row=geometry.d_detector[0],
        delta_det_channel=geometry.d_detector[1],
        det_row_offset=-geometry.off_detector[0],
        det_channel_offset=-geometry.off_detector[1],
        delta_voxel=geometry.d_voxel[0],
        recon_shape=(n_x, n_y, n_z),
        recon_slice_offset=geometry.off_origin[0],
        sharpness=settings.sharpness,
        verbose=0,
    )
    return model


def _volume(found: Any, scan: Scan) -> Volume:
    """Return the package's volume [x, y, z] as ours."""
    values = torch.from_numpy(np.ascontiguousarray(np.asarray(found).transpose(2, 1, 0), np.float32))
    clamped = int(line_integrals(scan, slice(None))[1].sum())
    status, reason = how_it_ended(values, scan, clamped)
    details = {
        "package": f"mbirtorch {importlib.metadata.version('mbirtorch')}",
        "clamped_pixels": clamped,
    }
    return Volume(values=values, status=status, reason=reason, details=details)
