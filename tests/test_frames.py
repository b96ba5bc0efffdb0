"""Which way a body faces in the frame that its exported volume states: the table of conventions.md, Patients."""

from collections.abc import Callable
from functools import cache

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from ct_files import stored, write
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.benchmarks.export import work as export
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.io.volumes import dicomwrite, metaimage, nifti
from ctsim.io.volumes.placed import Placed
from ctsim.phantoms.bodies.hip import Hip
from ctsim.phantoms.bodies.jaw import Jaw
from ctsim.phantoms.bodies.lung import Lung
from ctsim.phantoms.bodies.spine import Spine
from ctsim.phantoms.bodies.teeth import Teeth
from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.recipes import build_recipe
from ctsim.types import Phantom

N = 64
WRITERS = {"body.nii.gz": nifti, "body.mha": metaimage, "body": dicomwrite}
WORDS = (("right", "left"), ("front", "back"), ("feet", "head"))
"""Where x, y and z of LPS fall and rise to."""
EXCHANGED = {"front": "back", "back": "front"}
Point = NDArray[np.float64]


class Body:
    """One individual: places in mm (x, y, z) of tissues, gas and inserts."""

    def __init__(self, phantom: Phantom) -> None:
        """Take the axes of its grid, in half edges."""
        self.phantom = phantom
        side = (np.arange(N) + 0.5 - N / 2) / (N / 2)
        self.z, self.y, self.x = np.meshgrid(side, side, side, indexing="ij")
        air, _ = ndimage.label(np.pad(phantom.labels == 0, 1, constant_values=True))
        self.gas = (phantom.labels == 0) & (air != air[0, 0, 0])[1:-1, 1:-1, 1:-1]

    def of(self, *names: str) -> NDArray[np.bool_]:
        return np.isin(self.phantom.labels, [self.phantom.materials.index(name) for name in names])

    def middle(self, mask: NDArray[np.bool_]) -> Point:
        assert mask.any()
        return np.array([axis[mask].mean() for axis in (self.x, self.y, self.z)]) * N / 2 * self.phantom.d_voxel[0]

    def insert(self, name: str) -> Point:
        (solid,) = (s for s in self.phantom.solids if s.name == name)
        return np.mean([p.centre for p in solid.primitives], axis=0)

    def vessels(self) -> list[Point]:
        """Middles of the abdomen's great vessels, the thinner one first."""
        index, _ = ndimage.label(self.of("blood") & (np.abs(self.z) < 0.1))
        sizes = np.bincount(index.ravel())[1:]
        assert len(sizes) == 2
        return [self.middle(index == k + 1) for k in np.argsort(sizes)]


@cache
def drawn(kind: type[Recipe]) -> Body:
    return Body(build_recipe(kind(n_voxel=(N, N, N)), 1))


def low_spine(b: Body) -> Point:
    """Bone in the midline below the breastbone's end."""
    return b.middle(b.of("cortical_bone") & (np.abs(b.x) < 0.12) & (b.z < -0.5))


def sacrum_and_pubis(b: Body) -> Point:
    return b.middle(b.of("cortical_bone") & (np.abs(b.x) < 0.1))


Place = Callable[[Body], Point]
LANDMARKS: dict[str, tuple[type[Recipe], Place, str, Place]] = {  # the first lies to this side of the second
    "lung: spine": (Lung, low_spine, "back", lambda b: b.middle(b.of("lung"))),
    "lung: stomach": (Lung, lambda b: b.middle(b.gas & (b.z < -0.6)), "left", lambda b: b.middle(b.of("lung"))),
    "lung: stomach, too": (Lung, lambda b: b.middle(b.gas & (b.z < -0.6)), "feet", lambda b: b.middle(b.of("lung"))),
    "teeth: incisors": (
        Teeth,
        lambda b: b.middle(b.of("enamel") & (np.abs(b.x) < 0.15)),
        "front",
        lambda b: b.middle(b.of("enamel")),
    ),
    "teeth: nose": (Teeth, lambda b: b.middle(b.gas & (np.abs(b.z) > 0.5)), "head", lambda b: b.middle(b.of("enamel"))),
    "jaw: great vessels": (
        Jaw,
        lambda b: b.middle(b.of("blood") & (np.abs(b.x) < 0.42) & (np.abs(b.z) < 0.1)),
        "back",
        lambda b: b.middle(b.of("enamel")),
    ),
    "jaw: tongue": (
        Jaw,
        lambda b: b.middle(b.of("muscle") & (np.abs(b.x) < 0.15) & (np.abs(b.y) < 0.2) & (np.abs(b.z) < 0.35)),
        "feet",
        lambda b: b.middle(b.of("enamel")),
    ),
    "hip: bladder": (Hip, lambda b: b.middle(b.of("urine")), "front", sacrum_and_pubis),
    "hip: left joint": (Hip, lambda b: b.insert("head-left"), "left", lambda b: b.insert("head-right")),
    "hip: stem": (Hip, lambda b: b.insert("tip-left"), "feet", lambda b: b.insert("cup-left")),
    "spine: vessels": (
        Spine,
        lambda b: np.mean(b.vessels(), axis=0),
        "front",
        lambda b: b.middle(b.of("spongiosa") & (np.abs(b.x) < 0.1)),
    ),
    "spine: aorta": (Spine, lambda b: b.vessels()[0], "left", lambda b: b.vessels()[1]),
    "spine: left kidney": (
        Spine,
        lambda b: b.middle(b.of("kidney") & (b.x > 0)),
        "head",
        lambda b: b.middle(b.of("kidney") & (b.x < 0)),
    ),
    "spine: left screw": (Spine, lambda b: b.insert("screwleft+0"), "left", lambda b: b.insert("screwright+0")),
}
EACH = pytest.mark.parametrize("name", LANDMARKS)


def side(first: Point, second: Point, word: str) -> str:
    """Say in `word`'s direction to which side of `second` the first point lies; both in LPS."""
    (axis,) = (k for k, pair in enumerate(WORDS) if word in pair)
    assert abs(first[axis] - second[axis]) > 1.0  # mm: more than a voxel
    return WORDS[axis][int(first[axis] > second[axis])]


def with_itk(path):
    if not path.is_dir():
        return sitk.ReadImage(str(path))
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(path)))
    return reader.Execute()


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Write each drawn body's labels in a format, once; return the file."""
    folder = tmp_path_factory.mktemp("exported")

    @cache
    def one(kind: type[Recipe], name: str):
        path = folder / kind.__name__ / name
        path.parent.mkdir(exist_ok=True)
        phantom = drawn(kind).phantom
        values = phantom.labels.astype(np.int16)
        WRITERS[name].write_volume(path, Placed(values=values, spacing=phantom.d_voxel, centre=(0.0, 0.0, 0.0)))
        return path

    return one


@EACH
@pytest.mark.parametrize("file", WRITERS)
def test_a_viewer_calls_the_front_of_a_drawn_body_its_back(name, file, exported):
    """One of three directions is exchanged: what is shown is a mirror image, and no turn makes a patient of it."""
    kind, first, word, second = LANDMARKS[name]
    body, image = drawn(kind), with_itk(exported(kind, file))
    assert np.array_equal(sitk.GetArrayFromImage(image), body.phantom.labels)
    d = body.phantom.d_voxel[0]
    places = [
        np.array(image.TransformContinuousIndexToPhysicalPoint((p / d + (N - 1) / 2).tolist()))
        for p in (first(body), second(body))
    ]
    assert side(*places, word) == EXCHANGED.get(word, word)


@EACH
def test_the_second_row_of_the_affine_turned_over_makes_a_patient_of_it(name, exported):
    kind, first, word, second = LANDMARKS[name]
    body, image = drawn(kind), nibabel.load(exported(kind, "body.nii.gz"))
    affine = np.diag([1, -1, 1, 1]) @ image.affine
    index = [p / body.phantom.d_voxel[0] + (N - 1) / 2 for p in (first(body), second(body))]
    ras = [affine[:3, :3] @ k + affine[:3, 3] for k in index]
    assert side(*(p * [-1, -1, 1] for p in ras), word) == word


def marked(image: sitk.Image, least: float) -> tuple[Point, Point]:
    """Middle of the voxels from `least` on, and of the whole array, in the frame that the file states."""
    found = np.argwhere(sitk.GetArrayFromImage(image) >= least)[:, ::-1].mean(0)
    whole = (np.array(image.GetSize()) - 1) / 2
    bone, middle = (np.array(image.TransformContinuousIndexToPhysicalPoint(at.tolist())) for at in (found, whole))
    return bone, middle


@pytest.mark.parametrize(
    ("kind", "flips"), [(".nii.gz", (True, False, True)), ("dicom", (True, True, True)), (".mha", (False, True, True))]
)
def test_a_ct_that_is_read_scanned_and_exported_keeps_its_corner(tmp_path, kind, flips):
    """Bone at the patient's left, in front, near the head, in a file whose axes run to other sides."""
    hu = np.full((12, 16, 20), 40, np.int16)  # z, y, x of LPS, in voxels of 2 mm
    hu[9:11, 1:4, 15:18] = 900
    hu[:, -1] = -1000  # air, which every CT has
    source = write(tmp_path, kind, *stored(hu, (0, 1, 2), flips, (2.0, 2.0, 2.0), np.eye(3)[::-1]))
    bone, middle = marked(with_itk(source), 900)
    placed = bone - middle
    assert placed == pytest.approx((13.0, -11.0, 8.0))
    (tmp_path / "scene.toml").write_text(
        f"""
name = "ct"
phantom = {{ recipe = "ct_volume", path = "{source}", metal = "none", size = 60.0, n_voxel = [60, 60, 60] }}
scanner = {{ n_voxel = [30, 30, 30], n_detector = [8, 8], n_views = 2 }}
"""
    )
    assert make_dataset([str(tmp_path / "scene.toml"), str(tmp_path / "data")]) == 0
    for name, to in (("out.nii.gz", "nifti"), ("out.mha", "mha"), ("out", "dicom")):
        export.main([str(tmp_path / "data/ct"), str(tmp_path / name), "--to", to, "--hu"])
        image = with_itk(tmp_path / name)
        found, _ = marked(image, 500)  # HU, between soft tissue and this bone
        # the marked voxels are whole ones: their middle errs by half a voxel at most
        assert np.abs(found - placed).max() <= image.GetSpacing()[0] / 2
