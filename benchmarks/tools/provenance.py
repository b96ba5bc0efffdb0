"""The measured pages of the documentation: what writes each, and which sources its numbers depend on."""

import dataclasses
import re
from pathlib import Path

from ctsim.errors import InputError

SIMULATOR = ("ctsim/", "phantoms/")
METHODS = ("ctsim/", "reconstruct/", "baselines/")
COMMIT = re.compile(r"\bcommits? ((?:[0-9a-f]{7,40}(?:, | and )?)+)")
WITHIN = re.compile(r"\(`[^)]*? ([0-9a-f]{7,40})\)")  # as in "commit X (`nmar` Y)"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A measured page: its title, the command that measures it, the file that command writes, and its sources.

    `sources` are files, or folders ending in "/", from the repository's root. `file` is None where the
    page is written elsewhere, as by `run-benchmark report`, or collected by hand.
    """

    title: str
    command: str
    sources: tuple[str, ...]
    file: str | None = None
    explained: str = ""


PAGES: dict[str, Page] = {
    "results": Page(
        title="Results",
        command="run-benchmark report quick --markdown docs/measured/results.md --also core",
        sources=(*SIMULATOR, *METHODS, "benchmarks/scores/", "benchmarks/suites/quick.toml",
                 "benchmarks/suites/core.toml", "benchmarks/suites/core-scatter.toml", "benchmarks/suites/real.toml"),
    ),
    "methods": Page(
        title="Methods: settings and experiments",
        command="run-benchmark pareto results/ --suite benchmarks/suites/tune-settings.toml --part methods",
        sources=(*SIMULATOR, *METHODS, "benchmarks/scores/", "benchmarks/suites/"),
    ),
    "pareto": Page(
        title="Run time against error",
        command="run-benchmark pareto results/",
        sources=(*SIMULATOR, *METHODS, "benchmarks/studies/pareto/", "benchmarks/suites/pareto.toml"),
        file="pareto.md",
        explained="run-time.md",
    ),
    "ablation": Page(
        title="Ablations of the published splat method",
        command="run-benchmark ablation data/ results/",
        sources=(*SIMULATOR, "reconstruct/splat/", "benchmarks/studies/ablation.py", "benchmarks/suites/ablation.toml"),
        file="ablation.md",
        explained="splats.md",
    ),
    "skipping": Page(
        title="What is left out",
        command="run-benchmark skipping results/ --repeats 3",
        sources=(*SIMULATOR, "reconstruct/", "baselines/", "benchmarks/studies/skipping/"),
        file="skipping.md",
        explained="skipping.md",
    ),
    "speed": Page(
        title="Speed and error of ctsim, RTK and XCIST",
        command="run-benchmark peers results/",
        sources=(*SIMULATOR, "reconstruct/fdk.py", "benchmarks/studies/peers/", "benchmarks/suites/peers.toml"),
        file="peers.md",
        explained="peers.md",
    ),
    "stability": Page(
        title="Numerical stability",
        command="run-benchmark stress results/",
        sources=(*SIMULATOR, *METHODS, "benchmarks/studies/stress/", "benchmarks/suites/stress.toml"),
        file="stress.md",
        explained="stability.md",
    ),
}  # fmt: skip


def commits_of(text: str) -> list[str]:
    """Return the commits that a page names, in their order, each once."""
    found = [c for group in COMMIT.findall(text) for c in re.findall(r"[0-9a-f]{7,40}", group)]
    return list(dict.fromkeys(found + WITHIN.findall(text)))


def page_named(name: str) -> Page:
    """Return a page's declaration. Raises InputError for a page that has none."""
    if name not in PAGES:
        raise InputError(f"there is no measured page {name!r}: expected one of {', '.join(PAGES)}")
    return PAGES[name]


def measured(folder: Path) -> dict[str, str]:
    """Return the text of every measured page in a folder by its name.

    Raises InputError where a page has no declaration, so that none is forgotten.
    """
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.md"))}
    for name in texts:
        page_named(name)
    return texts
