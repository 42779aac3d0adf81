"""Features and matches of others: a COLMAP database of the capture's images, checked, and copied into the run's own.

The run's database is made anew, with its own cameras and numbers of images; so the schema of the given one does not
matter, and what pycolmap cannot read is said before pycolmap is asked: it would end the process.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import (
    KeypointRecords,
    apply_keypoint_stages,
    register_images,
    writing_database,
)
from colmap_inertial.colmap.views.relative_track import FramePair
from colmap_inertial.colmap.views.two_views import Features, open_features
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import check_names
from colmap_inertial.io.sqlite import open_foreign
from colmap_inertial.model.database import SIDE_FILES, copy_database

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

_TABLES = {"cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries"}
#: Rows whose data are not as long as they say, by table; without data, there are no rows.
_LENGTHS = {
    "keypoints": "cols NOT IN (2, 4, 6) OR length(data) != 4 * rows * cols",
    "descriptors": "length(data) != rows * cols",
    "matches": "cols != 2 OR length(data) != 4 * rows * cols",
    "two_view_geometries": "cols != 2 OR length(data) != 4 * rows * cols",
}
#: COLMAP's SIFT: the number of the type, and bytes of a descriptor.
_SIFT, _SIFT_BYTES = 0, 128


@dataclass(frozen=True, kw_only=True)
class GivenDatabase:
    """A COLMAP database that somebody else filled.

    Attributes
    ----------
    path
        The file, which is only read.
    sizes
        Width and height of its images' cameras, by image name.
    """

    path: Path
    sizes: Mapping[str, tuple[int, int]]

    def names_in_time(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of a capture's images, in order of time, that it has.

        Raises
        ------
        FormatError
            Where it has images that the capture does not have.
        """
        strange = sorted(self.sizes.keys() - set(names))
        if strange:
            raise FormatError(
                self.path,
                Fact(
                    "images-of-another-capture",
                    count=len(strange),
                    of=len(self.sizes),
                    image=strange[0],
                    expected=names[0],
                ),
            )
        return tuple(name for name in names if name in self.sizes)

    def require_size(self, name: str, width: int, height: int) -> None:
        """Raise ``FormatError`` where it has an image in another size than the capture."""
        size = self.sizes[name]
        if size != (width, height):
            raise FormatError(
                self.path,
                Fact(
                    "given-image-of-another-size",
                    image=name,
                    width=size[0],
                    height=size[1],
                    capture_width=width,
                    capture_height=height,
                ),
            )


def read_given(path: Path) -> GivenDatabase:
    """Check a COLMAP database; pycolmap does not open it.

    Raises
    ------
    FormatError
        For a file that is no COLMAP database, damaged or in use, and for one that has nothing to continue with.
    """
    if not path.is_file():
        raise FormatError(path, Fact("no-given-database"))
    if any(beside.is_file() and beside.stat().st_size for beside in _side_files(path)):
        raise FormatError(path, Fact("database-in-use"))
    with open_foreign(path) as database:
        return _read_given(database, path)


def _side_files(path: Path) -> Iterator[Path]:
    return (path.with_name(path.name + suffix) for suffix in SIDE_FILES)


def _read_given(database: sqlite3.Connection, path: Path) -> GivenDatabase:
    answer = database.execute("PRAGMA quick_check(1)").fetchone()[0]
    if answer != "ok":
        raise FormatError(path, Fact("database-check-failed", detail=answer))
    missing = _TABLES - {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if missing:
        raise FormatError(path, Fact("no-colmap-database", table=min(missing)))
    query = "SELECT name, width, height FROM images LEFT JOIN cameras USING (camera_id)"
    sizes = {name: (width, height) for name, width, height in database.execute(query)}
    check_names(sizes, path)
    if None in {width for width, _ in sizes.values()}:
        raise FormatError(path, Fact("image-without-camera"))
    for table, wrong in _LENGTHS.items():
        (count,) = database.execute(f"SELECT COUNT(*) FROM {table} WHERE rows > 0 AND ({wrong})").fetchone()
        if count:
            raise FormatError(path, Fact("rows-of-other-length", count=count, table=table))
    (keypoints,) = database.execute("SELECT COUNT(*) FROM keypoints WHERE rows > 0").fetchone()
    if not keypoints:
        raise FormatError(path, Fact("no-keypoints"))
    if not any(_count(database, table) for table in ("matches", "two_view_geometries")) and not _can_match(database):
        raise FormatError(
            path,
            Fact("matches-missing"),
        )
    return GivenDatabase(path=path, sizes=sizes)


def _count(database: sqlite3.Connection, table: str) -> int:
    return int(database.execute(f"SELECT COUNT(*) FROM {table} WHERE rows > 0").fetchone()[0])


def _can_match(database: sqlite3.Connection) -> bool:
    """Whether all images with keypoints have SIFT descriptors, as COLMAP stores them."""
    typed = "type" in {row[1] for row in database.execute("PRAGMA table_info(descriptors)")}
    (others,) = database.execute(
        "SELECT COUNT(*) FROM keypoints k LEFT JOIN descriptors d USING (image_id) WHERE k.rows > 0 AND "
        f"(d.rows IS NOT k.rows OR d.cols != {_SIFT_BYTES}{f' OR d.type != {_SIFT}' if typed else ''})"
    ).fetchone()
    return not others


def can_match(database: Path) -> bool:
    """Whether pycolmap can match the descriptors of a database of ours."""
    with open_foreign(database) as opened:
        return _can_match(opened)


def import_features(
    given: GivenDatabase,
    images: Path,
    cameras: Mapping[str, CameraModel | None],
    database: Path,
    *,
    keypoint_stages: Sequence[KeypointStage],
    rectified: bool,
    context: RunContext,
) -> KeypointRecords:
    """Fill a new database with the features and matches of a given one.

    Verified pairs are kept where their keypoints stay and their cameras are the same; else their matches are, to be
    verified anew.

    Parameters
    ----------
    images, cameras, database
        As of :func:`~colmap_inertial.colmap.features.extraction.extract_features`; where intrinsics are not known,
        those of the given database count.
    keypoint_stages
        What corrects keypoints.
    rectified
        Whether the keypoints are corrected already, so that the stages only say what was done.

    Returns
    -------
    What the stages did to the keypoints of each image.

    Raises
    ------
    FormatError
        For images of another size, and matches of keypoints that there are not.
    """
    for batch, _ in register_images(images, cameras, database, context):
        log.info("features of %d images from %s", len(batch), given.path)
    copy = context.scratch / "given.db"
    remove(copy)
    copy_database(given.path, copy)
    with open_features(copy) as source, writing_database(database):
        with open_features(database) as target:
            same = _copy_cameras(source, target, given, [name for name in cameras if cameras[name] is None])
            _copy_features(source, target)
        moved = apply_keypoint_stages(database, keypoint_stages, store=not rectified)
        stay = same and (rectified or not keypoint_stages)
        with open_features(database) as target:
            _copy_matches(source, target, given.path, with_geometries=stay)
    remove(copy)
    return moved


def _copy_cameras(source: Features, target: Features, given: GivenDatabase, unknown: Sequence[str]) -> bool:
    """Take the cameras of images that none is known of; whether all are the given ones then."""
    for name, image in target.images.items():
        camera = target.cameras[image.camera_id]
        given.require_size(name, camera.width, camera.height)
    taken = set()
    for name in unknown:
        number = target.images[name].camera_id
        if number not in taken:
            taken.add(number)
            camera = source.camera(name)
            camera.camera_id = number
            target.database.update_camera(camera)
            target.cameras[number] = camera
    return all(_same_camera(source.camera(name), target.camera(name)) for name in target.images)


def _same_camera(first: pycolmap.Camera, second: pycolmap.Camera) -> bool:
    return first.model == second.model and np.array_equal(first.params, second.params)


def _copy_features(source: Features, target: Features) -> None:
    for name, image in target.images.items():
        number = source.images[name].image_id
        keypoints = np.array(source.database.read_keypoints(number), dtype=np.float32)
        target.database.write_keypoints(image.image_id, keypoints.reshape(len(keypoints), -1))
        if source.database.exists_descriptors(number):
            target.database.write_descriptors(image.image_id, source.database.read_descriptors(number))


def _copy_matches(source: Features, target: Features, path: Path, *, with_geometries: bool) -> None:
    import pycolmap

    names = {image.image_id: name for name, image in source.images.items()}
    verified = set(source.database.read_two_view_geometry_num_inliers()[0])
    for pair in sorted(verified.union(source.database.read_num_matches()[0])):
        numbers = pycolmap.pair_id_to_image_pair(pair)
        if not all(names.get(number) in target.images for number in numbers):
            continue
        first, second = (names[number] for number in numbers)
        own = target.images[first].image_id, target.images[second].image_id
        matches = np.array(source.database.read_matches(*numbers), dtype=np.int64).reshape(-1, 2)
        geometry = source.database.read_two_view_geometry(*numbers) if pair in verified else None
        if not len(matches) and geometry is not None:
            matches = np.array(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        limits = [target.database.num_keypoints_for_image(number) for number in own]
        if (matches >= limits).any():
            raise FormatError(path, Fact("matches-of-missing-keypoints", first=first, second=second))
        target.database.write_matches(own[0], own[1], matches.astype(np.uint32))
        if geometry is not None and with_geometries:
            target.database.write_two_view_geometry(own[0], own[1], geometry)


def read_matched_pairs(database: Path, names: Sequence[str]) -> set[FramePair]:
    """Places in time of pairs that have matches, verified or not."""
    with open_features(database) as features:
        return features.find_places(features.database.read_num_matches()[0], names)
