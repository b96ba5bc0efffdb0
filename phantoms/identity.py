"""What of a scene its id says: every key, except keys that came later and have their default.

Ids name folders and noise streams, so a new key must not change those of scenes that do not have it. `FIRST_KEYS` are
the keys that every id holds. Any other key is left out while it has its default. The default of such a key is part of
what old ids mean: it never changes.
"""

from typing import Any

import msgspec

_BODY = "n_voxel size metal n_inserts insert_mm"
FIRST_KEYS: dict[str, frozenset[str]] = {
    name: frozenset(keys.split())
    for name, keys in {
        "Scene": "name phantom scanner seed truncated truth simulation",
        "Validation": _BODY,
        "MetalRods": _BODY,
        "Lung": f"{_BODY} vessels ribs",
        "Teeth": f"{_BODY} crowns missing",
        "Jaw": f"{_BODY} crowns missing fillings gold_crowns bridges",
        "Broccoli": f"{_BODY} levels forks",
        "Walnut": _BODY,
        "Chicken": f"{_BODY} turns",
        "BellPepper": f"{_BODY} lobes",
        "Random": f"{_BODY} organs",
        "CtVolume": f"{_BODY} path spacing rescale kev at sha256",
        "Hip": f"{_BODY} head",
        "Spine": f"{_BODY} rods",
        "ScannerSettings": "preset n_views n_detector n_voxel field_mm start_deg arc_deg angles_deg off_detector "
        "off_origin geometry tube detector noise scatter i0",
        "Geometry": "dso dsd n_voxel d_voxel n_detector d_detector n_views off_origin off_detector start_deg arc_deg "
        "angles_deg poses",
        "Tube": "kvp anode_deg filters model heel bowtie",
        "Filter": "material thickness",
        "Bowtie": "material center edge half_angle_deg",
        "Detector": "kind thickness threshold",
        "Noise": "model electronic adc_bits adc_fill pedestal n_flats fixed_pattern pattern_residual dead_fraction",
        "Scatter": "level fraction",
        "Truth": "twin noise_free scatter_free mono_kev trace metal_path paths",
        "Simulation": "tolerance subrays edge_tolerance skip",
    }.items()
}
"""The keys of each struct that are part of every id."""


def identity(value: Any) -> Any:
    """Return a value of a scene as plain types, without later keys that have their default."""
    plain = msgspec.to_builtins(value)
    _leave_out(value, plain)
    return plain


def _leave_out(value: Any, plain: Any) -> None:
    """Take later keys at their default out of `plain`, what `msgspec.to_builtins` made of `value`."""
    if isinstance(value, msgspec.Struct):
        first = FIRST_KEYS.get(type(value).__name__, frozenset())
        for item in msgspec.structs.fields(value):
            held = getattr(value, item.name)
            if item.encode_name not in first and not item.required and held == item.default:
                del plain[item.encode_name]
            else:
                _leave_out(held, plain[item.encode_name])
    elif isinstance(value, tuple) and value and isinstance(value[0], msgspec.Struct):
        for one, made in zip(value, plain, strict=True):
            _leave_out(one, made)
