"""The commands `make-dataset` and `run-benchmark`: they dispatch, and show a user's errors.

A command is a module with `main(arguments)`. If that module is slow to import, its package declares the flags
(`Flags` in its `__init__`), so that --help answers at once.
"""

import contextlib
import importlib
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import tyro

from ctsim.benchmarks.engine.process import interruptible
from ctsim.benchmarks.engine.terminal import complain
from ctsim.errors import InputError


class Command(NamedTuple):
    """A sub-command of `make-dataset` or `run-benchmark`: the module with its `main`, and what it does.

    After a stop the same command goes on where it `resumes`, and else starts from the beginning.
    """

    module: str
    about: str
    resumes: bool = True


OTHERS = {
    "methods": Command("ctsim.benchmarks.methods", "list the methods, what they need, and their parameters"),
    "report": Command("ctsim.reports.report", "write results as one HTML page with the slices of every volume"),
    "score": Command("ctsim.benchmarks.submit.work", "score a volume made elsewhere as a row of the tables", False),
    "inspect": Command("ctsim.benchmarks.studies.inspect.study", "score a volume by other conventions of PSNR, SSIM"),
    "pareto": Command("ctsim.benchmarks.studies.pareto.study", "error against run time, simulator and methods"),
    "detect": Command("ctsim.benchmarks.studies.detect.study", "detection of lesions near metal by a model observer"),
    "skipping": Command("ctsim.benchmarks.studies.skipping.study", "what ctsim leaves out: time saved, error made"),
    "validate": Command(
        "ctsim.benchmarks.studies.validate.study", "the physics against tables, closed forms, Monte Carlo"
    ),
    "stress": Command("ctsim.benchmarks.studies.stress.study", "extreme scenes for the simulator and every method"),
    "peers": Command("ctsim.benchmarks.studies.peers.study", "time and error against RTK and XCIST"),
    "reproduce": Command("ctsim.benchmarks.studies.claims.study", "check claims about FDK, LIMAR, NMAR, neural rows"),
    "paper-tables": Command("ctsim.benchmarks.studies.paper.tables", "the paper's tables next to measured numbers"),
    "ablation": Command("ctsim.benchmarks.studies.ablation", "run the paper's ablations of its splat method"),
}
OF_DATASETS = {
    "import": Command("ctsim.benchmarks.importing.work", "copy a measured scan into a data folder"),
    "export": Command("ctsim.benchmarks.export.work", "write a volume or a scan for other programs", resumes=False),
    "shards": Command("ctsim.benchmarks.shards.work", "write scans into HDF5 files for training"),
}
EXIT_USER, EXIT_INTERRUPTED = 2, 130


def make_dataset() -> int:
    """Run `make-dataset` or one of its subcommands, the keys of `OF_DATASETS`; return the exit code."""
    return _dispatch("make-dataset", "ctsim.benchmarks.make_dataset", OF_DATASETS)


def run_benchmark() -> int:
    """Run `run-benchmark` or one of its subcommands, the keys of `OTHERS`; return the exit code."""
    return _dispatch("run-benchmark", "ctsim.benchmarks.studies.methods.study", OTHERS)


def _dispatch(command: str, module: str, others: dict[str, Command]) -> int:
    # threads that wait for each other sleep instead of spinning on a core that other programs could have
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    arguments = sys.argv[1:]
    if arguments and arguments[0] in others:
        name = arguments[0]
        return guarded(f"{command} {name}", others[name].module, arguments[1:], resumes=others[name].resumes)
    try:
        return guarded(command, module, arguments)
    finally:
        if {"-h", "--help"} & {*arguments}:
            lines = "".join(f"  {name:14}{other.about}\n" for name, other in others.items())
            sys.stdout.write(f"Other commands, each with its own --help ({command} NAME --help):\n{lines}")


def guarded(name: str, module: str, arguments: list[str], *, resumes: bool = True) -> int:
    """Call `main(arguments) -> int` of a module; a user's error is one sentence, exit code 2.

    Ctrl-C ends with 130, and so does SIGTERM, by which schedulers stop a job; records stay,
    and the same command continues from them if it `resumes`. Other exceptions are bugs and keep their traceback.
    """
    _write_anything()
    try:
        with interruptible():
            return _run(name, module, arguments)
    except BrokenPipeError:  # the reader of a pipe, such as head, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (InputError, msgspec.ValidationError, msgspec.DecodeError) as error:
        return _complain(name, " ".join(str(error).split()))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _complain(name, f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        forced = "without --force " if "--force" in arguments else ""  # which does all again
        then = f"what was finished is kept, run the same command {forced}to go on"
        if not resumes:
            then = "it starts from the beginning the next time"
        print(f"\n{name}: interrupted; {then}", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run(name: str, module: str, arguments: list[str]) -> int:
    package, _, _ = module.rpartition(".")
    if flags := getattr(importlib.import_module(package), "Flags", None) if package else None:
        tyro.cli(flags, prog=name, args=arguments)  # --help and unknown flags end here, before the heavy imports
    main: Callable[[list[str]], int] = importlib.import_module(module).main
    return main(arguments)


def quietly(command: Callable[[list[str]], int], *arguments: str | Path) -> None:
    """Run a command without its output; raise RuntimeError with the output if it fails.

    Raises KeyboardInterrupt if the exit code says that the command was interrupted.
    """
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        code = command([str(argument) for argument in arguments])
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise RuntimeError(f"exit code {code}: {said.getvalue().strip()}")


def _write_anything() -> None:
    """Write characters that the terminal's encoding lacks as escapes, so that none ends the command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _complain(name: str, sentence: str) -> int:
    complain(name, sentence)
    return EXIT_USER
