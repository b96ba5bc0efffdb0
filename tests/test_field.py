"""Neural fields: gradients, physics in closed form, what is refused, and that a run repeats itself."""

import dataclasses
import math
import types

import msgspec
import numpy as np
import pytest
import torch

from ctsim.baselines import polyner
from ctsim.baselines.polyner import equal_bins
from ctsim.benchmarks.methods import find
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.field import methods
from ctsim.reconstruct.field.data import Data, held_out_views, subsets
from ctsim.reconstruct.field.encoding import Encoding
from ctsim.reconstruct.field.grid import Grid, overlaps
from ctsim.reconstruct.field.kernels import network_reference
from ctsim.reconstruct.field.network import first_parameters
from ctsim.reconstruct.field.physics import SERIES, Bins, Curve, Mono, Park, log_sinhc
from ctsim.reconstruct.field.run import Given
from ctsim.reconstruct.projector import forward_columns
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.response import evaluate as evaluate_response
from ctsim.reconstruct.splat.response import make_response

GEOMETRY = Geometry(
    dso=60.0,
    dsd=90.0,
    n_voxel=(3, 4, 5),
    d_voxel=(2.0, 1.5, 1.0),
    n_detector=(4, 6),
    d_detector=(2.5, 2.0),
    n_views=5,
    off_origin=(0.3, -0.2, 0.1),
)
VIEWS = np.array([0, 3])
STEP = 1e-6


class ExactGrid:
    """A grid whose projector is a float64 matrix, so that gradients are not those of float32."""

    def __init__(self, chosen):
        self.grid = Grid.of(GEOMETRY, chosen)
        self.whole = GEOMETRY
        units = np.eye(len(self.grid), dtype=np.float32)
        images = [self.grid.project(torch.from_numpy(u), np.arange(5)).numpy() for u in units]
        self.matrix = torch.from_numpy(np.stack(images, -1).astype(np.float64))
        self.columns, self.at_points = self.grid.columns, self.grid.at_points

    def project(self, values, views):
        return self.matrix[views] @ values


def points_of(grid):
    """Return the places of a grid's points, [point, (y, x, z)]."""
    return np.stack([at[k] for at, k in zip(grid.axes(), np.nonzero(grid.inside()), strict=True)], 1)


@pytest.fixture(scope="module")
def chosen():
    chosen = np.random.default_rng(0).random(GEOMETRY.n_voxel) < 0.7
    chosen[1, 1, 1] = True
    return chosen


def bins(chosen, smoothness):
    grid = ExactGrid(chosen)
    metal = np.zeros(len(grid.grid), bool)
    metal[5:9] = True
    inside = np.zeros(chosen.shape, bool)
    inside.transpose(1, 2, 0)[tuple(a[metal] for a in np.nonzero(chosen.transpose(1, 2, 0)))] = True
    eta = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    return Bins(
        grid=grid,
        metal_grid=ExactGrid(inside),
        metal=torch.from_numpy(metal),
        eta=eta,
        unit=0.02,
        smoothness=smoothness,
    )


def curve(chosen):
    double = {"dtype": torch.float64}
    return Curve(
        grid=ExactGrid(chosen),
        knots=torch.tensor([0.0, 0.02, 0.05, 1.0], **double),
        densities=torch.tensor([[0, 0], [0.01, 0.005], [0.02, 0.02], [0.2, 0.6]], **double),
        slopes=torch.tensor([[0.5, 0.25], [0.333, 0.5], [0.19, 0.61]], **double),
        nodes=torch.tensor([[1.1, 3.0], [1.0, 1.0], [0.9, 0.4]], **double),
        log_eta=torch.log(torch.tensor([0.2, 0.5, 0.3], **double)),
        ratios=(0.7, 1.0, 0.5),
        water=0.03,
        tv=0.3,
        scatter=0.05,
        dark=np.random.default_rng(8).random(GEOMETRY.shape) < 0.2,
    )


PHYSICS = {
    "naf": lambda chosen: Mono(grid=ExactGrid(chosen)),
    "park": lambda chosen: Park(grid=ExactGrid(chosen), scales=(1.0, 2.0)),
    "polyner": lambda chosen: bins(chosen, None),
    "polyner-published": lambda chosen: bins(chosen, 0.2),
    "field": curve,
}


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("name", PHYSICS)
def test_gradients_are_finite_differences(name, power, chosen):
    """In float64, by every parameter of the network and some of the table."""
    physics = PHYSICS[name](chosen)
    grid = physics.grid.grid
    encoding = Encoding.of(grid, (2, 4), 5)
    rows, shares, _ = network_reference.encode(points_of(grid), (2, 4), 5)
    parameters = {n: p.double() for n, p in first_parameters(encoding, 2, 3, len(physics.scales), 7).items()}
    random = np.random.default_rng(4)
    parameters["table"] *= 1e4  # else the network is next to linear
    parameters["b2"] += torch.from_numpy(random.random(len(physics.scales)))  # else bins may be equal, a kink
    p, weights = random.random(GEOMETRY.shape).astype(np.float32), random.random(GEOMETRY.shape).astype(np.float32)
    data = Data(p=p, weights=weights - 0.2, power=power)  # some are bounds
    scale = 0.03 * torch.tensor(physics.scales, dtype=torch.float64)

    def loss():
        values = network_reference.evaluate(rows, shares, parameters, scale)
        misfit, penalty = data.misfit(physics.line_integrals(values, VIEWS), VIEWS), physics.penalty(values)
        return misfit if penalty is None else misfit + penalty

    for tensor in parameters.values():
        tensor.requires_grad_()
    gradients = torch.autograd.grad(loss(), list(parameters.values()))
    for tensor, gradient in zip(parameters.values(), gradients, strict=True):
        flat = tensor.detach().view(-1)  # shares memory
        for k in range(0, flat.numel(), max(flat.numel() // 6, 1)):
            at, sides = float(flat[k]), []
            for side in (STEP, -STEP):
                flat[k] = at + side
                sides.append(float(loss().detach()))
            flat[k] = at
            difference = (sides[0] - sides[1]) / (2 * STEP)
            # rounding: 1e-16 of a loss near 1 over 2e-6; curvature: far below
            assert difference == pytest.approx(float(gradient.view(-1)[k]), rel=1e-6, abs=1e-9)


def test_bins_that_are_equal_outside_the_mask_are_projected_as_all_would_be(chosen):
    """P of the definition: every bin's whole volume is projected."""
    physics = bins(chosen, None)
    values = torch.from_numpy(np.random.default_rng(2).random((len(physics.grid.grid), 3))) * 0.1
    mu = physics.attenuations(values)
    assert torch.equal(mu[physics.metal], 10 * values[physics.metal])
    outside = mu[~physics.metal]
    assert torch.allclose(outside, values[~physics.metal].mean(1, keepdim=True).expand(-1, 3))
    paths = torch.stack([physics.grid.project(mu[:, k], VIEWS) for k in range(3)], -1)
    expected = -torch.log((physics.eta * torch.exp(-paths)).sum(-1))
    assert torch.allclose(physics.line_integrals(values, VIEWS), expected, rtol=1e-6)  # the grids are float32's
    published = bins(chosen, 0.2)
    everywhere = -torch.log((published.eta * torch.exp(-_paths(published, values))).sum(-1))
    assert torch.allclose(published.line_integrals(values, VIEWS), everywhere, rtol=1e-12)
    steps = (values[~physics.metal][:, 1:] - values[~physics.metal][:, :-1]).abs().sum(1).mean()
    assert float(published.penalty(values)) == pytest.approx(0.2 * float(steps) / 0.02, rel=1e-12)


def _paths(physics, values):
    return torch.stack([physics.grid.project(mu, VIEWS) for mu in physics.attenuations(values).T], -1)


def test_field_has_the_response_and_the_curve_of_splat(chosen):
    response = make_response("tube", e_max=90.0, basis="klein-nishina")
    known = MaterialCurve.of(response, 30.0)
    grid = Grid.of(GEOMETRY, chosen)
    weights = np.ones(GEOMETRY.shape, np.float32)
    weights[3, 1] = -1
    data = Data(p=np.zeros(GEOMETRY.shape, np.float32), weights=weights)
    given = Given(scan=None, data=data, grid=grid, unit=0.02, clamped=0, scatter=0.04)
    physics = methods.curve_physics(given, known, response, 0.01)
    u = np.geomspace(1e-4, 30 * known.knots[-2], len(grid)).astype(np.float32)
    assert physics.water == known.water and physics.scales == (known.water / 0.02,)
    rho = physics.densities_of(torch.from_numpy(u))
    assert np.allclose(rho.numpy(), known.densities_of(u), rtol=1e-5)
    la, lb = (grid.project(rho[:, k].contiguous(), VIEWS).numpy() for k in range(2))
    p, _, _ = evaluate_response(response, la, lb)
    found = physics.line_integrals(torch.from_numpy(u)[:, None], VIEWS).numpy()
    scattered = -np.log(np.exp(-p.astype(np.float64)) + 0.04)
    bound = weights[VIEWS] < 0
    assert np.allclose(found, np.where(bound, p, scattered), rtol=2e-5, atol=2e-6)


def test_total_variation_of_a_step_is_its_area(chosen):
    """A step of water between two layers: 1 a voxel of the layer, times the ratio of the axis, over all voxels."""
    for axis, ratio in ((0, 1.0), (1, 0.7), (2, 0.5)):
        physics = dataclasses.replace(curve(np.ones_like(chosen)), ratios=(0.7, 0.5, 1.0))
        n_z, n_y, n_x = chosen.shape
        ones = np.ones((n_z, n_y, n_x))
        for k in range(2):
            ones[(slice(None),) * axis + (k,)] = 2
        values = torch.from_numpy(0.03 * ones.transpose(1, 2, 0).reshape(-1, 1))
        layer = ones.size // ones.shape[axis]
        expected = 0.3 * layer * ratio / ones.size
        # the rounded root leaves a thousandth of water in each voxel
        assert float(physics.penalty(values)) == pytest.approx(expected, abs=0.3 * 1e-3)


def test_a_bound_pulls_at_what_is_brighter_alone():
    p, weights = np.array([[[1.0, 1.0, 1.0]]], np.float32), np.array([[[0.5, -0.5, -0.5]]], np.float32)
    found, views = torch.tensor([[[2.0, 2.0, 0.0]]]), np.array([0])
    assert float(Data(p=p, weights=weights, power=1).misfit(found, views)) == pytest.approx(1.0 / 3)
    assert float(Data(p=p, weights=2 * weights, power=2).misfit(3 * found, views)) == pytest.approx(26.0 / 3)


def test_bins_of_a_spectrum_hold_about_equal_signal():
    energies, signal = np.linspace(20, 90, 71), np.exp(-((np.linspace(-2, 2, 71)) ** 2))
    means, eta = equal_bins(energies, signal, 8)
    # a bin's ends are off by half of an energy's share at most
    assert len(eta) == 8 and np.abs(eta - 1 / 8).max() < (signal / signal.sum()).max()
    assert np.all(np.diff(means) > 0) and means @ eta == pytest.approx(energies @ signal / signal.sum(), rel=1e-12)
    assert equal_bins(np.array([30.0, 60.0]), np.array([1.0, 3.0]), 8)[1].tolist() == [0.25, 0.75]


def test_the_projector_of_points_is_the_exact_one_and_its_gradient_the_adjoint(chosen):
    """A support away from the border is cropped, which changes nothing."""
    inner = np.zeros((7, 9, 11), bool)
    inner[2:5, 3:7, 4:9] = chosen
    geometry = msgspec.structs.replace(GEOMETRY, n_voxel=inner.shape)
    grid, random = Grid.of(geometry, inner), np.random.default_rng(1)
    assert grid.geometry.n_voxel < inner.shape
    values = torch.from_numpy(random.random(len(grid)).astype(np.float32)).requires_grad_()
    found = grid.project(values, VIEWS)
    volume = np.zeros((9, 11, 7), np.float32)
    volume[inner.transpose(1, 2, 0)] = values.detach().numpy()
    expected = forward_columns(volume, geometry, VIEWS)
    assert np.allclose(found.detach().numpy(), expected, atol=1e-5 * expected.max())
    images = torch.from_numpy(random.random(expected.shape).astype(np.float32))
    (gradient,) = torch.autograd.grad((found * images).sum(), values)
    dot = float((found.detach().double() * images.double()).sum())
    assert float((gradient.double() * values.detach().double()).sum()) == pytest.approx(dot, rel=1e-5)
    read = grid.volume(values.detach().numpy(), geometry)
    assert np.array_equal(read, volume.transpose(2, 0, 1))


def test_points_stand_at_the_centres_of_their_voxels(chosen):
    grid = Grid.of(GEOMETRY, chosen)
    z, y, x = np.nonzero(chosen)
    expected = {((j + 0.5) * 1.5 / 6, (i + 0.5) / 6, (k + 0.5) * 2 / 6) for k, j, i in zip(z, y, x, strict=True)}
    assert {tuple(np.round(p, 12)) for p in points_of(grid)} == {tuple(np.round(p, 12)) for p in expected}


def test_a_finer_grid_is_read_as_means_over_voxels():
    shares = overlaps(2, 3)
    assert np.allclose(shares, [[2 / 3, 1 / 3, 0], [0, 1 / 3, 2 / 3]])
    assert np.array_equal(overlaps(5, 5), np.eye(5, dtype=np.float32))


@pytest.mark.parametrize("b", [0.0, 1e-4, 0.05, 0.0999999, 0.1, 0.1000001, 0.5, 3.0, 300.0])
def test_parks_hardening_is_the_closed_form(b):
    """On both sides of the series' end; float32 rounds b itself, which b/3 of it passes on."""
    exact = 0.0 if b == 0 else math.log(math.sinh(b) / b)
    slope = 0.0 if b == 0 else 1 / math.tanh(b) - 1 / b
    for kind, tolerance in ((torch.float64, 5e-10), (torch.float32, 3e-6 if b > SERIES / 2 else 1e-7)):
        at = torch.tensor([b], dtype=kind, requires_grad=True)
        found = log_sinhc(at)
        (gradient,) = torch.autograd.grad(found.sum(), at)
        assert float(found.detach()) == pytest.approx(exact, abs=tolerance * max(1, b))
        assert float(gradient) == pytest.approx(slope, abs=max(tolerance, 1e-8) * 30)


def test_a_seed_draws_the_first_parameters():
    encoding = Encoding.of(Grid.of(GEOMETRY, np.ones(GEOMETRY.n_voxel, bool)), (2, 4), 5)
    first, again, other = (first_parameters(encoding, 2, 3, 1, seed) for seed in (1, 1, 2))
    for name, drawn in first.items():
        assert torch.equal(drawn, again[name])
        assert name == "b2" or not torch.equal(drawn, other[name])
    assert float(first["table"].abs().max()) <= 1e-4


def test_views_are_kept_apart_and_the_others_all_used_once_a_turn():
    held = held_out_views(60)
    assert held.size == 6 and held_out_views(3).size == 0 and held_out_views(1000).size == 12
    rest = np.setdiff1d(np.arange(60), held)
    turn, again = subsets(rest, 6, 1, 0), subsets(rest, 6, 1, 0)
    assert len(turn) == 9 and np.array_equal(np.sort(np.concatenate(turn)), rest)
    assert all(np.array_equal(a, b) for a, b in zip(turn, again, strict=True))
    assert any(not np.array_equal(a, b) for a, b in zip(turn, subsets(rest, 6, 1, 1), strict=True))


@pytest.fixture(scope="module")
def scan(smallest):
    return open_scan(list_scans(smallest)[0]).scan


def test_a_seed_says_all_and_a_fit_goes_on_to_the_same_bit(scan, tmp_path):
    whole = methods.naf(scan, steps=12)
    assert torch.equal(methods.naf(scan, steps=12).values, whole.values)
    assert not torch.equal(methods.naf(scan, steps=12, seed=1).values, whole.values)
    told = {"steps": 12, "checkpoints": str(tmp_path)}
    assert methods.naf(scan, seconds=1e-9, **told).details["steps"] == 0
    stopped = _interrupted(scan, told)
    assert 0 < stopped < 12 and list(tmp_path.iterdir())
    resumed = methods.naf(scan, **told)
    assert torch.equal(resumed.values, whole.values) and resumed.details["earlier_seconds"] >= 12
    assert not list(tmp_path.iterdir())
    details = whole.details
    assert details["steps"] == 12 and details["held_out"]["misfit"] > 0 and details["parameters"] > 1000


def _interrupted(scan, told):
    """End a run by its time after a few steps, on a clock that goes on by a second whenever it is read."""
    clock = iter(range(1000))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ctsim.reconstruct.watch.time", types.SimpleNamespace(perf_counter=lambda: float(next(clock))))
        return methods.naf(scan, seconds=12, **told).details["steps"]


def test_a_field_states_the_grid_it_is_fitted_on(scan):
    """Tables warn where labels lie on it."""
    assert methods.naf(scan, steps=1).details["grid"] == [15, 15, 15]  # 60 mm in cubes of 6 mm over 1.5


def test_held_out_views_choose_the_field_that_is_returned(scan, monkeypatch):
    """A fit that runs away after its third turn returns that turn's field."""
    judged = iter([3.0, 2.0, 1.0] + [5.0] * 100)
    real = Data.misfits

    def misfits(self, found, views):
        return torch.tensor([next(judged)]) if not found.requires_grad else real(self, found, views)

    monkeypatch.setattr(Data, "misfits", misfits)
    volume = methods.naf(scan, steps=40, views=6)
    turn = len(subsets(np.arange(11), 6, 0, 0))
    held = volume.details["held_out"]
    assert (held["step"], held["misfit"]) == (3 * turn, 1.0)
    # 12 turns without a better one end it
    assert volume.details["steps"] == min(15 * turn, 40)
    monkeypatch.undo()
    assert "held_out" not in methods.naf(scan, steps=3, stop="none").details


@pytest.mark.parametrize("name", ["naf", "polyner", "park", "field"])
def test_what_a_field_cannot_do_is_refused_in_a_sentence(name, scan):
    """Six columns see 10 mm of an object of three times that."""
    geometry = msgspec.structs.replace(scan.geometry, n_detector=(16, 6))
    cut = dataclasses.replace(scan, geometry=geometry, counts=scan.counts[..., 6:12], flat=scan.flat[..., 6:12])
    method = find(name)
    with pytest.raises(InputError, match="a field explains all attenuation within the grid: the object reaches over"):
        method.reconstruct(cut)
    assert "reaches over" in method.skip(cut) and method.skip(scan) is None
    elsewhere = object.__new__(type(scan))
    for part in dataclasses.fields(scan):
        object.__setattr__(elsewhere, part.name, getattr(scan, part.name))
    object.__setattr__(elsewhere, "counts", scan.counts.to("meta"))
    with pytest.raises(InputError, match="fields are fitted on the CPU only, expected the counts there, got meta"):
        method.reconstruct(elsewhere)


def test_polyner_reads_its_bins(smallest):
    """At the bins' energies, in the middle, and their mean; without a mask there is one attenuation for all."""
    stored = open_scan(list_scans(smallest)[0])
    scan = dataclasses.replace(stored.scan, metal=torch.from_numpy(np.asarray(stored.metal) > 0))
    told = {"steps": 20, "fineness": 1.0}  # a finer grid has voxels of metal and tissue
    volume = polyner.reconstruct(scan, **told)
    energies, eta = (volume.details[key] for key in ("energies_kev", "eta"))
    of = torch.stack([volume.at_energy(e) for e in energies], -1)
    assert torch.allclose(of @ torch.tensor(eta, dtype=torch.float32), volume.values, atol=1e-6)
    assert torch.equal(polyner.reconstruct(scan, readout="middle", **told).values, of[..., 3])
    metal = scan.metal.bool()
    assert bool((of[metal].std(-1) > 0).any()) and not bool((of[~metal].std(-1) > 1e-6).any())
    assert torch.equal(volume.at_energy(1.0), of[..., 0]) and torch.equal(volume.at_energy(500.0), of[..., -1])
    free = polyner.reconstruct(dataclasses.replace(scan, metal=torch.zeros(metal.shape, dtype=torch.bool)), steps=3)
    assert free.details["mask_status"] == "no_metal"
    assert torch.allclose(free.at_energy(30.0), free.at_energy(80.0), atol=1e-7)
    with pytest.raises(InputError, match="at_energy must be asked for a positive energy in keV, got -1"):
        volume.at_energy(-1)
