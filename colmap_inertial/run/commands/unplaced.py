"""Frames that COLMAP saw and placed in no model, with the reason that its database shows."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Treatment
from colmap_inertial.model import read_model
from colmap_inertial.model.database import open_read_only
from colmap_inertial.run.stages.frame_folder import FrameRecord

log = logging.getLogger(__name__)

#: An image with fewer features matches nothing: COLMAP takes no pair of fewer than 15 that agree.
_FEW_FEATURES = 30
#: COLMAP's number of a pair is this times the smaller number of an image, plus the larger one.
_PAIR = 2147483647


def note_unplaced(records: Sequence[FrameRecord], models: Iterable[Path], database: Path) -> tuple[FrameRecord, ...]:
    """The records with the reason added to those of frames that are in no model.

    Parameters
    ----------
    records
        Of all frames.
    models
        Folders of COLMAP's models.
    database
        COLMAP's; where it is gone, or cannot be read, it says nothing.
    """
    placed: set[str] = set()
    for folder in models:
        placed |= {image.name for image in read_model(folder).images.values() if image.has_pose}
    unplaced = {record.name for record in records if record.used} - placed
    if not unplaced or not database.is_file():
        return tuple(records)
    try:
        reasons = _read_reasons(database, unplaced, placed)
    except InertialError as error:
        log.info("why images were not placed is not known: %s", error)
        return tuple(records)
    return tuple(
        replace(record, treatments=(*record.treatments, Treatment(stage="mapping", reason=reasons[record.name])))
        if record.name in reasons
        else record
        for record in records
    )


def _read_reasons(database: Path, unplaced: set[str], placed: set[str]) -> dict[str, Fact]:
    """Why each image is in no model, by its features, and those of its pairs that agree."""
    with open_read_only(database) as connection, closing(connection.cursor()) as rows:
        number = {name: int(i) for i, name in rows.execute("SELECT image_id, name FROM images")}
        features = {int(i): int(count) for i, count in rows.execute("SELECT image_id, rows FROM keypoints")}
        pairs = rows.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0").fetchall()
    own = {number[name]: name for name in unplaced if name in number}
    in_models = {number[name] for name in placed if name in number}
    matched: dict[str, tuple[int, int]] = dict.fromkeys(own.values(), (0, 0))
    for pair, count in pairs:
        first, second = divmod(int(pair), _PAIR)
        for image, other in ((first, second), (second, first)):
            if image in own:
                most, images = matched[own[image]]
                near = other in in_models
                matched[own[image]] = (max(most, int(count) if near else 0), images + near)
    out = {}
    for name, (most, images) in matched.items():
        found = features.get(number[name], 0)
        if found < _FEW_FEATURES:
            out[name] = Fact("image-without-features", features=found)
        elif images == 0:
            out[name] = Fact("image-without-matches", features=found)
        else:
            out[name] = Fact("image-not-placed", images=images, matches=most)
    return out
