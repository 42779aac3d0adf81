"""Damaged output folders: the next run against one in a folder that nobody touched.

    python -m scripts.studies.heal [--trials 200] [--first 1] [--seed 0] [--commands NAME ...]

Needs the checkout and the extra ``dev``. Finished and half-finished folders of reconstruct (of a capture, of a project,
and of pictures with ``--scale-from``), deblur and batch, finished ones in which a run with other options was refused,
and what export reads, get one to three faults each: a file or folder is deleted, a file cut off or written over, or a
link to outside planted in its place or beside. Then the command runs once more. Either all is as in the folder that
nobody touched, byte for byte but for times, stamps, logs and reports, which say what was made again (of deblur, whose
threads do not decide, too); or it ends with exit code 2 and a sentence that says what to do, and when that is done the
next run comes through with the same. Nothing outside is changed or copied. Exit code 1 otherwise.
"""

import argparse
import contextlib
import io
import json
import os
import random
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.cli import main as command_line
from colmap_inertial.core.errors import OutputExistsError
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.run.commands.images_alone import deblur_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.steps.config import config_as_toml
from tests.helpers.batch_captures import FRAMES, TINY, tiny_capture

#: What a stranger would like to have: no byte of it may come into an output folder.
SECRET = b"nobody's business"
#: Names that a link is planted under, beside those that are there.
NAMES = ("log.txt", "config.toml", "colmap", "dense", "images", "sparse", "validation", ".stages/project")
#: Change from day to day and run to run, or say how long it took.
VOLATILE = re.compile(
    r".*\.stages/.*|(.*/)?log\.txt|status/.*|summary\..*|(.*/)?report\.(html|json)|.*/recording\.json"
)
#: A model that is readable may have been edited on purpose: it is exported as it is.
EDITED = ("delete", "cut", "link")
#: What is not made again, and what to do about it.
REFUSED = re.compile(
    r"error: .*(is a link to .* remove it|is not empty; choose another|choose another folder|remove this one|"
    r"choose a new one|rename or remove it|(start|run) (it|that|its run) again|no such folder|is missing).*",
    re.DOTALL,
)


#: In the first frames of the example scene.
_BOARD = "checkerboard:8x6:0.04"


class Stopped(BaseException):
    """Ends a run before a step."""


@dataclass(frozen=True)
class StopBefore:
    """Progress that ends a run where a step begins."""

    step: str

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Nothing is shown."""

    def kept(self, step: str, /) -> None:
        """Nothing is said."""

    def noted(self, sentence: str, /) -> None:
        """Nothing is said."""

    def began(self, step: str, outputs: object, /) -> None:
        """End it."""
        if step == self.step:
            raise Stopped


@dataclass(frozen=True)
class Command:
    """A command line with ``{out}`` in it; what begins a folder until a step, and what a finished one refuses."""

    line: tuple[str, ...]
    begin: Callable[[Path, StopBefore], object] | None = None
    change: Callable[[Path, StopBefore], object] | None = None
    steps: tuple[str, ...] = ()
    made_in: str = "out"
    faults: tuple[str, ...] = ("delete", "cut", "overwrite", "link")


def made(folder: Path, *places: Path) -> dict[str, object]:
    """What a run made, by path, as far as it must not depend on what happened before, nor on where it happened."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or VOLATILE.fullmatch(name):
            continue
        data = path.read_bytes()
        for place in places:
            data = data.replace(str(place).encode(), b"place")
        if path.name == "result.json":
            found[name] = _without_times(json.loads(data))
        elif path.suffix == ".db":
            found[name] = data[:24] + data[28:92] + data[100:]  # how often it was opened
        else:
            found[name] = data
    return found


def _without_times(value: object) -> object:
    if isinstance(value, dict):
        return {key: _without_times(one) for key, one in value.items() if key not in ("seconds", "runtime_s")}
    return [_without_times(one) for one in value] if isinstance(value, list) else value


def commands(root: Path) -> dict[str, Command]:
    """Small inputs, and the commands on them."""
    from tests.helpers.corner_scene import CALIBRATED, CornerScene

    (root / "options.toml").write_text(config_as_toml(TINY))
    for name, frames in (("hall", FRAMES), ("yard", FRAMES - 1)):
        tiny_capture(root / name, frames=frames, half=False)  # the board is found in it
    (root / "batch.toml").write_text("".join(f'[[capture]]\npath = "{name}"\n' for name in ("hall", "yard")))
    CornerScene.make(exposure_s=0.03, readout_s=0.0, frames=8).write(root / "dim", extra=CALIBRATED)
    reconstruct(root / "hall", root / "whole" / "reconstruct", TINY)
    shutil.copytree(root / "whole" / "reconstruct" / "colmap", root / "project")
    source, options = ProjectOptions(imu=root / "hall"), ReconstructOptions(deterministic=True)
    downward = replace(options, world="y-down")
    config = ("--config", str(root / "options.toml"))
    project = (str(root / "project"), "{out}", "--imu", str(root / "hall"), "--deterministic")
    return {
        "reconstruct": Command(
            ("reconstruct", str(root / "hall"), "{out}", *config),
            lambda out, stop: reconstruct(root / "hall", out, TINY, progress=stop),
            lambda out, stop: reconstruct(root / "hall", out, replace(TINY, world="y-down", seed=1), progress=stop),
            ("frames", "matches", "features", "mapping", "images", "metric"),
        ),
        "project": Command(
            ("reconstruct", *project),
            lambda out, stop: reconstruct_project(root / "project", out, source, options, progress=stop),
            lambda out, stop: reconstruct_project(root / "project", out, source, downward, progress=stop),
            ("metric", "apply"),
        ),
        "deblur": Command(
            ("deblur", str(root / "dim"), "{out}"),
            lambda out, stop: deblur_capture(root / "dim", out, progress=stop),
            lambda out, stop: deblur_capture(root / "dim", out, method="path", progress=stop),
            ("frames",),
        ),
        "batch": Command(
            ("batch", str(root / "batch.toml"), "{out}", *config),
            lambda out, stop: _half_of_a_batch(root, out, stop),
            steps=("matches", "metric"),
        ),
        "reference": Command(
            ("reconstruct", str(root / "hall"), "{out}", *config, "--scale-from", "target", "--target", _BOARD),
            lambda out, _: shutil.copytree(root / "whole" / "reference" / "colmap", out / "colmap"),
            steps=("validation",),
        ),
        "export": Command(("export", "{out}", "{dest}", "--for", "nerfstudio"), made_in="dest", faults=EDITED),
    }


def _half_of_a_batch(root: Path, out: Path, stop: StopBefore) -> None:
    shutil.copytree(root / "whole" / "batch", out)
    shutil.rmtree(out / "hall")
    reconstruct(root / "hall", out / "hall", TINY, progress=stop)


def run(line: tuple[str, ...], out: Path, dest: Path) -> tuple[int, str]:
    """The command's exit code and what it said."""
    said, code = io.StringIO(), 0
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            command_line([part.replace("{out}", str(out)).replace("{dest}", str(dest)) for part in line])
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception as error:
            return -1, f"{type(error).__name__}: {error}"
    return code, said.getvalue()


def draw_path(folder: Path, chance: random.Random) -> Path:
    """A file or folder inside, each branch as likely as the other."""
    path = folder
    while True:
        inside = sorted(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
        if not inside or (path != folder and chance.random() < 0.3):
            return path
        path = chance.choice(inside)


def damage(out: Path, outside: Path, chance: random.Random, kinds: tuple[str, ...]) -> str:
    """One fault; what was done."""
    kind, path = chance.choice(kinds), draw_path(out, chance)
    if kind == "link":
        path = path if chance.random() < 0.5 else out / chance.choice(NAMES)
        target = outside / f"link{chance.randrange(10**6)}"
        if path.is_dir():
            shutil.move(path, target)  # what is there looks right
        else:
            target.mkdir()
            target = target / path.name
            if path.is_file():
                shutil.move(path, target)
            else:
                target.write_bytes(SECRET)
        if not path.parent.is_dir():
            return "nothing"
        path.symlink_to(target)
    elif kind == "delete" or path.is_symlink() or path.is_dir() or not path.stat().st_size:
        kind = "delete"
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    else:
        data = path.read_bytes()
        at = chance.randrange(len(data))
        os.unlink(path)  # not the file that it is a hard link to
        path.write_bytes(data[:at] if kind == "cut" else data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
    return f"{kind} {path.relative_to(out)}"


def heed(text: str, out: Path) -> None:
    """Do what the sentence says."""
    link = re.search(r"error: (.*?): is a link to ", text.replace("\n", " "))
    if link is not None:
        links = [path for path in out.rglob("*") if path.is_symlink()]
        for path in links:
            path.unlink()
    else:
        shutil.rmtree(out)


def one_trial(
    name: str, command: Command, whole: Path, expected: dict[str, object], chance: random.Random, place: Path
) -> tuple[str, list[str]]:
    """Damage a folder and run its command again: what was done, and what was wrong."""
    out, dest, outside = place / "out", place / "dest", place / "outside"
    outside.mkdir(parents=True)
    told, wrong = "finished", []
    state = chance.choice(("finished", "finished", "begun", "changed"))
    begin = {"begun": command.begin, "changed": command.change}.get(state)
    if begin is None or state == "changed":
        shutil.copytree(whole, out)
    if begin is not None:
        step = chance.choice(command.steps)
        told = f"{state}, stopped before {step}"
        with contextlib.suppress(Stopped, OutputExistsError):
            begin(out, StopBefore(step))
        if state == "changed" and made(out, out) != made(whole, whole):
            wrong.append("a run with other options changed a finished result")
    faults = [
        damage(out, outside, chance, command.faults) for _ in range(chance.choice((1, 1, 2, 3))) if any(out.iterdir())
    ]
    told += f"; {', '.join(faults)}"
    before = {path: path.read_bytes() for path in outside.rglob("*") if path.is_file()}
    code, said = run(command.line, out, dest)
    sentence = said[said.rfind("error: ") :].strip() if "error: " in said else ""
    told += f"; {code} {sentence[:160]}"
    for _ in range(4):
        if code != 2:
            break
        if not REFUSED.fullmatch(" ".join(sentence.split())):
            wrong.append(f"not a sentence that says what to do: {said[-300:]}")
        heed(sentence, out)
        if not out.is_dir() and command.made_in == "dest":
            shutil.copytree(whole, out)
        code, said = run(command.line, out, dest)
        sentence = said[said.rfind("error: ") :].strip() if "error: " in said else ""
    if code:
        wrong.append(f"exit code {code}: {said[-400:]}")
    else:
        found = made(place / command.made_in, out, dest)
        different = sorted(key for key in expected | found if expected.get(key) != found.get(key))
        if name == "batch":  # a finished capture's images, and COLMAP's own, may be deleted
            gone = [f"{folder}/{part}/" for folder in ("hall", "yard") for part in ("images", "colmap")]
            different = [
                key for key in different if not any(key.startswith(g) and not (out / g).exists() for g in gone)
            ]
        if different:
            wrong.append(f"different: {different[:6]}")
    if before != {path: path.read_bytes() for path in outside.rglob("*") if path.is_file()}:
        wrong.append("something outside was changed")
    for path in (*out.rglob("*"), *dest.rglob("*")):
        if path.is_file() and not path.is_symlink() and SECRET in path.read_bytes():
            wrong.append(f"{path} has what is nobody's business")
    return told, wrong


def main(argv: list[str] | None = None) -> int:
    """Run the study; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--first", type=int, default=1, help="number of the first trial: to go on, or see one again")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", metavar="NAME")
    args = parser.parse_args(argv)
    bad = 0
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        known = commands(root)
        names = args.commands or list(known)
        wholes, expected = {}, {}
        for name in names:
            command = known[name]
            whole = root / "whole" / ("reconstruct" if name == "export" else name)
            if not whole.is_dir():
                code, said = run(known["reconstruct"].line if name == "export" else command.line, whole, whole)
                if code:
                    print(said)
                    return 2
            if name == "export":
                run(command.line, whole, root / "exported")
            wholes[name], expected[name] = (
                whole,
                made(root / "exported" if name == "export" else whole, whole, root / "exported"),
            )
            print(f"{name}: {len(expected[name])} files", flush=True)
        for number in range(args.first - 1, args.first - 1 + args.trials):
            name, place = names[number % len(names)], root / "place"
            chance = random.Random(1000 * args.seed + number)
            told, wrong = one_trial(name, known[name], wholes[name], expected[name], chance, place)
            shutil.rmtree(place)
            bad += bool(wrong)
            print(f"{number + 1:3} {name:11} {told}" + "".join(f"\n      WRONG: {w}" for w in wrong), flush=True)
    print(f"{args.trials} trials, {args.trials - bad} as in an untouched folder, or said what to do and then so")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
