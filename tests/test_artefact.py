import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.spatial import KDTree

from ctsim.benchmarks.scores import artefact, metrics
from ctsim.benchmarks.scores.artefact import Layout, artefact_score, cupping_index, homogeneous, metal_lines, near_metal
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import COLUMNS
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError

SHAPE, D = (30, 36, 48), (1.5, 1.0, 0.5)
WATER = 0.02
MIDDLE = (15, 18)


def bodies(centres=((15, 18, 12), (15, 18, 36))):
    """A box of water with an ellipsoid of another tissue, and cubes of metal of 3 voxels at `centres`."""
    labels = np.zeros(SHAPE, np.uint8)
    labels[3:27, 3:33, 3:45] = 1
    z, y, x = np.ogrid[tuple(slice(n) for n in SHAPE)]
    labels[((z - 15) / 7) ** 2 + ((y - 26) / 6) ** 2 + ((x - 24) / 12) ** 2 <= 1] = 2
    metal = np.zeros(SHAPE, bool)
    for centre in centres:
        metal[tuple(slice(c - 1, c + 2) for c in centre)] = True
    labels[metal] = 3
    return labels, metal


def truth_of(labels, metal):
    body, near = labels > 0, metrics.dilate(metal, 2)
    judged = metrics.dilate(body, 4)
    return Truth(
        references={}, metal=metal, body=body, tissue=judged & ~near, judged=judged, near_metal=near, d_voxel=D, l0=1.0
    )


def scene(centres=((15, 18, 12), (15, 18, 36)), water: float | None = WATER):
    labels, metal = bodies(centres)
    truth = truth_of(labels, metal)
    rois, _ = homogeneous(labels, truth, ["air", "water", "fat", "Ti"])
    lines, n_pairs, _ = metal_lines(truth)
    near = near_metal(truth)
    layout = Layout(
        water=water, rois=rois, lines=lines, n_pairs=n_pairs, near=near, far=truth.tissue & ~near, note="chosen"
    )
    return truth, layout


def scored(difference, *, twin=None, centres=((15, 18, 12), (15, 18, 36))):
    truth, layout = scene(centres)
    twin = np.full(SHAPE, WATER) if twin is None else twin
    return artefact_score(twin + difference, twin, layout, truth).values


def test_a_shift_is_the_same_everywhere():
    # 0.1 of water is 100 HU; in float64 all that is left is rounding
    values = scored(np.full(SHAPE, 0.1 * WATER))
    assert values["rmse_near"] == pytest.approx(100, rel=1e-9)
    assert values["rmse_far"] == pytest.approx(100, rel=1e-9)
    assert values["streak"] == pytest.approx(100, rel=1e-9)
    assert values["roi_std"] == pytest.approx(0, abs=1e-9)
    assert values["cupping"] == pytest.approx(0, abs=1e-9)


def test_the_rmse_is_that_of_near_and_far_together():
    truth, layout = scene()
    values = scored(np.where(layout.near, 0.3 * WATER, -0.1 * WATER))
    near = layout.near.sum() / truth.tissue.sum()
    assert 0 < near < 1 and (values["rmse_near"], values["rmse_far"]) == pytest.approx((300, 100), rel=1e-9)
    assert values["rmse"] == pytest.approx(math.sqrt(near * 300**2 + (1 - near) * 100**2), rel=1e-9)


def test_a_bar_between_two_pieces_is_a_streak():
    bar = np.zeros(SHAPE)
    bar[15, 18, :] = -0.05 * WATER
    values = scored(bar)
    assert values["streak"] == pytest.approx(50, rel=1e-9)  # 50 HU too dark
    # of the bar, n voxels are near and as many of all near ones share 50 HU
    _, layout = scene()
    share = layout.near[15, 18].sum() / layout.near.sum()
    assert values["rmse_near"] == pytest.approx(50 * math.sqrt(share), rel=1e-9)
    beside = np.roll(bar, 2, 1)
    assert scored(beside)["streak"] == pytest.approx(0, abs=1e-12)


def test_a_slanted_line_follows_a_ramp():
    centres = ((8, 10, 10), (20, 26, 38))
    z, y, x = np.indices(SHAPE)
    ramp = 1e-4 * z + 2e-4 * y - 5e-5 * x
    truth, _ = scene(centres)
    (line,) = metal_lines(truth)[0]
    # symmetric about the middle, where linear interpolation of a ramp is exact
    assert np.allclose(line.mean(0), (14, 18, 24), atol=1e-12)
    assert np.linalg.norm(np.diff(line, axis=0) * D, axis=1).min() <= min(D) / 2
    expected = 1000 / WATER * (1e-4 * 14 + 2e-4 * 18 - 5e-5 * 24)
    assert scored(ramp, centres=centres)["streak"] == pytest.approx(expected, rel=1e-9)


def test_every_pair_has_a_line_unless_it_is_too_close():
    three = ((15, 8, 12), (15, 28, 12), (8, 18, 36))
    lines, pairs, cut = metal_lines(scene(three)[0])
    assert (len(lines), pairs, cut) == (3, 3, "")
    lines, pairs, _ = metal_lines(scene(((15, 18, 12), (15, 18, 17)))[0])
    assert (len(lines), pairs) == (0, 1)
    truth, layout = scene(((15, 18, 12),))
    assert (layout.lines, layout.n_pairs) == ((), 0)
    assert artefact_score(np.ones(SHAPE), np.zeros(SHAPE), layout, truth).values["streak"] is None


def test_no_sample_of_a_line_touches_the_metal():
    truth, layout = scene(((8, 10, 10), (20, 26, 38), (8, 26, 24)))
    for line, corner in itertools.product(layout.lines, itertools.product((0, 1), repeat=3)):
        at = np.minimum(np.floor(line).astype(int) + corner, np.array(SHAPE) - 1)
        assert not truth.metal[tuple(at.T)].any()


def test_many_pieces_are_cut_to_the_largest():
    metal = np.zeros(SHAPE, bool)
    metal[4:28:5, 4:34:5, 4:46:8] = True
    metal[4:6, 4, 4] = True
    _, pairs, cut = metal_lines(truth_of(np.ones(SHAPE, np.uint8), metal))
    n = len(range(4, 28, 5)) * len(range(4, 34, 5)) * len(range(4, 46, 8))
    assert n > artefact.MAX_PIECES and cut == f", the 32 largest of {n}"
    assert pairs == 32 * 31 // 2


def test_streaks_of_several_pairs_are_taken_together():
    centres = ((15, 8, 12), (15, 28, 12), (8, 18, 40))
    rng = np.random.default_rng(0)
    difference = 1e-3 * rng.standard_normal(SHAPE)
    _, layout = scene(centres)
    means = []
    for line in layout.lines:
        total = 0.0
        for p in line:  # trilinear by hand
            low = np.floor(p).astype(int)
            for corner in itertools.product((0, 1), repeat=3):
                at = low + corner
                weight = np.prod(1 - np.abs(p - at))
                total += weight * difference[tuple(at)] if weight > 0 else 0.0
        means.append(1000 / WATER * total / len(line))
    expected = math.sqrt(np.mean(np.square(means)))
    assert scored(difference, centres=centres)["streak"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("scale, reach", [(0.5, 5.0), (1.0, 9.0)])  # voxels of up to 0.75 and 1.5 mm
def test_near_is_within_five_mm_or_six_voxels_of_a_metal_voxel(scale, reach):
    truth, layout = scene(((15, 18, 12), (20, 9, 36)))
    size = tuple(scale * d for d in D)
    metal = KDTree(np.argwhere(truth.metal) * size)
    distance = metal.query(np.argwhere(truth.tissue) * size)[0]
    found = near_metal(dataclasses.replace(truth, d_voxel=size))[truth.tissue]
    # exactly this distance counts as near; distances here are multiples that float64 has to 1e-15
    np.testing.assert_array_equal(found, distance <= reach + 1e-9)
    assert ((distance > reach - 1e-9) & (distance < reach + 1e-9)).any()
    assert not (layout.near & layout.far).any()
    np.testing.assert_array_equal(layout.near | layout.far, truth.tissue)


def test_near_at_the_volumes_edge():
    metal = np.zeros(SHAPE, bool)
    metal[:2, :3, -2:] = True
    truth = truth_of(np.ones(SHAPE, np.uint8), metal)
    distance = KDTree(np.argwhere(metal) * D).query(np.argwhere(truth.tissue) * D)[0]
    np.testing.assert_array_equal(near_metal(truth)[truth.tissue], distance <= 6 * 1.5 + 1e-9)


def test_rois_are_homogeneous_and_declared():
    labels, metal = bodies()
    truth = truth_of(labels, metal)
    rois, small = homogeneous(labels, truth, ["air", "water", "fat", "Ti"])
    assert [r.material for r in rois] == ["water", "fat"] and small == []
    for k, roi in enumerate(rois, 1):
        at = np.array(np.unravel_index(roi.voxels, SHAPE)).T
        for shift in itertools.product((-2, 0, 2), repeat=3):
            assert (labels[tuple((at + shift).T)] == k).all()
        distance = np.abs(np.argwhere(metal)[None] - at[:: max(1, len(at) // 200), None]).max(-1).min(1)
        assert (distance > 2).all()
    # the ellipsoid's centre, (x, y, z) in mm from the volume's centre
    z, y, x = ((c - (n - 1) / 2) * d for c, n, d in zip((15, 26, 24), SHAPE, D, strict=True))
    assert rois[1].middle == pytest.approx((x, y, z), abs=0.1)


def test_a_material_too_small_for_a_roi_is_named():
    labels, metal = bodies()
    labels[labels == 2] = 1
    labels[20:24, 24:28, 20:24] = 2
    rois, small = homogeneous(labels, truth_of(labels, metal), [])
    assert [r.material for r in rois] == ["label 1"] and small == ["label 2"]


def test_metal_that_has_no_label_is_kept_away_from_too():
    labels, metal = bodies()
    labels[labels > 0] = 1
    (roi,), _ = homogeneous(labels, truth_of(labels, metal), [])
    at = np.array(np.unravel_index(roi.voxels, SHAPE)).T
    assert KDTree(np.argwhere(metal)).query(at, p=math.inf)[0].min() == 3


def test_pieces_that_touch_at_a_corner_are_one():
    metal = np.zeros(SHAPE, bool)
    metal[10:12, 10:12, 10:12] = metal[12:14, 12:14, 12:14] = True
    assert metal_lines(truth_of(np.ones(SHAPE, np.uint8), metal))[1] == 0
    metal[10:12, 10:12, 10:12] = False
    metal[9:11, 10:12, 10:12] = True
    assert metal_lines(truth_of(np.ones(SHAPE, np.uint8), metal))[1] == 1


def test_a_roi_is_one_piece():
    labels, metal = bodies()
    labels[labels == 2] = 1
    labels[15] = 0  # the metal goes with the slice, and the water falls into two
    labels[metal] = 3
    (roi,), _ = homogeneous(labels, truth_of(labels, metal), [])
    z = np.unravel_index(roi.voxels, SHAPE)[0]
    assert z.min() > 15 or z.max() < 15


def test_the_std_of_a_checkerboard():
    parity = np.indices(SHAPE).sum(0) % 2
    values = scored(np.where(parity, 1, -1) * 0.01 * WATER)
    _, layout = scene()
    stds = []
    for roi in layout.rois:
        mean = 2 * parity.ravel()[roi.voxels].mean() - 1  # ±1 with unequal shares: std² = 1 − mean²
        stds.append(10 * math.sqrt(1 - mean**2))
        assert values[f"roi_std:{roi.material}"] == pytest.approx(stds[-1], rel=1e-9)
    assert values["roi_std"] == pytest.approx(math.sqrt(np.mean(np.square(stds))), rel=1e-9)


def test_the_twins_own_texture_does_not_count():
    twin = WATER * (1 + 0.3 * np.random.default_rng(1).standard_normal(SHAPE))
    values = scored(np.zeros(SHAPE), twin=twin)
    assert [values[m] for m in COLUMNS["artefact"]] == [0.0] * 6


def test_thirds_are_by_distance_to_the_rois_outside():
    _, layout = scene()
    for roi in layout.rois:
        inside = np.zeros(SHAPE, bool)
        inside.ravel()[roi.voxels] = True
        depth = KDTree(np.argwhere(~inside) * D).query(np.argwhere(inside) * D)[0]
        order = np.sort(depth)
        low, high = (np.quantile(order, q) for q in (1 / 3, 2 / 3))
        np.testing.assert_array_equal(roi.edge, roi.voxels[depth <= low + 1e-9])
        np.testing.assert_array_equal(roi.centre, roi.voxels[depth >= high - 1e-9])
        assert roi.edge.size >= roi.voxels.size / 3 - 1 and np.intersect1d(roi.edge, roi.centre).size == 0


def test_a_known_cup():
    _, layout = scene()
    roi = layout.rois[1]
    cup, twin = np.full(SHAPE, WATER), np.full(SHAPE, WATER)
    cup.ravel()[roi.centre] *= 0.9  # centre a tenth below the edge: index 10 %
    twin.ravel()[roi.centre] *= 0.98  # and 2 % of its own
    assert cupping_index(cup, roi) == pytest.approx(10, rel=1e-9)
    values = scored(cup - twin, twin=twin)
    assert values[f"cupping:{roi.material}"] == pytest.approx(8, rel=1e-9)
    assert values["cupping:water"] == pytest.approx(0, abs=1e-9)
    assert values["cupping"] == pytest.approx(8 / math.sqrt(2), rel=1e-9)
    assert cupping_index(np.zeros(SHAPE), roi) is None
    assert cupping_index(cup, dataclasses.replace(roi, edge=roi.edge[:0])) is None


def test_without_a_twin_or_water_there_are_no_numbers():
    truth, layout = scene()
    volume = np.ones(SHAPE, np.float32)
    for score in (
        artefact_score(volume, None, layout, truth, "gone"),
        artefact_score(volume, volume, scene(water=None)[1], truth),
    ):
        assert score.values == dict.fromkeys(COLUMNS["artefact"])
    assert artefact_score(volume, None, layout, truth, "gone").note == "gone"
    with pytest.raises(InputError, match="twin"):
        artefact_score(volume, volume[1:], layout, truth)


def test_water_is_that_of_the_effective_reference(smallest):
    stored = open_scan(list_scans(smallest)[0])
    reference = stored.metal_free.reference("effective")
    # rods in water: without them the voxels inside the cylinder are all water. spectrum.csv keeps energies
    # to 5e-5 keV: μ ∝ E^-3 moves by 3·5e-5/10 at worst; float32 references round to 6e-8
    assert artefact.effective_attenuation(stored) == pytest.approx(float(reference.max()), rel=2e-5)


def test_a_layout_of_stored_files_declares_itself(smallest):
    stored = open_scan(list_scans(smallest)[0])
    from ctsim.benchmarks.scores.protocol import truth_of as stored_truth

    note = artefact.layout_of(stored, stored_truth(stored)).note
    # voxels of 5 and 6 mm: nothing is left for a ROI
    for words in ("no ROI in water", "of 1 pairs", "water 0.0"):
        assert words in note


def test_a_damaged_spectrum_is_named(smallest, tmp_path):
    stored = dataclasses.replace(open_scan(list_scans(smallest)[0]), folder=tmp_path)
    assert artefact.effective_attenuation(stored) is None
    for text in ("energy_kev,signal_fraction\n", "a,b\n1,2\n", "energy_kev,signal_fraction\n1,x\n"):
        (tmp_path / "spectrum.csv").write_text(text)
        with pytest.raises(InputError, match=r"spectrum\.csv"):
            artefact.effective_attenuation(stored)
