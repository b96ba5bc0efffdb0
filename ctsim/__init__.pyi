from ctsim.api import find_scene as find_scene
from ctsim.api import new_scene as new_scene
from ctsim.api import reconstruct_scan as reconstruct_scan
from ctsim.api import score_volume as score_volume
from ctsim.dataset.store import list_scans as list_scans
from ctsim.dataset.store import open_scan as open_scan
from ctsim.errors import InputError as InputError
from ctsim.geometry import Geometry as Geometry
from ctsim.phantoms.dataset import simulate_scene as simulate_scene
from ctsim.phantoms.scene import Scene as Scene
from ctsim.reports.plots import plot_geometry as plot_geometry
from ctsim.reports.plots import plot_projections as plot_projections
from ctsim.types import Scan as Scan
from ctsim.types import Volume as Volume

__version__: str
_MODULES: dict[str, str]
