"""What each thing that a simulation shares with a method gave whom, as a table.

    make-dataset assumptions data/ --seeds 1 2 3
    run-benchmark data/ results/ --method zero --method hull --method twin-fdk --method fdk --method limar --method nmar
    run-benchmark data/ results/ --method bhc-poly --method ibhc --method sirt --method asd-pocs --method fista-tv
    run-benchmark data/ results/ --method fdk-ramp --method water-precorrection --method os-sart --method cgls
    run-benchmark data/ results/ --method sart --method awpcsd --method acdnet-lite --method oscnet-lite
    run-benchmark data/ results/ --method denoise-lite --method fusion --method dicdnet-lite --method splat
    python -m ctsim.benchmarks.tools.assumptions results/ docs/measured

The scenes of the suite `assumptions` are "OBJECT-FAVOUR"; "OBJECT-strict" grants no method anything. A cell is what a
favour adds to the method's number on the strict scene, a mean over the seeds. The page is written to the folder, or
printed without one.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.study import provenance
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest, read
from ctsim.benchmarks.studies.methods.tables import Numbers, numbers
from ctsim.benchmarks.tools.page import put
from ctsim.errors import InputError

STRICT = "-strict"
NAME = "assumptions.md"
SHOWN = {
    ("tissue", "psnr3d"): ("PSNR3D (dB)", 2),
    ("metal_cost", "own_db"): ("cost of metal (dB)", 2),
    ("soft", "rmse"): ("soft-tissue RMSE (HU)", 1),
}
"""Protocol and metric -> its title and decimals."""
CAPTION = (
    "The row strict has the method's own number. Every other row says how that number changes where the scene shares "
    "one more thing with some method, and the last where it shares all."
)


def main(arguments: list[str]) -> int:
    """Write or print the page; return 0."""
    if len(arguments) not in (1, 2):
        raise InputError("expected RESULTS, and the folder of the measured pages or nothing")
    records = latest(read(Path(arguments[0])))
    return put(page(records), NAME, arguments[1] if len(arguments) > 1 else None)


def page(records: Sequence[RunRecord]) -> str:
    """Return the page: how it was made, and a table for each object and number.

    Raises InputError where no scene is named as those of the suite are.
    """
    scenes = list(dict.fromkeys(record.run.scene for record in records))
    objects = [scene.removesuffix(STRICT) for scene in scenes if scene.endswith(STRICT)]
    if not objects:
        raise InputError(f"there is no record of a scene named OBJECT{STRICT}: run the suite assumptions first")
    found = numbers(records)
    tables = [table for name in objects for table in _tables(name, scenes, records, found)]
    commands = [line.strip() for line in (__doc__ or "").splitlines() if line.startswith("    ")]
    made = "; ".join(f"`{command}`" for command in commands)
    seeds = ", ".join(str(seed) for seed in sorted({record.run.seed for record in records}))
    caption = f"{CAPTION} Seeds: {seeds}."
    head = f"# What a simulation shares with a method: measured\n\nMade by {made}. Do not edit.\n\n{caption}\n\n"
    return f"{head}{provenance(records)}\n\n" + "\n".join(table.markdown() for table in tables)


def _tables(name: str, scenes: Sequence[str], records: Sequence[RunRecord], found: Numbers) -> list[Table]:
    """Return the tables of an object, one for each number that the records have."""
    here = [scene for scene in scenes if scene.startswith(f"{name}-")]
    methods = list(dict.fromkeys((record.label, record.inputs) for record in records if record.run.variant == METAL))
    made = []
    for (protocol, metric), (title, digits) in SHOWN.items():
        values = {
            (scene, label): number[0]
            for scene in here
            for label, inputs in methods
            if (number := found.get((scene, METAL, label, inputs, protocol, metric))) is not None
        }
        rows = []
        for scene in sorted(here, key=lambda scene: scene != f"{name}{STRICT}"):
            cells = [_cell(values, scene, f"{name}{STRICT}", label, digits) for label, _ in methods]
            rows.append([scene.removeprefix(f"{name}-"), *cells])
        labels = [label for label, _ in methods]
        if any(value is not None for value in values.values()):
            made.append(simple(["scene", *labels], rows, numbers=labels, title=f"{name}: {title}"))
    return made


def _cell(values: dict[tuple[str, str], float | None], scene: str, strict: str, label: str, digits: int) -> str:
    """Return a method's number on the strict scene, or by how much another scene's differs from it."""
    own, base = values.get((scene, label)), values.get((strict, label))
    if own is None or base is None:
        return "–"
    return f"{own:.{digits}f}" if scene == strict else f"{own - base:+.{digits}f}"


if __name__ == "__main__":
    sys.exit(guarded("assumptions", "ctsim.benchmarks.tools.assumptions", sys.argv[1:]))
