#!/usr/bin/env python3
"""COLMAP projects in which COLMAP placed cameras wrong: what ``reconstruct`` makes of them.

    python -m scripts.studies.wrong_cameras FOLDER [--projects copies0 blurred1 ...] [--json FILE]

Walks past walls covered with photographs (``../shared/data/sharp_photos``), 32 pictures of 640 px at 2 a second, IMU
of a phone: ``copies`` a stretch of wall hangs twice, with nothing else in sight; ``blurred`` a block of
pictures is blurred by 3 to 8 px; ``carried`` a picture that moves with the camera hides most of a block; ``mixed``
copies and blur; ``clean`` none of it. COLMAP by itself, with its own settings and every pair matched, makes the
project. For each: pictures, those registered in the largest model, how many of these are truly wrong (2
degrees, or 5 % of the path's extent), how many of the wrong ones are named (left out or registered again), sound
ones lost, wrong ones that are still in the metric model, error of the scale and half of its interval (%), whether that
holds the truth, the verdict, and what failed. The scale's truth is that of the cameras that are right.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, UInt8Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.io.files import read_json
from colmap_inertial.model import find_models, num_registered, read_model
from colmap_inertial.tools.simulate import Board, Quad, World
from scripts.common.bench_report import write_report
from scripts.common.walk_scenes import HEIGHT_M, Walk, draw_pictures, write_walk
from scripts.studies.check_euroc import similarity

PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "data" / "sharp_photos"
#: Projects by kind and seed.
PROJECTS = (
    *("clean0", "copies0", "copies1", "copies2", "copies3", "blurred0", "blurred1", "blurred2"),
    *("carried0", "carried1", "mixed0", "mixed1"),
)
FRAMES, RATE_HZ, LAPS = 32, 2.0, 0.3
#: From one photograph to the next along a wall; how many hang twice.
PERIOD_M, COPIED = 1.2, 3
#: A camera is wrong by more than this, of angle and of the path's extent.
WRONG_DEG, WRONG_SHARE = 2.0, 0.05
#: Standard deviations of a block's blur, its pictures, and the share of width and height that is hidden.
BLUR_PX, BLOCK, HIDDEN = (3.0, 8.0), (3, 7), 0.75


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was made of a project; errors of the scale's logarithm."""

    project: str
    registered: int
    wrong: tuple[str, ...]
    named: tuple[str, ...]
    left_out: tuple[str, ...]
    still_wrong: tuple[str, ...]
    verdict: str
    error: float | None
    half_width: float | None
    reasons: tuple[str, ...]

    @property
    def inside(self) -> bool | None:
        """Whether the interval holds the truth; None without a scale."""
        return None if self.error is None or self.half_width is None else abs(self.error) <= self.half_width

    @property
    def failures(self) -> tuple[str, ...]:
        """What must not be: a refusal, or trust in a wrong scale."""
        refused = ("refused",) if self.verdict == "refused" else ()
        return (*refused, *(("trusted and wrong",) if self.verdict == "trusted" and not self.inside else ()))


def world_of_photographs(walk: Walk, rng: np.random.Generator, *, copies: bool) -> World:
    """Walls of photographs without gaps; three of them hang again a wall further, where there are copies."""
    every = sorted(PHOTOS.glob("*.jpg"))
    corners = walk.half_m() * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    quads = []
    hung: list[Float32Array] = []
    first, again = _copied(rng)
    for wall in range(4):
        start, end = (np.array([*corners[(wall + k) % 4], HEIGHT_M]) for k in (0, 1))
        length = float(np.linalg.norm(end - start))
        count = round(length / PERIOD_M)
        edge = (end - start) / count
        for place in range(count):
            photo = _linear(every[rng.integers(len(every))])
            number = len(hung)
            if copies and again <= number < again + COPIED:
                photo = hung[first + number - again]
            hung.append(photo)
            quads.append(
                Quad(corner_m=start + place * edge, edge_u_m=edge, edge_v_m=np.array([0, 0, -HEIGHT_M]), texture=photo)
            )
    return World(quads=tuple(quads), board=Board(), board_corners_m=np.zeros((0, 3)))


def _copied(rng: np.random.Generator) -> tuple[int, int]:
    """Numbers of the first photograph that hangs twice, and of its copy: on the walls that the walk passes.

    It begins in the middle of the second wall, and goes against the order of the photographs.
    """
    first = int(rng.integers(2, 5))
    return first, first + COPIED + 1 + int(rng.integers(0, 3))


def _linear(photo: Path) -> Float32Array:
    picture = cv2.imread(str(photo))
    assert picture is not None, photo
    return (picture[..., ::-1].astype(np.float32) / 255) ** np.float32(2.2)


def altered(pictures: Iterator[UInt8Array], kind: str, rng: np.random.Generator) -> Iterator[UInt8Array]:
    """Pictures of which a block is blurred, or hidden by something that moves with the camera."""
    length = int(rng.integers(*BLOCK, endpoint=True))
    begin = int(rng.integers(4, FRAMES - length - 4))
    photos = sorted(PHOTOS.glob("*.jpg"))
    hides = cv2.imread(str(photos[rng.integers(len(photos))]))
    assert hides is not None
    for i, picture in enumerate(pictures):
        out = picture
        if begin <= i < begin + length and kind in ("blurred", "mixed"):
            out = np.asarray(cv2.GaussianBlur(picture, (0, 0), rng.uniform(*BLUR_PX)), dtype=np.uint8)
        elif begin <= i < begin + length and kind == "carried":
            high, wide = (round(HIDDEN * n) for n in picture.shape[:2])
            # a hand does not hold it still
            y, x = (int((n - m) / 2 + rng.integers(-8, 9)) for n, m in zip(picture.shape, (high, wide), strict=False))
            out = picture.copy()
            out[y : y + high, x : x + wide] = cv2.resize(hides, (wide, high), interpolation=cv2.INTER_AREA)[..., ::-1]
        yield out


def write_project(name: str, folder: Path) -> tuple[Path, Path]:
    """The capture and COLMAP's project of a name, unless they are there."""
    kind, seed = name.rstrip("0123456789"), int(name.lstrip("abcdefghijklmnopqrstuvwxyz"))
    capture, project = folder / name / "capture", folder / name / "project"
    rng = np.random.default_rng([36, PROJECTS.index(name) if name in PROJECTS else 100 + seed])
    walk = Walk(seed=36 + seed, frames=FRAMES, frame_rate_hz=RATE_HZ, laps=LAPS, width=640)
    world = world_of_photographs(walk, rng, copies=kind in ("copies", "mixed"))
    write_walk(walk, capture, altered(draw_pictures(walk, world), kind, rng))
    if not sorted((project / "sparse").glob("*/cameras.bin")):
        subprocess.run(
            [sys.executable, "-m", "scripts.benchmarks.whole", project, "--bare-exhaustive", capture],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return capture, project


def right_cameras(rotation: Array, centre: Array, true_rotation: Array, true_m: Array) -> tuple[BoolArray, float]:
    """Cameras of the largest set that agrees with the truth up to a similarity, and metres per unit of these.

    ``rotation``, ``true_rotation``: (N, 3, 3) world from camera; ``centre``, ``true_m``: (N, 3).
    """
    true_from_model = true_rotation @ rotation.transpose(0, 2, 1)
    trace = np.einsum("aij,bij->ab", true_from_model, true_from_model)
    agree = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))) < WRONG_DEG
    limit_m = WRONG_SHARE * float(np.linalg.norm(np.ptp(true_m, axis=0)))
    best = np.zeros(len(centre), dtype=np.bool_)
    for i in range(len(centre)):
        turned = centre @ true_from_model[i].T
        for j in np.flatnonzero(agree[i]):
            step, true_step = turned[j] - turned[i], true_m[j] - true_m[i]
            if np.linalg.norm(true_step) < 4 * limit_m or np.linalg.norm(step) == 0:
                continue
            scale = float(np.linalg.norm(true_step) / np.linalg.norm(step))
            off_m = np.linalg.norm(scale * (turned - turned[i]) - (true_m - true_m[i]), axis=1)
            found = agree[i] & (off_m < limit_m)
            if found.sum() > best.sum():
                best = found
    return best, similarity(centre[best], true_m[best])[0] if best.sum() > 2 else float("nan")


def poses_of(folder: Path) -> tuple[list[str], Array, Array]:
    """Names, (N, 3, 3) world from camera, and (N, 3) centres of a model."""
    model = read_model(folder)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    rotation = np.array([image.cam_from_world().rotation.matrix().T for image in images])
    return [image.name for image in images], rotation, np.array([image.projection_center() for image in images])


def judge(name: str, folder: Path) -> Outcome:
    """Make a project, run ``reconstruct`` on it, and compare with the truth."""
    capture, project = write_project(name, folder)
    out = folder / name / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "colmap_inertial", "reconstruct", project, out, "--imu", capture]
    told = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    truth = read_json(capture / "truth.json")
    place = {image: i for i, image in enumerate(truth["names"])}
    true_rotation, true_m = matrix_from_quat(np.array(truth["world_from_cam_xyzw"])), np.array(truth["cam_in_world_m"])

    def compare(model: Path) -> tuple[list[str], BoolArray, float]:
        names, rotation, centre = poses_of(model)
        at = [place[image] for image in names]
        return names, *right_cameras(rotation, centre, true_rotation[at], true_m[at])

    names, right, _ = compare(max(find_models(project / "sparse").values(), key=num_registered))
    result = read_json(out / "result.json") if (out / "result.json").is_file() else {"models": []}
    wrong = tuple(image for image, ok in zip(names, right, strict=True) if not ok)
    if not result["models"]:
        return Outcome(
            project=name, registered=len(names), wrong=wrong, named=(), left_out=(), still_wrong=wrong,
            verdict="refused", error=None, half_width=None, reasons=tuple(told.stderr.strip().splitlines()[-3:]),
        )  # fmt: skip
    (model,) = result["models"][:1]
    rotations = model["rotations"] or {}
    left_out = tuple(rotations.get("left_out") or ())
    named = {*left_out, *(rotations.get("registered_again") or ())}
    error, half, still = None, None, wrong
    if model["verdict"] != "refused":
        kept, right_now, metres = compare(out / model["sparse_metric"])
        still = tuple(image for image, ok in zip(kept, right_now, strict=True) if not ok)
        # a metric model is right where its metres are metres
        error, half = -float(np.log(metres)), float(np.log(model["ci95"][1] / model["ci95"][0]) / 2)
    return Outcome(
        project=name,
        registered=len(names),
        wrong=wrong,
        named=tuple(sorted(named & set(wrong))),
        left_out=left_out,
        still_wrong=still,
        verdict=model["verdict"],
        error=error,
        half_width=half,
        reasons=(*model["reasons"], *model["notes"]),
    )


def row(outcome: Outcome) -> str:
    """A line of the table."""
    lost = len(set(outcome.left_out) - set(outcome.wrong))
    error, half = outcome.error, outcome.half_width
    scale = f"{'':>16}" if error is None or half is None else f"{100 * error:8.2f}{100 * half:8.2f}"
    inside = {None: "-", True: "yes", False: "no"}[outcome.inside]
    return (
        f"{outcome.project:<10}{FRAMES:6d}{outcome.registered:6d}{len(outcome.wrong):7d}{len(outcome.named):7d}{lost:6d}"
        f"{len(outcome.still_wrong):7d}{scale}{inside:>8}  {outcome.verdict:<9}{', '.join(outcome.failures)}"
    )


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="takes captures, projects and runs")
    parser.add_argument("--projects", nargs="+", default=PROJECTS, help="kinds and seeds")
    parser.add_argument("--json", type=Path, help="write every outcome")
    args = parser.parse_args(argv)
    head = (
        f"{'':<10}{'of':>6}{'reg.':>6}{'wrong':>7}{'named':>7}{'lost':>6}{'still':>7}{'err%':>8}{'+-%':>8}{'inside':>8}"
    )
    print(head, flush=True)
    outcomes = []
    for name in args.projects:
        outcomes.append(judge(name, args.folder))
        print(row(outcomes[-1]), flush=True)
    print(f"\n{sum(bool(o.failures) for o in outcomes)} of {len(outcomes)} failed")
    if args.json:
        write_report(args.json, {"outcomes": [asdict(outcome) for outcome in outcomes]})


if __name__ == "__main__":
    main()
