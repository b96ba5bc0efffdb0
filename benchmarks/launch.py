"""Run a program from a small process, for `program`: its peak memory is then its own.

A process that starts another hands down its peak: Linux counts what it held at the time as the new one's. The arguments
are a file, and the words of the command. The file gets how the program ended, its seconds, and its bytes.
"""

import json
import os
import signal
import sys
import time


def main(note: str, *words: str) -> None:
    """Run the program to its end; a SIGTERM kills it."""
    start = time.perf_counter()
    program = os.posix_spawnp(words[0], words, os.environ)
    signal.signal(signal.SIGTERM, lambda *_: os.kill(program, signal.SIGKILL))
    signal.signal(signal.SIGINT, lambda *_: None)  # of a terminal: the program has it, too
    _, status, used = os.wait4(program, 0)
    wall = time.perf_counter() - start
    peak = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    with open(note, "w", encoding="utf-8") as file:
        json.dump({"status": status, "wall": wall, "cpu": used.ru_utime + used.ru_stime, "peak_bytes": peak}, file)


if __name__ == "__main__":
    main(*sys.argv[1:])
