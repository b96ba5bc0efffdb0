"""What `run-benchmark skipping` measures of effects that a scanner may leave out: scatter, blur and uneven field.

Level 0, a point source and a sharp panel do nothing for them. Each pair shows the scan without and with one of them.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import msgspec

from ctsim.beam.spot import FocalSpot, OffFocal
from ctsim.benchmarks.studies.skipping.simulator import P_IMAGES, Bench, Cases, Pair, image_difference
from ctsim.detector.panel import Blur, Lag
from ctsim.scatter import Scatter

NOTHING = 1e-9  # mm of a spot or of blur, share of lag: too little to change a bit
COARSE = 0.05  # of the scatter, so that the photons of a pair take seconds


def scatter(setup: Bench) -> Iterator[Pair]:
    """Yield a scan without scatter and with each model of it, all of which level 0 leaves out.

    Monte Carlo follows its photons before the first view, so those scans are timed from their beginning.
    """
    plain, scattering = setup.planned(), setup.planned(scatter=Scatter(level=1))
    note = f"level 1 adds S/I0 = {scattering.plan.scatter_fraction:.2g} to every pixel"
    choice: dict[str, Any] = {"limit": None, "stated": "a choice"}
    yield setup.pair("scatter at level 0, which leaves it out", plain, scattering, note=note, **choice)
    scene = setup.scene()
    error = max(COARSE, scene.simulation.scatter_error)
    coarse = msgspec.structs.replace(scene.simulation, scatter_error=error)
    scene = msgspec.structs.replace(scene, simulation=coarse)
    for grid, what in ((None, ""), (10.0, " and an anti-scatter grid")):
        followed = setup.planned(scene, scatter=Scatter(level=3, grid_ratio=grid))
        yield Pair(
            scene=scene.name,
            what=f"scatter by Monte Carlo{what}",
            skipping=setup.first_views(plain),
            whole=setup.first_views(followed),
            difference=partial(image_difference, names=P_IMAGES),
            note=f"to {error:.0%}; the time goes with the inverse square of simulation.scatter_error",
            **choice,
        )


def blurs(setup: Bench) -> Iterator[Pair]:
    """Yield a scan without and with each effect that makes it less sharp or its field less even: all are off.

    The first pair has a panel that spreads no light and a spot that is a point, which change nothing.
    """
    plain = setup.planned()
    tube, detector = plain.scanner.tube, plain.scanner.detector
    blur, lag = Blur(fwhm=0.4, tail=0.1, tail_fwhm=2.0), (Lag(share=0.03, decay=0.5), Lag(share=0.01, decay=0.9))
    point = msgspec.structs.replace(tube, focal_spot=FocalSpot(size=(NOTHING, NOTHING)))
    sharp = msgspec.structs.replace(detector, blur=Blur(fwhm=NOTHING), lag=(Lag(share=NOTHING, decay=0.5),))
    yield setup.pair(
        "a point for a spot, and a sharp panel without lag",
        plain,
        setup.planned(tube=point, detector=sharp),
        difference=partial(image_difference, names=("counts", "metal_free/counts")),
        unit="counts",
        limit=1.0,  # where a count lies at a half
        stated="photons are rounded to float32 before such a panel",
        note="line integrals are the same to the last bit",
    )
    changes: dict[str, dict[str, Any]] = {
        "a focal spot of 0.4 mm": {"tube": msgspec.structs.replace(tube, focal_spot=FocalSpot(size=(0.4, 0.4)))},
        "off-focal radiation": {"tube": msgspec.structs.replace(tube, off_focal=OffFocal(share=0.03, fwhm=5.0))},
        "detector blur": {"detector": msgspec.structs.replace(detector, blur=blur)},
        "lag": {"detector": msgspec.structs.replace(detector, lag=lag)},
        "1/r² and slant over the panel": {"tube": msgspec.structs.replace(tube, falloff=True)},
    }
    for what, change in changes.items():
        given = setup.planned(**change)
        points = "" if given.plan.spot is None else f"{len(given.plan.spot.weights)} sub-sources"
        yield setup.pair(what, plain, given, difference=image_difference, unit="counts", limit=None, stated="a choice",
                         note=points)  # fmt: skip


CASES: Cases = {"scatter": scatter, "blurs": blurs}
