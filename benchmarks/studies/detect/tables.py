"""Tables of the detection study, from the responses that the records hold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from ctsim.benchmarks.engine.record import Record
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.scores.channels import N_CHANNELS
from ctsim.benchmarks.scores.observer import (
    DRAWS,
    FOLDS,
    LEAST,
    Area,
    Responses,
    difference,
    known_background,
    normal_theory,
    varying_background,
)
from ctsim.benchmarks.scores.soft import LEAST_DEVIATION
from ctsim.benchmarks.studies.detect import PAIRS
from ctsim.benchmarks.studies.detect.records import Pair, Seen, Site
from ctsim.benchmarks.studies.detect.suite import Group

BASE = "fdk"
WORDS = {"near": "near", "far": "far from"}
Observer = Callable[[Responses], Area]
TEXT = (
    f"A channelised Hotelling observer with {N_CHANNELS} Laguerre–Gauss channels in a ball around each location, "
    f"without metal and its neighbouring voxels, is trained and tested on different scans ({FOLDS} folds). AUC is "
    "the share of pairs of volumes, one with and one without a lesion, that it puts in the right order: 0.5 is "
    "guessing. With artefacts known it is trained at the location itself, so that only noise hides a lesion. With "
    "artefacts varying it is trained at the other locations and knows the anatomy from the method's volume "
    "without metal: what is left of artefacts hides a lesion, too. In brackets are 95 % intervals over scans, for "
    "these bodies and locations; Δ is the difference from fdk on the same scans. Recovered is the lesion's mean "
    "contrast over the true one; CNR is that contrast over the deviation of the same mean without a lesion, over scans "
    "and locations, so that noise and artefacts both lower it. limar and nmar are told the true metal. splat takes "
    "scatter and the panel's lag and glare off the readings by itself; fdk, limar and nmar leave them in, unless a "
    "label says panel=found, scatter=found: then what is found in the scan is taken off first."
)
SAID = {
    "zero": "zero, a control, is a volume of zeros: all pairs tie.",
    "hull": "hull, a control, is one value within the object's shadows. All lesions of a scan change it together, so "
    "that its AUC and CNR come from the scan as a whole and not from the sight of a lesion.",
    "twin-fdk": "twin-fdk, a control, is FDK of scans of the body without metal, with the same photons.",
}
"""What the caption says of a method, where it has rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """All pairs of one scene by one method; `lost` are those that failed, with the last reason."""

    scene: str
    method: str
    inputs: str
    sites: tuple[Site, ...]
    pairs: tuple[int, ...]
    found: tuple[Pair, ...]
    lost: int
    reason: str

    def responses(self, group: Group | None, shape: str = "ball", *, less_anatomy: bool = False) -> Responses:
        """Return the responses at the locations of a group, in both classes less those to the anatomy if asked."""
        where = np.array(self.locations(group), int)
        present, absent = (self._of(name, shape) for name in ("present", "absent"))
        largest = float(max(np.abs(present).max(), np.abs(absent).max()))
        if less_anatomy:
            anatomy = self._of("anatomy", shape)
            present, absent = present - anatomy, absent - anatomy
        return Responses(present=present, absent=absent, pairs=np.array(self.pairs), scale=largest).at(where)

    def locations(self, group: Group | None) -> list[int]:
        """Return the numbers of the locations of a group; None for all."""
        return [k for k, site in enumerate(self.sites) if group in (None, site.group)]

    def recovered(self, locations: Sequence[int]) -> float:
        """Return the mean contrast of lesions over the true one."""
        return fmean(_mean(self.found, "present", k) - _mean(self.found, "absent", k) for k in locations)

    def cnr(self, locations: Sequence[int]) -> float | None:
        """Return that contrast over the deviation, over scans and locations, of what is there without a lesion.

        Both are means weighted by the lesion's image, less that of the anatomy, as a share of the true contrast.
        None where volumes deviate by rounding alone.
        """
        where = list(locations)
        empty = np.stack([np.array(_seen(pair, "absent").lesion)[where] for pair in self.found])
        empty -= np.stack([np.array(_seen(pair, "anatomy").lesion)[where] for pair in self.found])
        deviation = float(empty.std())
        in_hu = deviation * abs(self.sites[where[0]].contrast_hu)
        return self.recovered(where) / deviation if in_hu > LEAST_DEVIATION else None

    def _of(self, name: str, shape: str) -> np.ndarray:
        return np.stack([np.array(getattr(_seen(pair, name), shape)) for pair in self.found])


def _seen(pair: Pair, name: str) -> Seen:
    seen = getattr(pair, name)
    assert seen is not None  # of a pair that ended well
    return seen


def _mean(found: Sequence[Pair], name: str, location: int) -> float:
    return fmean(_seen(pair, name).lesion[location] for pair in found)


def series_of(records: Sequence[Record[Pair]]) -> list[Series]:
    """Collect records into series, in their order; pairs of older code or another scene than the newest's are left."""
    groups: dict[tuple[str, str], list[Record[Pair]]] = {}
    for record in records:
        groups.setdefault((record.task.part, record.task.subject), []).append(record)
    out = []
    for (scene, method), members in groups.items():
        newest = max(members, key=lambda r: r.time).task
        same = [r for r in members if (r.task.data, r.task.code) == (newest.data, newest.code)]
        ended = [r for r in same if r.finished]
        failed = [r for r in same if not r.finished]
        shown = (ended or failed)[-1].found[0]
        out.append(
            Series(
                scene=scene,
                method=method,
                inputs=shown.inputs,
                sites=shown.sites,
                pairs=tuple(r.task.settings["pair"] for r in ended),
                found=tuple(r.found[0] for r in ended),
                lost=len(failed),
                reason=failed[-1].found[0].reason if failed else "",
            )
        )
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class _Measure:
    """An observer on the locations of a group."""

    observer: Observer
    group: Group
    shape: str = "ball"
    less_anatomy: bool = False

    def area(self, one: Series) -> Area | None:
        """Return the AUC; None where there are too few pairs or locations."""
        return self._area(one.responses(self.group, self.shape, less_anatomy=self.less_anatomy)) if one.found else None

    def _area(self, found: Responses) -> Area | None:
        folds = np.bincount(found.pairs % FOLDS, minlength=FOLDS)
        n = found.present.shape[1]
        if folds.min() < LEAST // FOLDS or n < (2 if self.observer is varying_background else 1):
            return None
        return self.observer(found)

    def cells(self, one: Series, base: Series | None) -> list[str]:
        """Return AUC and its difference from that of `base`, over the pairs that both have."""
        area = self.area(one)
        if area is None or base is None or base is one:
            return [_interval(area), "–"]
        common = np.intersect1d(one.pairs, base.pairs)
        both = [
            self._area(s.responses(self.group, self.shape, less_anatomy=self.less_anatomy).only(common))
            for s in (one, base)
        ]
        if both[0] is None or both[1] is None:
            return [_interval(area), "–"]
        value, low, high = difference(both[0], both[1])
        return [_interval(area), f"{value:+.3f} [{low:+.3f}, {high:+.3f}]"]


def _interval(area: Area | None) -> str:
    return "–" if area is None else f"{area.auc:.3f} [{area.low:.3f}, {area.high:.3f}]"


def _bases(listed: Sequence[Series]) -> dict[str, Series]:
    return {one.scene: one for one in listed if one.method == BASE and one.found}


def summary(listed: Sequence[Series]) -> list[Table]:
    """Return the table of all scenes and methods, near metal and far from it."""
    titles = [
        "scene", "lesions", "method", "inputs", "AUC, artefacts varying", "Δ, artefacts varying",
        "AUC, artefacts known", "Δ, artefacts known", "recovered", "CNR", "s",
    ]  # fmt: skip
    bases, rows = _bases(listed), []
    for scene in dict.fromkeys(one.scene for one in listed):
        for group in ("near", "far"):
            for one in (s for s in listed if s.scene == scene):
                rows.append(_row(one, group, bases.get(scene)))
    controls = [text for name, text in SAID.items() if any(one.method == name for one in listed)]
    caption = " ".join([TEXT, *controls, *_scenes(listed)])
    lost = [f"{s.scene}, {s.method}: {s.lost} pairs failed: {s.reason}" for s in listed if s.lost]
    return [simple(titles, rows, numbers=titles[4:], title="Detection of lesions", caption=caption, notes=lost)]


def _row(one: Series, group: Group, base: Series | None) -> list[str]:
    varying = _Measure(observer=varying_background, group=group, less_anatomy=True).cells(one, base)
    known = _Measure(observer=known_background, group=group).cells(one, base)
    where = one.locations(group)
    known_lesions = bool(one.found and where)
    share = f"{one.recovered(where):z.2f}" if known_lesions else "–"
    cnr = one.cnr(where) if known_lesions else None
    seconds = [s for pair in one.found for s in sum(pair.seconds.values(), ())]
    return [
        one.scene,
        group,
        one.method,
        one.inputs,
        *varying,
        *known,
        share,
        "–" if cnr is None else f"{cnr:z.2f}",
        f"{median(seconds):.2f}" if seconds else "–",
    ]


def _scenes(listed: Sequence[Series]) -> list[str]:
    """Return a sentence for each scene: its lesions, and how many pairs its methods have."""
    said = []
    for scene in dict.fromkeys(one.scene for one in listed):
        of = [one for one in listed if one.scene == scene]
        sites, counts = of[0].sites, [len(one.found) for one in of]
        parts = []
        for group in ("near", "far"):
            members = [site for site in sites if site.group == group]
            if members:
                low, high = (f(site.distance_mm for site in members) for f in (min, max))
                parts.append(f"{len(members)} {WORDS[group]} metal ({low:.1f} to {high:.1f} mm from it)")
        contrast = next((site.contrast_hu for site in sites if site.group != "none"), 0.0)
        few = f", fewer than the {PAIRS} of the protocol" if min(counts) < PAIRS else ""
        pairs = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
        said.append(f"{scene}: lesions of {contrast:+.0f} HU, {' and '.join(parts)}; {pairs} pairs of scans{few}.")
    return said


def details(listed: Sequence[Series]) -> list[Table]:
    """Return the control without lesions, the observer in the central slice, and every location by itself."""
    return [_controls(listed), _slices(listed), _places(listed)]


def _controls(listed: Sequence[Series]) -> Table:
    measure = _Measure(observer=known_background, group="none")
    rows = [[s.scene, s.method, _interval(measure.area(s))] for s in listed if s.locations("none")]
    caption = (
        "The same observer where there is no lesion in any scan. It can only guess where no lesion elsewhere reaches "
        "into its region: 95 of 100 intervals should hold 0.5. In hull every lesion reaches it. "
        f"{DRAWS} draws make an interval."
    )
    return simple(
        ["scene", "method", "AUC"], rows, numbers=("AUC",), title="Locations without a lesion", caption=caption
    )


def _slices(listed: Sequence[Series]) -> Table:
    titles = ["scene", "lesions", "method", "AUC, artefacts varying", "Δ, varying", "AUC, artefacts known", "Δ, known"]
    bases, rows = _bases(listed), []
    for one in listed:
        for group in ("near", "far"):
            base = bases.get(one.scene)
            varying = _Measure(observer=varying_background, group=group, shape="slice", less_anatomy=True)
            known = _Measure(observer=known_background, group=group, shape="slice")
            rows.append([one.scene, group, one.method, *varying.cells(one, base), *known.cells(one, base)])
    caption = "The same observer with channels in the axial slice through the lesion's centre."
    return simple(titles, rows, numbers=titles[3:], title="In the central slice", caption=caption)


def _places(listed: Sequence[Series]) -> Table:
    titles = ["scene", "x, y, z (mm)", "lesion", "mm to metal", "method", "AUC", "AUC, normal theory", "recovered"]
    rows = []
    for one in (s for s in listed if len(s.found) >= LEAST):
        for k, site in enumerate(one.sites):
            found = one.responses(None).at(np.array([k]))
            value, low, high = normal_theory(found.present[:, 0], found.absent[:, 0])
            rows.append([
                one.scene, ", ".join(f"{c:g}" for c in site.at), site.group, f"{site.distance_mm:.1f}", one.method,
                _interval(known_background(found)), f"{value:.3f} [{low:.3f}, {high:.3f}]",
                f"{one.recovered([k]):z.2f}" if site.group != "none" else "–",
            ])  # fmt: skip
    caption = (
        "With artefacts known. Normal theory is the exact interval for normal responses, for an observer trained on "
        "infinitely many scans: it is a little above the observer that was trained on these."
    )
    return simple(titles, rows, numbers=titles[5:], title="Each location", caption=caption)
