import numpy as np
import pytest

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.scores.judge import Judge
from ctsim.benchmarks.scores.score import COLUMNS, PROTOCOLS
from ctsim.benchmarks.tools import sensitivity
from ctsim.benchmarks.tools.sensitivity import (
    DERIVED,
    EXEMPT,
    FAULTS,
    FOR,
    NONE,
    SHOWN,
    Scene,
    measure,
    page,
    sees,
    table,
)
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError

SCENE = """
name = "thorax"
seed = 2

[phantom]
recipe = "lung"
metal = "Fe"
n_voxel = [79, 79, 79]

[scanner]
n_voxel = [64, 64, 64]
n_detector = [64, 64]
n_views = 12
"""


@pytest.fixture(scope="module")
def judge(tmp_path_factory):
    folder = tmp_path_factory.mktemp("thorax")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    assert make_dataset.main([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return Judge.of(open_scan(list_scans(folder / "data")[0]))


def test_each_column_of_the_results_has_a_fault_that_it_is_for_or_a_reason():
    columns = {(protocol, metric) for protocol in PROTOCOLS for metric in COLUMNS[protocol]}
    seen = {place for places in FOR.values() for place in places}
    assert seen | set(EXEMPT) == columns and not seen & set(EXEMPT) and set(SHOWN) == seen
    assert {protocol for protocol in COLUMNS if protocol not in PROTOCOLS} == set(DERIVED)


@pytest.mark.slow
def test_each_score_sees_the_fault_it_is_for(judge):
    found, spread = measure(judge)
    assert set(found) == set(FAULTS) and set(FOR) == set(FAULTS) - {NONE} and set(spread) <= set(SHOWN)
    blind = [
        (fault, place, found[NONE][place], found[fault].get(place))
        for fault, places in FOR.items()
        for place in places
        if place not in found[fault] or not sees(place, found[NONE][place], found[fault][place], spread[place])
    ]
    assert not blind
    text = table(found, spread).markdown()
    assert text.count("\n") >= len(spread) and "▲ ✓" in text


@pytest.mark.slow
def test_each_fault_is_painted(judge):
    scene = Scene.of(judge)
    for name, fault in FAULTS.items():
        changed = ~np.isclose(fault(scene), scene.hu)
        assert changed.any() == (name != NONE), name
    assert 0 < scene.bar.sum() < scene.between.sum()
    upper, lower = scene.soft.pair
    alike = FAULTS["fat as muscle"](scene)
    assert alike[scene.soft.classes[lower]].mean() == pytest.approx(scene.hu[scene.soft.classes[upper]].mean())


def test_seeing_is_worse_by_more_than_the_noise():
    assert sees(("tissue", "psnr3d"), 30.0, 28.0, 0.1) and not sees(("tissue", "psnr3d"), 30.0, 32.0, 0.1)
    assert not sees(("tissue", "psnr3d"), 30.0, 29.6, 0.1)  # four deviations
    assert sees(("soft", "rmse"), 20.0, 22.0, 0.1) and not sees(("soft", "rmse"), 20.0, 18.0, 0.1)
    assert sees(("metal", "core_ratio"), 1.0, 0.7, 0.0) and not sees(("metal", "core_ratio"), 0.7, 1.0, 0.0)
    assert sees(("aligned", "gain"), 1.0, 0.98, 0.001) and not sees(("metal", "dice"), 1.0, 0.9997, 0.0)


def test_a_scan_without_soft_tissue_is_refused(smallest, capsys):
    with pytest.raises(InputError, match="expected a scan with"):
        page("smallest", Judge.of(open_scan(list_scans(smallest)[0])))
    with pytest.raises(InputError, match="expected SCAN"):
        sensitivity.main([])
