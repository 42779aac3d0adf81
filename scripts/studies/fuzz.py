"""Damaged files of every reader: only errors of our own may come out, soon, in little memory.

    python -m scripts.studies.fuzz [--mutants 24000] [--least 0] [--seed 0] [--readers NAME ...] [--processes 2]

Three of four mutants change the structure of a file: nodes of JSON and TOML, members and methods of a zip, values and
tables of SQLite, boxes of MP4, chunks and tags of images, headers of PLY, cells and columns of tables, counts of binary
records (``tests/helpers/fuzz_structure.py``); the others its bytes and lines.

Needs the checkout and the extra ``dev``. Each reader of ``tests/helpers/fuzz_readers.py`` and ``fuzz_steps.py`` works
in a process of its own, in which it reads one mutant after the other: with at most 1 GB more address space than at its
start, and 10 s of processor time for each. Prints a table of readers and outcomes: ``read`` (by one of its functions at
least); ``refused``, by an ``InertialError`` of the reader's own words; ``gated``, by the gate of all readers, which had
none; ``control``, a message that still drives a terminal as it is shown; ``foreign``, any other exception; ``hung``;
``large``, more memory asked for than there is; ``died``, the process ended. Exit code 1 where one of the last five is
not 0. A mutant is told by its seed, reader and number: ``--only
NUMBER`` makes one reader's again.
"""

import argparse
import contextlib
import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import unicodedata
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NoReturn

import numpy as np

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.printing import printable
from colmap_inertial.io.files import DAMAGED
from tests.helpers.files import write_anew
from tests.helpers.fuzz_readers import READERS as SINGLE, Reader, mutant
from tests.helpers.fuzz_steps import MORE

READERS = {**SINGLE, **MORE}
OUTCOMES = ("read", "refused", "gated", "control", "foreign", "hung", "large", "died")
#: Address space beside that of a process that has read a whole file, and processor time for one mutant.
MOST_BYTES, MOST_S = 1 << 30, 10.0


class _Slow(BaseException):
    pass


@dataclasses.dataclass
class Row:
    """How a reader's mutants ended, and what was wrong: number of a mutant and the last line of its traceback."""

    name: str
    counts: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    faults: list[tuple[int, str]] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    megabytes: float = 0.0


def outcome(reader: Reader, folder: Path, files: list[tuple[Path, bytes]], key: tuple[int, ...]) -> tuple[str, str]:
    """Damage one of the files, read, and mend it."""
    rng = np.random.default_rng(key)
    path, whole = files[rng.integers(0, len(files))]
    write_anew(path, mutant(whole, rng))
    try:
        with contextlib.redirect_stderr(None):
            reader.read(folder)
        return "read", ""
    except InertialError as error:
        shown = printable(str(error))
        if any(unicodedata.category(sign) in ("Cc", "Cf", "Cs") and sign not in "\n\t" for sign in shown):
            return "control", f"{path.name}: {shown!r}"
        return "gated" if getattr(error, "code", "") == DAMAGED else "refused", ""
    except MemoryError:
        return "large", f"{path.name}: {traceback.format_exc()[-600:]}"
    except _Slow:
        return "hung", f"{path.name}: {traceback.format_exc()[-900:]}"
    except Exception:
        return "foreign", f"{path.name}: {traceback.format_exc()[-900:]}"
    finally:
        write_anew(path, whole)


def whole_files(reader: Reader, folder: Path) -> list[tuple[Path, bytes]]:
    """The reader's files, which it reads as they are, or says in words of ours why not (DJI)."""
    files = [(path, path.read_bytes()) for path in reader.build(folder)]
    with contextlib.suppress(InertialError):
        reader.read(folder)
    return files


def _work(name: str, seed: int, numbers: range, tell: multiprocessing.connection.Connection) -> None:
    """In a process of its own: begin each mutant by its number, and end it by its outcome."""

    def stop(*_: object) -> NoReturn:
        raise _Slow

    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what native code has to say
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        reader = READERS[name]
        files = whole_files(reader, folder)
        with open("/proc/self/statm") as statm:
            now = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MOST_BYTES, now + MOST_BYTES))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        signal.signal(signal.SIGPROF, stop)
        for number in numbers:
            tell.send((number, "", "", 0.0))
            signal.setitimer(signal.ITIMER_PROF, MOST_S)
            try:
                result, told = outcome(reader, folder, files, (seed, zlib.crc32(name.encode()), number))
            except _Slow:  # on its way out
                result, told = "hung", ""
            signal.setitimer(signal.ITIMER_PROF, 0)
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
            tell.send((number, result, told, more))


def study(name: str, seed: int, mutants: range) -> Row:
    """All mutants of one reader; a process that died or no longer answers is replaced by another one."""
    row, start = Row(name), time.monotonic()
    context = multiprocessing.get_context("spawn")
    while len(mutants) > 0:
        hear, tell = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(name, seed, mutants, tell), daemon=True)
        process.start()
        tell.close()
        last = mutants[0]
        try:
            while len(mutants) > 0:
                # native code does not hear the timer: after much longer it is ended from here
                if not hear.poll(120.0):
                    row.counts["hung"] += 1
                    row.faults.append((last, "no answer for 120 s"))
                    mutants = mutants[1:]
                    break
                last, result, told, more = hear.recv()
                if result:
                    row.counts[result] += 1
                    row.megabytes = max(row.megabytes, more)
                    mutants = mutants[1:]
                    if told:
                        row.faults.append((last, told))
        except EOFError:
            process.join(10)
            row.counts["died"] += 1
            row.faults.append((last, f"the process ended with {process.exitcode}"))
            mutants = mutants[1:]
        process.kill()
        process.join()
    row.seconds = time.monotonic() - start
    return row


def main() -> int:
    """Run the study; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=24000)
    parser.add_argument("--least", type=int, default=0, help="mutants of each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="*", default=list(READERS), choices=list(READERS), metavar="NAME")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", type=int, help="the number of one mutant")
    args = parser.parse_args()
    share = args.mutants / sum(1 / READERS[name].cost for name in args.readers)
    numbers = {name: range(max(args.least, round(share / READERS[name].cost))) for name in args.readers}
    if args.only is not None:
        numbers = dict.fromkeys(args.readers, range(args.only, args.only + 1))
    print(f"{'reader':32}" + "".join(f"{title:>9}" for title in ("mutants", *OUTCOMES, "s", "MB more")), flush=True)
    rows = []
    with ThreadPoolExecutor(args.processes) as pool:
        for row in pool.map(lambda name: study(name, args.seed, numbers[name]), args.readers):
            rows.append(row)
            counts = "".join(f"{row.counts[kind]:9}" for kind in OUTCOMES)
            print(
                f"{row.name:32}{sum(row.counts.values()):9}{counts}{row.seconds:9.0f}{row.megabytes:9.0f}", flush=True
            )
    total = {kind: sum(row.counts[kind] for row in rows) for kind in OUTCOMES}
    print(f"{'all':32}{sum(total.values()):9}" + "".join(f"{total[kind]:9}" for kind in OUTCOMES))
    for row in rows:
        for number, told in row.faults:
            print(f"\n{row.name}, mutant {number}: {told}")
    return 1 if any(total[kind] for kind in ("control", "foreign", "hung", "large", "died")) else 0


if __name__ == "__main__":
    sys.exit(main())
