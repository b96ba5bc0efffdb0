"""The tube and the detector of a scan, for methods that are told its spectrum."""

from dataclasses import replace
from typing import Any

import msgspec

from ctsim.benchmarks.methods import MASK_AND_SPECTRUM, SPECTRUM, TABLE, Method
from ctsim.dataset.truth import ScanWithTruth

BEAM = ("tube", "detector")
NOT_TOLD = "the simulator's default tube and detector are assumed, with the scan's highest energy"
NO_BOWTIE = "told the scan's tube without its bow-tie, behind which every pixel has a spectrum of its own"


def with_beam(method: Method, scan: ScanWithTruth | None) -> Method:
    """Return the method told the tube and the detector of a simulated scan, from its scene.

    Only a method of the table that is told the spectrum, and only if it was given neither. Where the scene is not
    known, as for a scan without truth, it keeps its defaults, and its volumes say so as a limitation.
    """
    told = method.name in TABLE and method.inputs in (SPECTRUM, MASK_AND_SPECTRUM)
    if not told or any(method.overrides.get(key) is not None for key in BEAM):
        return method
    found = _tables(scan)
    if isinstance(found, str):
        return replace(method, limitation=f"{NOT_TOLD}: {found}")
    beam, limitation = found
    return replace(method, told=beam, params=method.params | beam, limitation=limitation)


def _tables(scan: ScanWithTruth | None) -> tuple[dict[str, Any], str] | str:
    """Return tube and detector as tables of a scene file, with their limitation; why they are unknown otherwise."""
    from ctsim.phantoms.dataset import scene_of  # loads torch, which listing methods does without

    if scan is None:
        return "the scan comes without its scene"
    scene = scene_of(scan)
    if isinstance(scene, str):
        return scene
    scanner = scene.resolve()
    tube = msgspec.structs.replace(scanner.tube, bowtie=None)
    tables = {"tube": msgspec.to_builtins(tube), "detector": msgspec.to_builtins(scanner.detector)}
    return tables, NO_BOWTIE if scanner.tube.bowtie is not None else ""
