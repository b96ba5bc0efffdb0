"""Training of the learned rows: batches that a number and a seed decide, Adam, and checkpoints that are resumed.

Step n of seed s draws from a generator of its own, so that a training that was interrupted goes on as if it had not
been: on a CPU with the same number of threads its weights are the same to the last bit.
"""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from ctsim.baselines.learned import dictionary, fusion

Batch = dict[str, Tensor]
PATCH = 32  # voxels of a cube that fusion is trained on, along each axis


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How long to train: `steps`, or so many `seconds` of it, whichever ends first; and the rest.

    The rate of Adam falls from `rate` along half a cosine. `every` steps the net is validated and a checkpoint written.
    """

    steps: int
    seconds: float | None = None
    batch: int = 16
    rate: float = 1e-3
    every: int = 200
    seed: int = 0


@dataclass(slots=True, kw_only=True)
class Course:
    """How a training went: steps and seconds so far; the curve of (step, mean loss since the last, validation loss)."""

    step: int = 0
    seconds: float = 0.0
    curve: list[tuple[int, float, float]] = field(default_factory=list)


def build(architecture: dict[str, str | int]) -> nn.Module:
    """Return the network of an architecture, with the weights that torch's random state gives.

    Raises KeyError for an unknown kind and TypeError for sizes that do not fit it.
    """
    sizes = {key: value for key, value in architecture.items() if key != "kind"}
    kind = architecture["kind"]
    if kind == "residual":
        return fusion.Residual(**sizes)  # pyright: ignore[reportArgumentType]
    return dictionary.KINDS[str(kind)](**sizes)  # pyright: ignore[reportArgumentType]


def slices(arrays: Batch, n: int, draws: torch.Generator) -> Batch:
    """Draw a batch of slices, turned by a multiple of 90° and mirrored or not; a quarter of them without metal.

    `arrays` hold [slice, 1, y, x]: "fdk", "limar", "truth" and "metal" of scans, "bare" and "bare_truth" of twins.
    """
    chosen = torch.randint(len(arrays["fdk"]), (n,), generator=draws)
    bare = torch.rand(n, generator=draws) < 0.25
    turns, mirror = (int(torch.randint(k, (), generator=draws)) for k in (4, 2))
    found = {name: value[chosen.to(value.device)].float() for name, value in arrays.items()}
    b = bare.to(found["fdk"].device)[:, None, None, None]
    batch = {
        "y": torch.where(b, found["bare"], found["fdk"]),
        "start": torch.where(b, found["bare"], found["limar"]),
        "truth": torch.where(b, found["bare_truth"], found["truth"]),
        "keep": torch.where(b, 1.0, 1 - found["metal"]),
    }
    batch = {name: torch.rot90(value, turns, (2, 3)) for name, value in batch.items()}
    return {name: value.flip(3) if mirror else value for name, value in batch.items()}


def patches(arrays: Batch, n: int, draws: torch.Generator, names: tuple[str, ...]) -> Batch:
    """Draw a batch of cubes, mirrored and with axes y and x swapped or not; a quarter of them without metal.

    `arrays` hold [scene, z, y, x] as for `slices` and "nmar"; `names` are the sources that the network sees.
    """
    cubes: list[Batch] = []
    for _ in range(n):
        scene = int(torch.randint(len(arrays["fdk"]), (), generator=draws))
        bare = bool(torch.rand((), generator=draws) < 0.25)
        at = [_place(size, draws) for size in arrays["fdk"].shape[1:]]
        part = (scene, *(slice(k, k + PATCH) for k in at))
        found = [arrays["bare" if bare else name][part].float() for name in names]
        cube = torch.stack([
            *found,
            arrays["bare_truth" if bare else "truth"][part].float(),
            arrays["metal"][part].float() * (not bare),
        ])  # fmt: skip
        mirrored = [axis + 1 for axis in range(3) if torch.rand((), generator=draws) < 0.5]
        cube = cube.transpose(2, 3) if torch.rand((), generator=draws) < 0.5 else cube
        cubes.append({"cube": cube.flip(mirrored)})
    cube = torch.stack([c["cube"] for c in cubes])
    return {"sources": cube[:, :-2], "truth": cube[:, -2:-1], "metal": cube[:, -1:]}


def _place(size: int, draws: torch.Generator) -> int:
    """Draw where a cube begins along an axis; the outer quarters of the places show next to nothing but air."""
    places = max(size - PATCH, 0) + 1
    return places // 4 + int(torch.randint(places - 2 * (places // 4), (), generator=draws))


def loss_of(net: nn.Module, batch: Batch) -> Tensor:
    """Return the loss of either kind of network on a batch."""
    if isinstance(net, fusion.Residual):
        near = torch.nn.functional.max_pool3d(batch["metal"], 5, 1, 2)
        body = torch.nn.functional.max_pool3d((batch["truth"] > 0.05).float(), 9, 1, 4)
        return fusion.loss(net(batch["sources"], batch["metal"]), batch["truth"], (1 - near) * (0.05 + body))
    found = net(batch["y"], batch["start"], batch["keep"])
    judged = 1 - torch.nn.functional.max_pool2d(1 - batch["keep"], 5, 1, 2)
    return dictionary.loss(found, batch["y"], batch["truth"], judged)


def validation(arrays: Batch, names: tuple[str, ...], n: int) -> Callable[[nn.Module], float]:
    """Return the mean loss over fixed batches, by a function of the network: all slices, or `n` cubes."""
    if "nmar" in arrays:
        batches = [patches(arrays, 4, draws_of(-1, step), names) for step in range(-(-n // 4))]
    else:
        whole = {"y": "fdk", "start": "limar", "truth": "truth"}
        parts = [slice(k, k + 32) for k in range(0, len(arrays["fdk"]), 32)]
        batches = [{key: arrays[name][part].float() for key, name in whole.items()} for part in parts]
        for batch, part in zip(batches, parts, strict=True):
            batch["keep"] = 1 - arrays["metal"][part].float()

    def validate(net: nn.Module) -> float:
        return sum(float(loss_of(net, batch)) for batch in batches) / len(batches)

    return validate


def ship(net: nn.Module, stem: Path, about: dict[str, object]) -> None:
    """Write STEM.safetensors with the weights, and STEM.json with `about` and the file's SHA-256."""
    path = stem.with_name(f"{stem.name}.safetensors")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({key: value.detach().cpu().contiguous() for key, value in net.state_dict().items()}, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(about | {"sha256": digest}, indent=1) + "\n")


def report(plan: Plan, course: Course, device: str) -> dict[str, object]:
    """Return what weights say of their training."""
    rounded = [[step, round(loss, 5), round(valid, 5)] for step, loss, valid in course.curve]
    return {
        "training": {
            "steps": course.step,
            "seconds": round(course.seconds, 1),
            "batch": plan.batch,
            "rate": plan.rate,
            "seed": plan.seed,
            "device": device,
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "curve": rounded,
        }
    }


def draws_of(seed: int, step: int) -> torch.Generator:
    """Return the generator of a step."""
    return torch.Generator().manual_seed(1_000_003 * (seed + 1) + step)


def fit(
    net: nn.Module,
    draw: Callable[[int, torch.Generator], Batch],
    validate: Callable[[nn.Module], float],
    plan: Plan,
    folder: Path | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> Course:
    """Train a network in place; with a `folder`, from the checkpoint in it if there is one.

    `draw(n, generator)` returns a batch, `validate(net)` a loss. `say` is called with a line at each validation.
    """
    adam, course = torch.optim.Adam(net.parameters(), plan.rate), Course()
    if folder is not None and (folder / "course.json").exists():
        course = _resume(net, adam, folder)
    began, total, count = time.perf_counter() - course.seconds, torch.zeros(()), 0
    net.train()
    while course.step < plan.steps and not (plan.seconds and course.seconds >= plan.seconds):
        share = max(course.step / plan.steps, course.seconds / plan.seconds if plan.seconds else 0.0)
        for group in adam.param_groups:
            group["lr"] = plan.rate * _half_cosine(share)
        loss = loss_of(net, draw(plan.batch, draws_of(plan.seed, course.step)))
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        adam.step()
        total, count = total.to(loss.device) + loss.detach(), count + 1
        course.step += 1
        if course.step % plan.every == 0 or course.step == plan.steps:
            with torch.no_grad():
                valid = validate(net)
            course.seconds = time.perf_counter() - began
            course.curve.append((course.step, float(total) / count, valid))
            say(f"step {course.step}, {course.seconds:.0f} s, loss {float(total) / count:.4f}, validation {valid:.4f}")
            total, count = torch.zeros(()), 0
            if folder is not None:
                _checkpoint(net, adam, course, folder)
        elif plan.seconds and course.step % 10 == 0:
            course.seconds = time.perf_counter() - began
    course.seconds = time.perf_counter() - began
    net.eval()
    return course


def _half_cosine(share: float) -> float:
    return float(0.5 * (1 + torch.cos(torch.tensor(torch.pi * min(share, 1.0), dtype=torch.float64)))) + 1e-3


def _checkpoint(net: nn.Module, adam: torch.optim.Adam, course: Course, folder: Path) -> None:
    """Write network and optimiser as safetensors, and then where the training stands."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {f"net.{name}": value.detach() for name, value in net.state_dict().items()}
    for name, parameter in net.named_parameters():
        tensors |= {f"{key}.{name}": value for key, value in adam.state[parameter].items()}
    path = folder / f"step-{course.step}.safetensors"
    save_file({name: value.cpu().contiguous() for name, value in tensors.items()}, path)
    part = folder / "course.part"
    part.write_text(json.dumps({"step": course.step, "seconds": course.seconds, "curve": course.curve}))
    part.replace(folder / "course.json")
    for old in folder.glob("step-*.safetensors"):
        if old != path:
            old.unlink()


def _resume(net: nn.Module, adam: torch.optim.Adam, folder: Path) -> Course:
    """Read the checkpoint of `_checkpoint`."""
    told = json.loads((folder / "course.json").read_text())
    course = Course(step=told["step"], seconds=told["seconds"], curve=[(int(s), a, b) for s, a, b in told["curve"]])
    tensors = load_file(folder / f"step-{course.step}.safetensors")
    net.load_state_dict({name[4:]: value for name, value in tensors.items() if name.startswith("net.")})
    for name, parameter in net.named_parameters():
        keys = ("step", "exp_avg", "exp_avg_sq")
        found = {key: tensors[f"{key}.{name}"] for key in keys}
        adam.state[parameter] = {k: v if k == "step" else v.to(parameter.device) for k, v in found.items()}
    return course
