"""What LIMAR and NMAR attach to their volumes is what they worked with."""

import numpy as np
import pytest

from ctsim.benchmarks import methods
from ctsim.benchmarks.studies.methods import attempt
from ctsim.benchmarks.studies.methods.volumes import attached
from ctsim.dataset.store import list_scans, open_scan
from ctsim.reconstruct.log import line_integrals


@pytest.mark.parametrize("name", ["limar", "nmar"])
def test_the_bridged_view_is_the_measured_one_but_for_the_trace(smallest, name):
    stored = open_scan(list_scans(smallest)[0])
    method = methods.find(name)
    found = attempt.attempt(method, attempt.scan_for(method, stored, "metal"), 0.0).intermediates
    assert found.keys() == ({"view", "trace", "projection"} | ({"prior"} if name == "nmar" else set()))
    trace, bridged = found["trace"], found["projection"]
    measured = line_integrals(stored.scan, int(found["view"]))[0].numpy()
    assert trace.any() and (bridged[~trace] == measured[~trace]).all()
    assert bridged[trace].mean() < measured[trace].mean()  # the metal is gone
    if name == "nmar":
        metal, prior = np.asarray(stored.metal) > 0, found["prior"]
        assert len(np.unique(prior[metal])) == 1 and 0 < prior[metal][0] < 0.1  # water in place of the metal


def test_without_metal_nothing_is_attached(smallest):
    stored = open_scan(list_scans(smallest)[0])
    method = methods.find("nmar")
    outcome = attempt.attempt(method, attempt.scan_for(method, stored, "metal_free"), 0.0)
    assert outcome.status == "ok" and outcome.intermediates == {}
    assert attached({}, stored.geometry) == {}
