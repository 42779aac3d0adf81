"""Full disks, quotas, exhausted memory and kills during commands, and what a restart makes of them.

    python -m scripts.studies.faults [--faults 60] [--seed 0] [--commands NAME ...]

Needs the checkout and the extra ``dev``; Linux. Each command (reconstruct, batch, apply, fuse-apertures,
fuse-exposures) goes once undisturbed, which also says how much it takes. Then it goes again and again, each time with
one fault of a random strength:

- ``kill``: SIGKILL after a random time
- ``disk``: a file system with less room than it needs (a tmpfs; as root only, otherwise ``quota`` takes its turn)
- ``quota``: no file may grow beyond a size (RLIMIT_FSIZE)
- ``memory``: less address space than it takes (RLIMIT_AS)
- ``files``: fewer open files than it takes (RLIMIT_NOFILE)

and once more, undisturbed, in the same folder. After the fault there is no half result: ``result.json`` (of apply: OUT)
is there only where the command came through. What it said last is a sentence: no traceback, no words of a library, no
end by a signal. After the second time everything is as in the undisturbed run, byte for byte. Exit code 1 otherwise.
"""

import argparse
import contextlib
import dataclasses
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2

from colmap_inertial.run.steps.session import keep_colmap_quiet
from scripts.studies.kill import OPTIONS, contents

FAULTS = ("kill", "disk", "quota", "memory", "files")
#: Sets limits of its own process, and is then the command line.
LIMITED = """
import resource, sys
for name, value in zip(sys.argv[1:7:2], map(int, sys.argv[2:7:2])):
    if value:
        resource.setrlimit(getattr(resource, name), (value, resource.getrlimit(getattr(resource, name))[1]))
from colmap_inertial.cli import main
main(sys.argv[7:])
"""
#: How the last thing said begins, or all of it where a batch says which captures failed.
SENTENCE = re.compile(r"error: \S+.{10,}|\d+ .*|findings and remedies: .*")


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line that ends with the output's folder, given with ``{out}``; what it made, by path."""

    line: tuple[str, ...]
    made: Callable[[Path], dict[str, bytes]]
    done: Callable[[Path], bool]
    exit_codes: tuple[int, ...] = (0,)


def files_of(*names: str) -> Callable[[Path], dict[str, bytes]]:
    """All files of some folders of the output; of all of it where none are named."""

    def made(out: Path) -> dict[str, bytes]:
        roots = [out / name for name in names] or [out]
        paths = [path for root in roots for path in sorted(root.rglob("*")) if path.is_file()]
        return {str(path.relative_to(out)): path.read_bytes() for path in paths}

    return made


def batch_made(out: Path) -> dict[str, bytes]:
    """What each capture of a batch came to."""
    found = {}
    for result in sorted(out.rglob("result.json")):
        folder = result.parent
        found |= {f"{folder.relative_to(out)}/{name}": data for name, data in contents(folder).items()}
    return found


def commands(root: Path) -> dict[str, Command]:
    """Small inputs for each command, and its command line."""
    from tests.helpers import model_project
    from tests.helpers.batch_captures import tiny_capture
    from tests.helpers.exposure_scenes import write_pair_capture
    from tests.run.stages.test_apertures import write_plane_capture

    options = root / "options.toml"
    options.write_text(OPTIONS)
    for name, frames in (("hall", 16), ("yard", 17)):
        tiny_capture(root / name, frames=frames, half=False)
    (root / "batch.toml").write_text("".join(f'[[capture]]\npath = "{name}"\n' for name in ("hall", "yard")))
    write_plane_capture(root / "apertures")
    write_pair_capture(root / "pairs")
    model_project.write_project(root / "project")

    def finished(out: Path) -> bool:
        return (out / "result.json").is_file()

    def all_finished(out: Path) -> bool:
        return len(list(out.rglob("result.json"))) == 2

    config = ("--config", str(options))
    fused = files_of("images", "refocused", "depth", "disparity")
    return {
        "reconstruct": Command(("reconstruct", f"{root}/hall", "{out}", *config), contents, finished),
        "batch": Command(("batch", f"{root}/batch.toml", "{out}", *config), batch_made, all_finished),
        "apply": Command(("apply", f"{root}/project", "{out}", "--factor", "2"), files_of(), Path.is_dir),
        "fuse-apertures": Command(
            ("fuse-apertures", f"{root}/apertures", "{out}", "--refocus", "1", "--threads", "1"), fused, finished
        ),
        "fuse-exposures": Command(("fuse-exposures", f"{root}/pairs", "{out}"), fused, finished),
    }


@dataclasses.dataclass
class Taken:
    """What an undisturbed run took."""

    seconds: float = 0.0
    address_bytes: int = 0
    open_files: int = 0
    largest_bytes: int = 0
    all_bytes: int = 0


def start(command: Command, out: Path, said: Path, **limits: int) -> subprocess.Popen[bytes]:
    """The command line in a process of its own, with limits."""
    known = {"RLIMIT_FSIZE": 0, "RLIMIT_AS": 0, "RLIMIT_NOFILE": 0, **limits}
    given = [text for item in known.items() for text in map(str, item)]
    line = [part.replace("{out}", str(out)) for part in command.line]
    with open(said, "wb") as file:
        return subprocess.Popen(
            [sys.executable, "-c", LIMITED, *given, *line], stdout=file, stderr=file, start_new_session=True
        )


def watch(process: subprocess.Popen[bytes]) -> Taken:
    """Wait for a process, and look at what it takes meanwhile."""
    taken, began = Taken(), time.monotonic()
    while process.poll() is None:
        with contextlib.suppress(OSError, IndexError, ValueError):
            status = Path(f"/proc/{process.pid}/status").read_text()
            taken.address_bytes = max(taken.address_bytes, int(status.split("VmPeak:")[1].split()[0]) << 10)
            taken.open_files = max(taken.open_files, len(os.listdir(f"/proc/{process.pid}/fd")))
        time.sleep(0.02)
    taken.seconds = time.monotonic() - began
    return taken


@contextlib.contextmanager
def small_disk(folder: Path, num_bytes: int) -> Iterator[Callable[[], None]]:
    """A file system of its own at ``folder``; what it yields makes it large."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={num_bytes}", "none", str(folder)], check=True)
    try:
        yield lambda: subprocess.run(["mount", "-o", "remount,size=2g", str(folder)], check=True)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        folder.rmdir()


def faults_of(text: str, code: int, *, killed: bool) -> list[str]:
    """What is wrong with how a run ended."""
    if killed:
        return []
    lines = [line for line in text.splitlines() if line.strip()]
    found = []
    if "Traceback" in text:
        found.append(f"a traceback: {lines[-1] if lines else ''}")
    if code < 0:
        found.append(f"ended by signal {-code}: {lines[-1:]}")
    elif code == 0 and "Traceback" not in text:
        return []
    elif not lines or not (lines[-1].startswith("error: ") or SENTENCE.fullmatch(lines[-1])):
        found.append(f"exit code {code} and no sentence: {lines[-3:]}")
    for word in ("OpenBLAS", "terminate called", "std::bad_alloc", "*** Check failure", "Aborted"):
        if word in text:
            found.append(f"words of a library: {next(line for line in lines if word in line)[:160]}")
    return found


def one(
    command: Command, kind: str, chance: random.Random, taken: Taken, expected: dict[str, bytes], root: Path
) -> tuple[str, list[str]]:
    """A fault, and the run after it: what was done, and what was wrong."""
    said, limits, wrong = root / "said.txt", {}, []
    strength = chance.uniform(0.0, 1.0)
    with contextlib.ExitStack() as stack:
        place, enlarge = root / "place", lambda: None
        if kind == "disk":
            size = int((0.05 + 0.9 * strength) * taken.all_bytes) + 20_000
            enlarge = stack.enter_context(small_disk(place, size))
            told = f"{size / 1e6:.2f} MB of disk"
        else:
            place.mkdir()
            stack.callback(shutil.rmtree, place, ignore_errors=True)
        out = place / "out"
        if kind == "quota":
            limits["RLIMIT_FSIZE"] = int(10 ** chance.uniform(3.0, 6.0)) % max(2000, taken.largest_bytes)
            told = f"files of {limits['RLIMIT_FSIZE']} bytes"
        elif kind == "memory":
            limits["RLIMIT_AS"] = int((0.1 + 0.88 * strength) * taken.address_bytes)
            told = f"{limits['RLIMIT_AS'] / 1e9:.2f} of {taken.address_bytes / 1e9:.2f} GB of address space"
        elif kind == "files":
            limits["RLIMIT_NOFILE"] = chance.randint(4, taken.open_files)
            told = f"{limits['RLIMIT_NOFILE']} of {taken.open_files} open files"
        process = start(command, out, said, **limits)
        after_s = strength * taken.seconds if kind == "kill" else 600.0
        try:
            code = process.wait(after_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            code = process.wait()
            if kind != "kill":
                wrong.append("hung for 600 s")
        if kind == "kill":
            told = f"killed after {after_s:.1f} s"
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, 9)
        text = said.read_text(errors="replace")
        wrong += faults_of(text, code, killed=kind == "kill")
        for log in out.glob("status/*.log"):  # what the captures of a batch said
            said_there = log.read_text(errors="replace")
            if kind != "kill" and "Traceback" in said_there:
                wrong.append(f"a traceback in {log.name}: {said_there.splitlines()[-1]}")
        # apply writes OUT last, and may have been killed after that; it does not write there again
        came_through = code in command.exit_codes or (command.line[0] == "apply" and code < 0 and out.is_dir())
        if command.done(out) and not came_through and code >= 0:
            wrong.append("it failed, and a result is there")
        last = next((line for line in reversed(text.splitlines()) if line.strip()), "")
        enlarge()
        if came_through and command.made(out) != expected:
            wrong.append("it came through with another result")
        if not (command.line[0] == "apply" and came_through):
            code = start(command, out, said).wait()
            if code not in command.exit_codes:
                wrong.append(f"afterwards: exit code {code}: {said.read_text(errors='replace')[-500:]}")
            found = command.made(out) if out.is_dir() else {}
            different = sorted(name for name in expected | found if expected.get(name) != found.get(name))
            if different:
                wrong.append(f"afterwards different: {different[:5]}")
            left = [
                p.name for p in place.rglob("*") if ".partial" in p.name or p.suffix == ".tmp" or "-partial" in p.name
            ]
            if left:
                wrong.append(f"left over: {left}")
    return f"{told}: {last[:150]}", wrong


def main() -> int:
    """Run the study; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", metavar="NAME")
    parser.add_argument("--kinds", nargs="*", default=list(FAULTS), choices=FAULTS)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    cv2.setNumThreads(1)
    keep_colmap_quiet()
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        known = commands(root)
        names = args.commands or list(known)
        whole: dict[str, tuple[Taken, dict[str, bytes]]] = {}
        for name in names:
            command, out = known[name], root / "whole" / name
            out.parent.mkdir(exist_ok=True)
            taken = watch(process := start(command, out, root / "said.txt"))
            if process.returncode not in command.exit_codes:
                print((root / "said.txt").read_text(errors="replace"))
                return 2
            sizes = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
            taken.largest_bytes, taken.all_bytes = max(sizes), sum(sizes)
            whole[name] = taken, command.made(out)
            print(f"{name}: undisturbed {taken}", flush=True)
        bad = 0
        for number in range(args.faults):
            name, kind = names[number % len(names)], args.kinds[number // len(names) % len(args.kinds)]
            if kind == "disk" and os.geteuid() != 0:
                kind = "quota"
            told, wrong = one(known[name], kind, chance, *whole[name], root)
            bad += bool(wrong)
            print(
                f"{number + 1:3} {name:15} {kind:7} {told}" + "".join(f"\n      WRONG: {w}" for w in wrong), flush=True
            )
    print(f"{args.faults} faults, {args.faults - bad} without fault in what they left and said")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
