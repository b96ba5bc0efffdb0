"""Networks on axial slices that unroll a model of artefacts: X = Y − A outside the metal, A = Σ_n K_n ∗ M_n.

Y is FDK, X the image without artefacts, M_n ≥ 0 are maps and K_n filters of 9 × 9 pixels. S stages minimise
½‖I ⊙ (Y − X − Σ_n K_n ∗ M_n)‖² with I = 1 outside the metal. Each stage takes one gradient step for the maps and one
for X, and a small residual network stands for the unknown prior of either:

    M ← prox_M(M − η Kᵀ ∗ (I ⊙ (Σ_n K_n ∗ M_n + X − Y)))
    X ← prox_X((1 − κ I) ⊙ X + κ I ⊙ (Y − Σ_n K_n ∗ M_n))

from M = 0 and X = LIMAR. What differs is where the filters come from:

- `Fixed` learns them, the same for every image: Wang et al., DICDNet, IEEE TMI 41, 2022, doi:10.1109/TMI.2021.3127074.
- `Mixed` mixes them from learned atoms D_d with weights α_nd(Y, X) of the image: Wang et al., ACDNet, IJCAI 2022,
  arXiv:2205.07471.
- `Turned` learns few and turns them about their centre: Wang et al., OSCNet, MICCAI 2022, arXiv:2203.13916.

The equations are those of the papers; sizes, prox networks, loss and data are not.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

SIZE = 9  # pixels of a filter along either axis
FREQUENCIES = 3  # of a filter that can be turned, along either axis


class Prox(nn.Module):
    """Two residual blocks of two 3 × 3 convolutions each, [image, map, y, x]; nearly the identity at first."""

    def __init__(self, maps: int, channels: int) -> None:
        super().__init__()
        into = [nn.Conv2d(maps, channels, 3, padding=1) for _ in range(2)]
        back = [nn.Conv2d(channels, maps, 3, padding=1) for _ in range(2)]
        for layer in back:
            nn.init.normal_(layer.weight, std=0.1 / math.sqrt(9 * channels))
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        self.into, self.back = nn.ModuleList(into), nn.ModuleList(back)

    def forward(self, x: Tensor) -> Tensor:
        """Apply both blocks."""
        for into, back in zip(self.into, self.back, strict=True):
            x = x + back(functional.relu(into(x)))
        return x


class Unrolled(nn.Module):
    """The stages; subclasses say where the filters come from. With `metal` 0 it knows neither mask nor LIMAR."""

    def __init__(self, *, maps: int, stages: int, channels: int, metal: int = 1) -> None:
        super().__init__()
        self.maps, self.metal = maps, bool(metal)
        self.memory = nn.Conv2d(2, channels // 2 - 1, 3, padding=1)  # what X's network remembers from stage to stage
        self.prox_m = nn.ModuleList(Prox(maps, channels) for _ in range(stages))
        self.prox_x = nn.ModuleList(Prox(channels // 2, channels) for _ in range(stages))
        self.eta = nn.Parameter(torch.full((stages,), 0.05))
        self.kappa = nn.Parameter(torch.full((stages,), 0.5))

    def filters(self, y: Tensor, start: Tensor) -> Tensor:
        """Return the filters before they are scaled, [image or 1, maps, 9, 9]."""
        raise NotImplementedError

    def forward(self, y: Tensor, start: Tensor, keep: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return image and artefact (X, A) after each stage, each [image, 1, y, x].

        `y` is FDK, `start` LIMAR, both in multiples of water; `keep` is 0 in metal, 1 elsewhere. A network that is not
        told the metal starts from FDK and keeps all.
        """
        if not self.metal:
            start, keep = y, torch.ones_like(y)
        kernel = self.filters(y, start)
        kernel = kernel / (kernel.square().sum((2, 3), keepdim=True) + 1e-8).sqrt()
        x, m = start, torch.zeros_like(y).expand(-1, self.maps, -1, -1)
        artefact, memory = torch.zeros_like(y), self.memory(torch.cat([y, start], 1))
        found = []
        for s in range(len(self.prox_m)):
            wrong = keep * (artefact + x - y)
            m = functional.relu(self.prox_m[s](m - self.eta[s] * spread_back(wrong, kernel)))
            artefact = spread(m, kernel)
            x = x + self.kappa[s] * keep * (y - artefact - x)
            both = self.prox_x[s](torch.cat([x, memory], 1))
            x, memory = both[:, :1], both[:, 1:]
            found.append((x, artefact))
        return found


class Fixed(Unrolled):
    """Filters that are the same for every image."""

    def __init__(self, *, maps: int, stages: int, channels: int, metal: int = 1) -> None:
        super().__init__(maps=maps, stages=stages, channels=channels, metal=metal)
        self.kernels = nn.Parameter(torch.randn(1, maps, SIZE, SIZE))

    def filters(self, y: Tensor, start: Tensor) -> Tensor:
        """Return the learned filters."""
        return self.kernels


class Mixed(Unrolled):
    """Filters that are mixed for each image from `atoms` learned ones."""

    def __init__(self, *, maps: int, stages: int, channels: int, atoms: int) -> None:
        super().__init__(maps=maps, stages=stages, channels=channels)
        self.atoms = nn.Parameter(torch.randn(atoms, SIZE, SIZE))
        self.first = nn.Conv2d(2, 16, 3, stride=2, padding=1)
        self.second = nn.Conv2d(16, 32, 3, stride=2, padding=1)
        self.mixture = nn.Linear(32, maps * atoms)
        nn.init.normal_(self.mixture.bias)

    def filters(self, y: Tensor, start: Tensor) -> Tensor:
        """Return the mixture for each image."""
        seen = functional.relu(self.first(torch.cat([y - start, start], 1)))
        weights = self.mixture(functional.relu(self.second(seen)).mean((2, 3)))
        return torch.einsum("bnd,dij->bnij", weights.reshape(len(y), self.maps, -1), self.atoms)


class Turned(Unrolled):
    """Few filters, each at `turns` angles: Fourier series on a disc of 9 pixels, whose coefficients are learned."""

    basis: Tensor

    def __init__(self, *, patterns: int, turns: int, stages: int, channels: int) -> None:
        super().__init__(maps=patterns * turns, stages=stages, channels=channels)
        self.register_buffer("basis", fourier_basis(turns), persistent=False)
        self.coefficients = nn.Parameter(torch.randn(patterns, self.basis.shape[1]))

    def filters(self, y: Tensor, start: Tensor) -> Tensor:
        """Return all patterns at all angles."""
        return torch.einsum("pc,tcij->ptij", self.coefficients, self.basis).reshape(1, self.maps, SIZE, SIZE)


def fourier_basis(turns: int) -> Tensor:
    """Return cosines and sines on a disc, turned by multiples of 2π/turns: [turn, function, 9, 9]."""
    at = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    y, x = torch.meshgrid(at, at, indexing="ij")
    disc = (x.hypot(y) <= SIZE / 2).double()
    waves = [(k, i) for k in range(FREQUENCIES + 1) for i in range(-FREQUENCIES, FREQUENCIES + 1) if k > 0 or i > 0]
    turned = []
    for t in range(turns):
        angle = 2 * math.pi * t / turns
        u, v = math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x
        phases = [2 * math.pi / SIZE * (k * u + i * v) for k, i in waves]
        turned.append(torch.stack([disc, *(p.cos() * disc for p in phases), *(p.sin() * disc for p in phases)]))
    return torch.stack(turned).float()


def spread(maps: Tensor, kernel: Tensor) -> Tensor:
    """Return Σ_n K_n ∗ M_n, [image, 1, y, x]; `kernel` [image or 1, n, 9, 9]."""
    n_images = len(kernel)
    if n_images == 1:
        return functional.conv2d(maps, kernel, padding=SIZE // 2)
    joined = maps.reshape(1, -1, *maps.shape[2:])
    return functional.conv2d(joined, kernel, padding=SIZE // 2, groups=n_images).transpose(0, 1)


def spread_back(image: Tensor, kernel: Tensor) -> Tensor:
    """Return the adjoint of `spread`, [image, n, y, x]."""
    n_images, n_maps = kernel.shape[:2]
    flipped = kernel.flip(2, 3).reshape(-1, 1, SIZE, SIZE)
    if n_images == 1:
        return functional.conv2d(image, flipped, padding=SIZE // 2)
    back = functional.conv2d(image.transpose(0, 1), flipped, padding=SIZE // 2, groups=n_images)
    return back.reshape(n_images, n_maps, *image.shape[2:])


KINDS: Mapping[str, type[Unrolled]] = {"fixed": Fixed, "mixed": Mixed, "turned": Turned}
SIZES: dict[str, dict[str, str | int]] = {
    "dicdnet-lite": {"kind": "fixed", "maps": 16, "stages": 4, "channels": 32},
    "denoise-lite": {"kind": "fixed", "maps": 16, "stages": 4, "channels": 32, "metal": 0},
    "acdnet-lite": {"kind": "mixed", "maps": 6, "atoms": 32, "stages": 4, "channels": 32},
    "oscnet-lite": {"kind": "turned", "patterns": 4, "turns": 8, "stages": 4, "channels": 24},
}
"""The architecture of each method: the kind of its filters, and its sizes."""


def loss(found: list[tuple[Tensor, Tensor]], y: Tensor, truth: Tensor, keep: Tensor) -> Tensor:
    """Return Σ_s w_s (mean |X_s − X*| + 5·10⁻⁴ mean |A_s − (Y − X*)|) outside the metal; w is 1 at last, 0.1 before."""
    total = torch.zeros((), device=y.device)
    for s, (x, artefact) in enumerate(found):
        wrong = (keep * (x - truth)).abs().mean() + 5e-4 * (keep * (artefact - (y - truth))).abs().mean()
        total = total + (1.0 if s == len(found) - 1 else 0.1) * wrong
    return total
