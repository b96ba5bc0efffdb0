"""All scores of one volume: every protocol that applies to it, from one scan's truth."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.scores.artefact import Layout, artefact_score, effective_attenuation, layout_of
from ctsim.benchmarks.scores.metrics import METAL
from ctsim.benchmarks.scores.projection import HeldOut, held_out, projection_score, with_floor
from ctsim.benchmarks.scores.protocol import Truth, evaluate, truth_of
from ctsim.benchmarks.scores.score import NO_TWIN, PROJECTION, PROTOCOLS, Score
from ctsim.benchmarks.scores.soft import SoftLayout, soft_layout, soft_score
from ctsim.benchmarks.scores.structure import StructureLayout, structure_layout, structure_score
from ctsim.dataset.truth import ScanWithTruth
from ctsim.notes import NOT_ON_GRID


@dataclass(frozen=True, slots=True, kw_only=True)
class Twin:
    """A method's volume of the metal-free scan, [z, y, x] in 1/mm; without one, `reason` says why."""

    values: NDArray[np.float32] | None = None
    reason: str = NO_TWIN


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """The references and regions that volumes of one scan are scored with.

    `absent` says that the scene's metal is on no voxel of the grid or in no view; "" if it is in both.
    """

    truth: Truth
    layout: Layout
    soft: SoftLayout | str
    structure: StructureLayout | str
    views: HeldOut | str
    absent: str = ""

    @classmethod
    def of(cls, stored: ScanWithTruth, views: HeldOut | str | None = None) -> "Judge":
        """Load a scan's references and choose where its artefacts are measured.

        `views` are those of an earlier judge of the scan: to simulate them is most of the work.
        """
        truth = truth_of(stored)
        if views is None:
            views = with_floor(held_out(stored), truth)
        water, bone = (effective_attenuation(stored, name) for name in ("water", "cortical_bone"))
        soft = soft_layout(np.asarray(stored.labels), truth, stored.info.materials, water)
        return cls(
            truth=truth,
            layout=layout_of(stored, truth),
            soft=soft,
            structure=structure_layout(soft, truth, bone / water if bone and water else None),
            views=views,
            absent=_absent(stored, truth),
        )

    def scores(
        self,
        values: NDArray[Any],
        variant: str,
        twin: Twin,
        at_50kev: NDArray[Any] | None = None,
        protocols: Collection[str] = PROTOCOLS,
    ) -> dict[str, Score]:
        """Score a volume under those `protocols` that apply to the `variant` of its scan, with or without metal.

        `at_50kev` is the volume at 50 keV of a method that knows energies.
        """
        whole, metal = variant == "metal", self.truth.metal.any()
        found = evaluate(values, self.truth, at_50kev=at_50kev, anchor=not whole, protocols=protocols)
        if "soft" in protocols:
            found["soft"] = soft_score(values, self.soft)
        if "structure" in protocols and metal:
            found["structure"] = structure_score(values, self.structure)
        if PROJECTION in protocols and whole:
            found[PROJECTION] = projection_score(values, self.views, at_50kev)
        if "metal" in protocols and whole and self.absent:
            found["metal"] = Score.none("metal", METAL, self.absent)
        if "artefact" in protocols and whole and (self.absent or metal):
            pair, why = (None, self.absent) if self.absent else (twin.values, twin.reason)
            found["artefact"] = artefact_score(values, pair, self.layout, self.truth, why)
        return found


def _absent(stored: ScanWithTruth, truth: Truth) -> str:
    """Return a scan's notes on its metal; a scan of an older version has none, so its mask decides."""
    if stored.info.notes or truth.metal.any() or not stored.info.metal:
        return "; ".join(stored.info.notes)
    return f"{NOT_ON_GRID}: the scan's mask is empty, though its scene holds {', '.join(stored.info.metal)}"
