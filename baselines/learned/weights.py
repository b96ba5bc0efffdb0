"""Weights of the learned rows: safetensors files, each with a JSON that says what they are and how they were trained.

Nothing but safetensors is read: a pickle, such as torch.save writes, can run any code when it is loaded.
"""

import hashlib
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import nn

from ctsim.baselines.learned.inputs import HIGHEST, LOWEST
from ctsim.baselines.learned.training import build
from ctsim.errors import InputError

SHIPPED: dict[str, str] = {
    "fusion": "f2e39d5e17bef60ffdbd3df14b3d34c4d61a585b4cfcfceb1ae32908ec1463f7",
    "denoise": "989579f348aa72c7de787f81c70c3861929301eabb65f8963ad3b5034df129d4",
    "denoise-lite": "4854d942b9676f85a295b413896c0685db24b970c2c6e309dc7d4cfbfbe98b46",
    "dicdnet-lite": "f43298f424288715e158835abf5bbb32171cdc6dc77dc0057eae9a57db30b88d",
    "acdnet-lite": "44385dbc638827eafca99a9f3b54066a9c76803009d015a18dcc117cf1bc9010",
    "oscnet-lite": "7b19cc176adab57ca3e72a7a297f0051aee4a28d6417a242dbb0bb80e25b85d6",
}
"""SHA-256 of each method's weights in this package: with them the method's code changes."""
OWN = "shipped"
LARGEST = 2**24  # bytes of a file of weights
LONGEST = 200  # characters of what torch says
Size = Annotated[int, msgspec.Meta(ge=0, le=256)]


class Data(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What weights were trained on: the suite, its number of scenes by split, and a hash of the scans' content."""

    suite: str
    scenes: dict[str, int]
    sha256: str


class Training(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How: steps, seconds, batch, rate, seed, machine; the curve of step, mean loss since the last, validation loss."""

    steps: int
    seconds: float
    batch: int
    rate: float
    seed: int
    device: str
    threads: int
    torch: str
    curve: list[tuple[int, float, float]]


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of weights. `architecture` is the network's kind and sizes, `clip` in the `unit` of its inputs.

    The `target` of the training was the effective reference, or FDK of the twin, which holds the same noise.
    """

    name: str
    sha256: str
    architecture: dict[str, Size | str]
    unit: str
    clip: tuple[float, float]
    data: Data
    training: Training
    target: Literal["effective", "twin"] = "effective"


def trained(name: str, weights: str) -> tuple[nn.Module, Card]:
    """Return a method's network, ready to run, and what is known of its weights.

    `weights` is "shipped" or the path of a safetensors file with its JSON next to it. Raises InputError for a file of
    another format, one that is damaged or not the one its JSON speaks of, and weights of another network.
    """
    if weights != OWN:
        return _read(name, Path(weights))
    if name not in SHIPPED:
        raise InputError(f"{name} is not trained: expected network=, a safetensors file")
    with resources.as_file(resources.files("ctsim.baselines.learned") / "weights") as folder:
        net, card = _read(name, folder / f"{name}.safetensors")
    if card.sha256 != SHIPPED[name]:
        raise InputError(f"{name}: its weights are not those of this version of ctsim; install it again")
    return net, card


def _read(name: str, path: Path) -> tuple[nn.Module, Card]:
    if path.suffix != ".safetensors":
        raise InputError(f"weights {path}: only safetensors files are read, expected NAME.safetensors")
    for file in (path, path.with_suffix(".json")):
        if not file.is_file():
            raise InputError(f"weights {file}: there is no such file, expected NAME.safetensors and NAME.json")
    if (size := path.stat().st_size) > LARGEST:
        raise InputError(f"weights {path}: {size} bytes, expected at most {LARGEST}")
    card, content = _card(path.with_suffix(".json")), path.read_bytes()
    try:
        tensors = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise InputError(f"weights {path}: not a safetensors file ({error}); nothing else is read") from None
    if hashlib.sha256(content).hexdigest() != card.sha256:
        raise InputError(f"weights {path}: not the file that {path.with_suffix('.json').name} speaks of")
    if card.name != name or card.clip != (LOWEST, HIGHEST):
        raise InputError(f"weights {path}: made for {card.name} with inputs within {card.clip}, expected {name}")
    try:
        net = build(card.architecture)
        net.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())[:LONGEST]
        raise InputError(f"weights {path}: they do not fit the architecture in the JSON ({why})") from None
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise InputError(f"weights {path}: not all are finite")
    return net.eval(), card


def _card(path: Path) -> Card:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Card)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: {error}") from None
