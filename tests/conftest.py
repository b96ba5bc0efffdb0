import os
from collections.abc import Iterator
from pathlib import Path

import pytest

os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that wait leave their core to the other worker's


def pytest_configure(config: pytest.Config) -> None:
    """Share the cores among the workers: threads that wait for one another lose most of them to other processes."""
    if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
        import numba

        numba.set_num_threads(max(1, numba.config.NUMBA_NUM_THREADS // workers))  # pyright: ignore[reportAttributeAccessIssue]


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    """Threads of the kernels: no bit may depend on their number, so that both are compared with one reference."""
    import numba

    if request.param > numba.config.NUMBA_NUM_THREADS:  # pyright: ignore[reportAttributeAccessIssue]
        pytest.skip("one core")
    before = numba.get_num_threads()
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


LONGEST = (
    "contracts",
    "faults",
    "stress",
    "workers",
    "reports",
    "skipping",
    "validate",
    "cli",
    "detect",
    "field",
    "run",
)
"""Files of tests that take longest, which begin first: one that begins last keeps a core waiting."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; the order within a file stays."""
    places = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


SMALLEST = """
name = "smallest"
seed = 5

[phantom]
recipe = "validation"
metal = "Al"
n_voxel = [16, 16, 16]

[scanner]
n_voxel = [10, 12, 12]
n_detector = [16, 18]
n_views = 12
"""


@pytest.fixture(scope="session")
def smallest(tmp_path_factory) -> Path:
    """A dataset of one scene, rods in water, as make-dataset writes it; not to be changed."""
    from ctsim.benchmarks.make_dataset import main

    folder = tmp_path_factory.mktemp("smallest")
    (folder / "scene.toml").write_text(SMALLEST, encoding="utf-8")
    assert main([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return folder / "data"
