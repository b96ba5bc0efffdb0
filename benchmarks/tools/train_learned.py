"""Train a learned row on the suite `train`.

    python -m ctsim.benchmarks.tools.train_learned DATA OUT NAME [STEPS] [--twin]

DATA is a dataset with splits (`make-dataset train DATA`), NAME one of fusion, denoise, denoise-lite, dicdnet-lite,
acdnet-lite and oscnet-lite. The networks' inputs are written into OUT/inputs once; remove them after a change of FDK,
LIMAR or NMAR. An interrupted training goes on from the checkpoint in OUT/NAME, of the same STEPS. OUT/NAME.safetensors
and OUT/NAME.json are what `baselines/learned/weights` holds. With `--twin` the target is FDK of the metal-free twin in
place of the effective reference: it holds the scan's own noise, so that nothing is gained by denoising; the files are
then OUT/NAME-twin.*.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.learned import dictionary, fusion, training
from ctsim.baselines.learned.data import Listed, about, listed, prepare, slices_of
from ctsim.benchmarks.cli import guarded
from ctsim.errors import InputError
from ctsim.human import human_choice

ARCHITECTURES = fusion.SIZES | dictionary.SIZES
SLICES = {"train": 28, "val": 12}  # of each scene
CUBES = 60  # to validate on
STEPS = {"residual": 1000, "slices": 10_000}  # by kind of network
BATCH = {"residual": 4, "slices": 16}
RATE = {"residual": 2e-3, "slices": 1e-3}
EVERY = 200  # steps between validations
Scene = dict[str, NDArray[np.generic]]


def main(arguments: list[str]) -> int:
    """Train, and write weights and what is known of them; return 0."""
    target = "twin" if "--twin" in arguments else "effective"
    arguments = [argument for argument in arguments if argument != "--twin"]
    if len(arguments) not in (3, 4):
        raise InputError("expected DATA, OUT, the name of a learned row and, if not the usual ones, its steps")
    data, out, name = Path(arguments[0]), Path(arguments[1]), arguments[2]
    if name not in ARCHITECTURES:
        raise InputError(f"{name}: there is no such learned row, expected {human_choice(tuple(ARCHITECTURES), name)}")
    if len(arguments) == 4 and not arguments[3].isdecimal():
        raise InputError(f"{arguments[3]}: expected a number of steps")
    steps = int(arguments[3]) if len(arguments) == 4 else STEPS[kind_of(name)]
    which = listed(data)
    train(name, which, {split: scenes(data, which, out / "inputs", split) for split in SLICES}, out, steps, target)
    return 0


def kind_of(name: str) -> str:
    """Return what a row's network is trained on: cubes of volumes ("residual") or "slices"."""
    return "residual" if ARCHITECTURES[name]["kind"] == "residual" else "slices"


def scenes(data: Path, which: Listed, folder: Path, split: str) -> list[Scene]:
    """Return the arrays of a split's scenes; what is not there is written first."""
    paths = [prepare(data, name, which.hashes[name], folder) for name in which.names[split]]
    return [dict(np.load(path, allow_pickle=False)) for path in paths]


def train(name: str, which: Listed, by_split: dict[str, list[Scene]], out: Path, steps: int, target: str) -> None:
    """Train a row for a target, "effective" or "twin", and write it."""
    architecture, kind = ARCHITECTURES[name], kind_of(name)
    torch.manual_seed(0)
    net = training.build(architecture)
    names = ("fdk", "limar", "nmar")[: int(architecture.get("sources", 2))]
    plan = training.Plan(steps=steps, batch=BATCH[kind], rate=RATE[kind], every=EVERY)
    if kind == "residual":
        arrays = [{key: _stacked(found, key) for key in found[0]} for found in by_split.values()]
    else:
        arrays = [_tensors(slices_of(by_split[split], n)) for split, n in SLICES.items()]
    if target == "twin":
        arrays = [part | {"truth": part["twin"], "bare_truth": part["bare"]} for part in arrays]
    stem = name if target == "effective" else f"{name}-{target}"

    def draw(n: int, draws: torch.Generator) -> training.Batch:
        if kind == "residual":
            return training.patches(arrays[0], n, draws, names)
        return training.slices(arrays[0], n, draws)

    validate = training.validation(arrays[1], names, CUBES)
    course = training.fit(net, draw, validate, plan, out / stem, lambda text: sys.stdout.write(f"{stem}: {text}\n"))
    told = about(architecture, which.digest, {s: len(which.names[s]) for s in SLICES}, target)
    training.ship(net, out / stem, {"name": name} | told | training.report(plan, course, "cpu"))


def _stacked(found: list[Scene], key: str) -> torch.Tensor:
    return torch.from_numpy(np.stack([scene[key] for scene in found]))


def _tensors(arrays: dict[str, NDArray[np.float16]]) -> training.Batch:
    return {name: torch.from_numpy(value) for name, value in arrays.items()}


if __name__ == "__main__":
    sys.exit(guarded("train_learned", "ctsim.benchmarks.tools.train_learned", sys.argv[1:]))
