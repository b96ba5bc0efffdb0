"""Learned rows: what the networks see, that they are what their equations say, and that weights are what they claim."""

import dataclasses
import hashlib
import json
import pickle
from importlib import resources
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from ctsim import new_scene, reconstruct_scan, score_volume, simulate_scene
from ctsim.baselines import limar, nmar
from ctsim.baselines.learned import data as data_module
from ctsim.baselines.learned import dictionary, fusion, methods, training
from ctsim.baselines.learned.inputs import blind, told
from ctsim.baselines.learned.weights import SHIPPED, Card, trained
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.methods import TABLE, TRAINED, TRAINED_MASK, find
from ctsim.benchmarks.suites import load as load_suite
from ctsim.benchmarks.tools import score_learned, train_learned
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import reconstruct as fdk

ALL = fusion.SIZES | dictionary.SIZES
WEIGHTS = Path(str(resources.files("ctsim.baselines.learned"))) / "weights"
MANY = """
[[scene]]
name = "tiny"
count = 5
seed = 3
split = { train = 0.5, val = 0.25, test = 0.25 }
phantom = { recipe = "random", metal = "Fe", n_voxel = [24, 24, 24], n_inserts = 2, insert_mm = 8.0 }
scanner = { n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 20 }
"""


def simulated(metal, seed):
    phantom = {"recipe": "random", "metal": metal, "n_voxel": [56, 56, 56], "n_inserts": 3, "insert_mm": 6.0}
    scanner = {"n_voxel": [32, 32, 32], "n_detector": [48, 48], "n_views": 60}
    return simulate_scene(new_scene(name=f"{metal}-{seed}", seed=seed, phantom=phantom, scanner=scanner))


@pytest.fixture(scope="module")
def iron():
    return simulated("Fe", 2001)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A dataset of five scans in three splits."""
    folder = tmp_path_factory.mktemp("many")
    (folder / "many.toml").write_text(MANY, encoding="utf-8")
    assert make_dataset([str(folder / "many.toml"), str(folder / "data")]) == 0
    return folder / "data"


def with_mask(stored):
    return dataclasses.replace(stored.scan, metal=torch.from_numpy(np.asarray(stored.metal) > 0))


def psnr(volume, stored):
    return score_volume(volume, stored, protocols="tissue")["tissue"].values["psnr3d"]


# --- the shipped weights -----------------------------------------------------------------------------------

SCORES = {
    "fusion": (34.547, 28.006),
    "denoise": (34.188, 27.888),
    "denoise-lite": (34.442, 26.484),
    "dicdnet-lite": (34.832, 26.484),
    "acdnet-lite": (34.246, 25.78),
    "oscnet-lite": (35.136, 26.616),
}
"""PSNR3D under `tissue` of two scenes, in iron and in titanium, dB."""


def test_the_shipped_weights_have_the_scores_that_they_had(iron):
    for stored, at in ((iron, 0), (simulated("Ti", 2002), 1)):
        plain = psnr(reconstruct_scan(stored, "fdk"), stored)
        for name, scores in SCORES.items():
            found = psnr(reconstruct_scan(stored, name), stored)
            # float32 sums in another order move a volume by 1e-6 of it
            assert found == pytest.approx(scores[at], abs=0.02), (name, stored.name, found)
            assert found > plain + 1


def test_weights_say_what_they_are():
    assert SHIPPED.keys() == SCORES.keys() == {n for n, (_, kind) in TABLE.items() if kind in (TRAINED, TRAINED_MASK)}
    for name in SHIPPED:
        net, card = trained(name, "shipped")
        n = sum(parameter.numel() for parameter in net.parameters())
        assert n <= 40_000 if name in fusion.SIZES else 100_000 <= n <= 200_000
        assert (WEIGHTS / f"{name}.safetensors").stat().st_size < 1e6
        assert card.architecture == ALL[name] and card.data.suite == "train"
        assert card.training.curve[-1][2] < card.training.curve[0][2]
        assert card.training.steps == card.training.curve[-1][0]
    assert {file.stem for file in WEIGHTS.iterdir()} == set(SHIPPED)


@pytest.mark.parametrize(
    ("name", "ablation", "inputs"),
    [("fusion", "denoise", {"sources", "metal"}), ("dicdnet-lite", "denoise-lite", {"metal"})],
)
def test_an_ablation_differs_in_its_inputs_alone(name, ablation, inputs):
    told_all, alone = ALL[name], ALL[ablation]
    assert {key for key in alone if told_all.get(key) != alone[key]} == inputs
    full, part = (trained(row, "shipped")[1].training for row in (name, ablation))
    keys = ("batch", "rate", "seed")
    assert [getattr(full, key) for key in keys] == [getattr(part, key) for key in keys]
    # those of slices had as many seconds
    assert full.steps == part.steps or full.seconds == pytest.approx(part.seconds, rel=0.05)
    assert find(ablation).inputs == TRAINED and find(ablation).mask == "none"
    assert find(name).inputs == TRAINED_MASK and find(name, {"mask": "auto"}).inputs == TRAINED


def test_a_network_that_is_told_no_metal_sees_none():
    net = trained("denoise-lite", "shipped")[0]
    generator = torch.Generator().manual_seed(3)
    y, start = torch.rand(2, 1, 1, 20, 20, generator=generator)
    keep = torch.ones_like(y)
    keep[..., 5:9, 5:9] = 0
    with torch.no_grad():
        assert torch.equal(net(y, start, keep)[-1][0], net(y, y, torch.ones_like(y))[-1][0])
        told_net = trained("dicdnet-lite", "shipped")[0]
        assert not torch.equal(told_net(y, start, keep)[-1][0], told_net(y, y, keep)[-1][0])


def test_the_suite_has_its_splits():
    splits = [scene.drawn.split for scene in load_suite("train") if scene.drawn]
    assert [splits.count(split) for split in ("train", "val", "test")] == [120, 15, 15]


# --- what networks see ---------------------------------------------------------------------------------


def test_sources_are_the_methods_volumes_to_the_last_bit(iron):
    scan = with_mask(iron)
    seen = told(scan, methods.Settings())
    for name, method in (("fdk", fdk), ("limar", limar.reconstruct), ("nmar", nmar.reconstruct)):
        np.testing.assert_array_equal(seen.sources[name], method(scan).values.numpy())
    assert not np.array_equal(seen.sources["fdk"], seen.sources["limar"])
    assert blind(scan, methods.Settings()).water == seen.water > 0


def test_without_metal_the_network_only_sees_fdk(iron):
    scan = dataclasses.replace(iron.metal_free.scan, metal=torch.zeros(iron.geometry.n_voxel, dtype=torch.bool))
    seen = told(scan, methods.Settings())
    assert not seen.mask.any() and all(np.array_equal(seen.sources["fdk"], v) for v in seen.sources.values())
    volume = find("fusion").reconstruct(scan)
    assert volume.details["mask_status"] == "no_metal" and not volume.details["corrected"]
    assert not torch.equal(volume.values, fdk(scan).values)


def test_another_unit_of_length_or_another_dose_scale_is_the_same_picture(iron):
    """With all lengths ten times as long the attenuation is a tenth."""
    scan = with_mask(iron)
    g = scan.geometry
    lengths = {"dso": 10 * g.dso, "dsd": 10 * g.dsd}
    lengths |= {key: tuple(10 * v for v in getattr(g, key)) for key in ("d_voxel", "d_detector")}
    large = dataclasses.replace(scan, geometry=msgspec.structs.replace(g, **lengths))
    for name in ("fusion", "acdnet-lite"):
        small, other = find(name).reconstruct(scan).values, find(name).reconstruct(large).values
        assert float((10 * other - small).abs().max() / small.abs().max()) < 1e-3, (
            name
        )  # float32 of FDK and water's bin


def test_the_metal_is_put_back_and_nothing_is_outside_the_field_of_view(iron):
    scan, first = with_mask(iron), fdk(with_mask(iron)).values
    for name in SHIPPED:
        values = find(name).reconstruct(scan).values
        assert not values[first == 0].any()
        assert torch.equal(values[scan.metal], first[scan.metal]) == ("mask" in find(name).params)


# --- the networks --------------------------------------------------------------------------------------


def test_slabs_are_the_whole():
    net = trained("fusion", "shipped")[0]
    generator = torch.Generator().manual_seed(1)
    sources, metal = torch.rand(1, 3, 70, 12, 9, generator=generator), torch.zeros(1, 1, 70, 12, 9)
    metal[:, :, 30:40, 4:7, 3:5] = 1
    with torch.no_grad():
        whole = net.change(sources, metal)[0, 0]
        for first in range(0, 70, methods.SLAB):
            begin, end = max(first - fusion.HALO, 0), first + methods.SLAB + fusion.HALO
            part = net.change(sources[:, :, begin:end], metal[:, :, begin:end])[0, 0]
            part = part[first - begin : first - begin + methods.SLAB]
            torch.testing.assert_close(part, whole[first : first + methods.SLAB], rtol=0, atol=1e-6)
    assert float(whole.abs().max()) <= fusion.BOUND


@pytest.mark.parametrize("n_images", [1, 3])
def test_spreading_back_is_the_adjoint(n_images):
    generator = torch.Generator().manual_seed(2)
    kernel = torch.randn(n_images, 5, 9, 9, generator=generator, dtype=torch.float64)
    maps, image = (torch.randn(3, n, 13, 11, generator=generator, dtype=torch.float64) for n in (5, 1))
    left = float((dictionary.spread(maps, kernel) * image).sum())
    assert left == pytest.approx(float((maps * dictionary.spread_back(image, kernel)).sum()), rel=1e-10)
    one = dictionary.spread(maps[:1], kernel[:1])
    direct = torch.nn.functional.conv2d(maps[:1], kernel[:1], padding=4)
    torch.testing.assert_close(one, direct)


def test_filters_turn_about_their_centre():
    basis = dictionary.fourier_basis(8)
    assert basis.shape == (8, 49, 9, 9) and not basis[:, :, 0, 0].any()
    for quarter in range(1, 4):
        expected = torch.rot90(basis[0], quarter, (2, 1))
        torch.testing.assert_close(basis[2 * quarter], expected, rtol=0, atol=1e-5)
    assert float((basis[1] - basis[0]).abs().max()) > 0.5


def test_a_stage_takes_the_step_of_its_equation():
    """With prox networks that are the identity: one gradient step for the maps, one for X, by hand in float64."""
    torch.manual_seed(3)
    net = dictionary.Fixed(maps=2, stages=1, channels=4).double()
    for block in (net.prox_m[0], net.prox_x[0]):
        for layer in block.back:
            torch.nn.init.zeros_(layer.weight)
    y, start = torch.randn(2, 1, 1, 12, 12, dtype=torch.float64)
    keep = torch.ones_like(y)
    keep[..., 5:7, 5:7] = 0
    (x, artefact) = net(y, start, keep)[0]
    kernel = net.kernels / net.kernels.square().sum((2, 3), keepdim=True).sqrt()
    gradient = torch.nn.functional.conv_transpose2d(keep * (y - start), kernel, padding=4)
    expected = torch.nn.functional.conv2d(torch.relu(net.eta[0] * gradient), kernel, padding=4)
    torch.testing.assert_close(artefact, expected, rtol=1e-6, atol=1e-8)
    half = start + net.kappa[0] * keep * (y - expected - start)
    torch.testing.assert_close(x, half, rtol=1e-6, atol=1e-8)


# --- training ------------------------------------------------------------------------------------------


@pytest.fixture
def short(monkeypatch):
    """Small batches, validated often."""
    for name, value in {"CUBES": 4, "EVERY": 10, "BATCH": {"residual": 1, "slices": 2}}.items():
        monkeypatch.setattr(train_learned, name, value)


@pytest.mark.parametrize("name", ["fusion", *dictionary.SIZES])
def test_fifty_steps_of_training_lower_the_loss(name, data, tmp_path, capsys, short):
    assert train_learned.main([str(data), str(tmp_path), name, "50"]) == 0
    net, card = trained(name, str(tmp_path / f"{name}.safetensors"))
    assert card.training.steps == 50 and card.architecture == ALL[name] and not net.training
    losses, valid = [c[1] for c in card.training.curve], [c[2] for c in card.training.curve]
    assert np.mean(losses[3:]) < 0.9 * losses[0] and valid[-1] < valid[0], (losses, valid)
    assert "validation" in capsys.readouterr().out


def test_the_twin_as_target_holds_the_same_noise(data, tmp_path, short):
    assert train_learned.main([str(data), str(tmp_path), "denoise-lite", "1", "--twin"]) == 0
    assert trained("denoise-lite", str(tmp_path / "denoise-lite-twin.safetensors"))[1].target == "twin"
    assert not (tmp_path / "denoise-lite.safetensors").exists()
    names = train_learned.listed(data).names["train"]
    (path,) = (tmp_path / "inputs").glob(f"{names[0]}-*.npz")
    found = dict(np.load(path))
    assert tuple(found) == data_module.ARRAYS
    stored = open_scan(data / names[0])
    expected = fdk(stored.metal_free.scan).values.numpy() / told(with_mask(stored), limar.Bridging()).water
    np.testing.assert_allclose(found["twin"], expected.clip(-2, 8), atol=4e-3)


def test_inputs_are_written_once_for_each_content_of_a_scan(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(data_module, "open_scan", made.append)
    monkeypatch.setattr(data_module, "arrays", lambda scan: {"fdk": np.zeros(1)})
    first, again, other = (data_module.prepare(tmp_path, "lung", hashed, tmp_path) for hashed in ("a", "a", "b"))
    assert first == again != other and len(made) == 2
    monkeypatch.setattr(data_module, "ARRAYS", ("fdk", "more"))
    assert data_module.prepare(tmp_path, "lung", "a", tmp_path) != first


@pytest.mark.parametrize("name", ["fusion", "denoise-lite"])
def test_samples_for_a_target(name, data, tmp_path, monkeypatch, short):
    """Without metal the twin is what the network sees; the effective reference is without noise."""
    drawn = {}
    monkeypatch.setattr(training, "fit", lambda net, draw, *rest: drawn.update(batch=draw(64, torch.Generator())))
    monkeypatch.setattr(training, "report", lambda *given: {})
    for flags, same in (([], False), (["--twin"], True)):
        train_learned.main([str(data), str(tmp_path), name, "1", *flags])
        batch = drawn["batch"]
        seen = batch["sources"][:, :1] if name == "fusion" else batch["y"]
        alike = (seen == batch["truth"]).flatten(1).all(1)
        assert bool(alike.any()) is same and not alike.all()


@pytest.mark.parametrize("name", ["denoise", "acdnet-lite"])
def test_a_training_that_was_interrupted_goes_on_to_the_same_bits(name, data, tmp_path, monkeypatch, short):
    class Interrupted(Exception):
        pass

    write = training._checkpoint

    def interrupt(*given):
        write(*given)
        raise Interrupted

    train_learned.main([str(data), str(tmp_path / "whole"), name, "20"])
    with monkeypatch.context() as patched, pytest.raises(Interrupted):
        patched.setattr(training, "_checkpoint", interrupt)
        train_learned.main([str(data), str(tmp_path / "parts"), name, "20"])
    assert not (tmp_path / "parts" / f"{name}.safetensors").exists()
    train_learned.main([str(data), str(tmp_path / "parts"), name, "20"])
    one, other = (load_file(tmp_path / folder / f"{name}.safetensors") for folder in ("whole", "parts"))
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["data"], "expected DATA, OUT"),
        (["data", "out", "fusoin"], "no such learned row, expected fusion"),
        (["data", "out", "fusion", "many"], "expected a number of steps"),
    ],
)
def test_what_is_wrong_with_a_training_is_said(arguments, words):
    with pytest.raises(InputError, match=words):
        train_learned.main(arguments)


def test_a_dataset_without_splits_is_refused(smallest, tmp_path):
    with pytest.raises(InputError, match="no scan in split 'train'"):
        train_learned.main([str(smallest), str(tmp_path), "fusion"])


def test_only_the_test_scans_are_scored(data, tmp_path, capsys):
    assert score_learned.main([str(data), str(tmp_path), "fdk", "denoise"]) == 0
    lines = (tmp_path / "learned.csv").read_text().splitlines()
    held = {scene.name for scene in load_suite(str(data.parent / "many.toml")) if scene.drawn.split == "test"}
    assert 0 < len(held) < 5 and {line.partition(",")[0] for line in lines[1:]} == held
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith(f"| method | Fe ({len(held)}) PSNR3D | ") and [s[:6] for s in shown[2:]] == [
        "| `fdk",
        "| `den",
    ]
    with pytest.raises(InputError, match="expected DATA, OUT"):
        score_learned.main(["data"])


# --- what is not read ----------------------------------------------------------------------------------


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def copied(tmp_path, name="denoise"):
    """Copy shipped weights, and return their path."""
    for suffix in (".safetensors", ".json"):
        (tmp_path / f"{name}{suffix}").write_bytes((WEIGHTS / f"{name}{suffix}").read_bytes())
    return tmp_path / f"{name}.safetensors"


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".pkl", ".safetensors"])
def test_a_pickle_is_refused_and_not_run(suffix, tmp_path, iron):
    path = copied(tmp_path).with_suffix(suffix)
    path.write_bytes(pickle.dumps(Evil(tmp_path / "run")))
    with pytest.raises(InputError, match="safetensors") as found:
        reconstruct_scan(iron, "denoise", network=str(path))
    assert "\n" not in str(found.value) and not (tmp_path / "run").exists()


def test_what_torch_saves_is_refused(tmp_path, iron):
    path = copied(tmp_path)
    torch.save(trained("denoise", "shipped")[0].state_dict(), path)
    with pytest.raises(InputError, match="not a safetensors file"):
        reconstruct_scan(iron, "denoise", network=str(path))


def changed_card(path, **changes):
    card = json.loads(path.with_suffix(".json").read_bytes())
    path.with_suffix(".json").write_text(json.dumps(card | changes))


def rewritten(path, change):
    """Change the tensors of a file, and let its JSON speak of the new one."""
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)
    changed_card(path, sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def test_weights_that_are_not_what_their_json_says_are_refused(tmp_path):
    path = copied(tmp_path)
    assert trained("denoise", str(path))[1] == trained("denoise", "shipped")[1]
    with pytest.raises(InputError, match="made for denoise"):
        trained("fusion", str(path))
    save_file(load_file(path) | {"last.bias": torch.ones(1)}, path)
    with pytest.raises(InputError, match=r"not the file that denoise\.json speaks of"):
        trained("denoise", str(path))
    path = copied(tmp_path)
    rewritten(path, lambda tensors: tensors["last.bias"].fill_(torch.nan))
    with pytest.raises(InputError, match="not all are finite"):
        trained("denoise", str(path))
    rewritten(path, lambda tensors: tensors.pop("last.bias"))
    with pytest.raises(InputError, match="do not fit the architecture"):
        trained("denoise", str(path))
    path = copied(tmp_path)
    changed_card(path, architecture={"kind": "residual", "sources": 1, "metal": 0, "channels": 10**9})
    with pytest.raises(InputError, match=r"denoise\.json: Expected .int. <= 256"):
        trained("denoise", str(path))
    changed_card(path, architecture={"kind": "pickled"})
    with pytest.raises(InputError, match="do not fit the architecture"):
        trained("denoise", str(path))
    changed_card(copied(tmp_path), code="print()")
    with pytest.raises(InputError, match="unknown field `code`"):
        trained("denoise", str(path))
    copied(tmp_path).write_bytes(path.read_bytes()[:-4])
    with pytest.raises(InputError, match="not a safetensors file"):
        trained("denoise", str(path))
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match="there is no such file"):
        trained("denoise", str(path))


def test_shipped_weights_are_those_of_the_code(monkeypatch):
    monkeypatch.setitem(SHIPPED, "denoise", "0" * 64)
    with pytest.raises(InputError, match="install it again"):
        trained("denoise", "shipped")
    monkeypatch.delitem(SHIPPED, "denoise")
    with pytest.raises(InputError, match="not trained"):
        trained("denoise", "shipped")
    assert msgspec.json.decode((WEIGHTS / "fusion.json").read_bytes(), type=Card).sha256 == SHIPPED["fusion"]


def test_a_scan_of_one_slice_works(data):
    stored = open_scan(list_scans(data)[0])
    scan = with_mask(stored)
    geometry = msgspec.structs.replace(scan.geometry, n_voxel=(1, 16, 16))
    thin = dataclasses.replace(scan, geometry=geometry, metal=scan.metal[8:9])
    for name in SHIPPED:
        assert find(name).reconstruct(thin).values.shape == (1, 16, 16)
