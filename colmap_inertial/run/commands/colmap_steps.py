"""Extract, keypoint stages, match, map: COLMAP's steps of a run, into ``colmap/``."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_inertial.colmap.chunks import CHUNKS_FOLDER
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.executable import ColmapExecutable
from colmap_inertial.colmap.features.extraction import (
    KeypointRecords,
    MatchRecord,
    extract_features,
    require_room_for_features,
    write_gravity_priors,
)
from colmap_inertial.colmap.features.given_database import GivenDatabase, import_features, read_given
from colmap_inertial.colmap.installed import InstalledColmap
from colmap_inertial.colmap.mapping.mapper import MapRecord, map_images
from colmap_inertial.colmap.matching.pairing import match_capture
from colmap_inertial.colmap.matching.rigs import (
    FIXED_POSES,
    find_rig_poses,
    match_rig_images,
    poses_are_known,
    write_rig,
)
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.core.types import CameraModel
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.io.capture_rig import RigCamera
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import find_models, read_model
from colmap_inertial.run.stages.frame_folder import FrameRecord
from colmap_inertial.run.steps.session import Session


def run_colmap(
    session: Session,
    recording: Recording,
    records: Sequence[FrameRecord],
    stages: Sequence[KeypointStage],
    gravity: Mapping[str, Array],
    options: ReconstructOptions,
) -> tuple[KeypointRecords, MatchRecord, MapRecord]:
    """Make COLMAP's models of the frames that are used.

    Parameters
    ----------
    recording
        With the times of these frames.
    records
        Of all frames.
    stages
        Of keypoints.
    gravity
        By image name, for COLMAP's global mapper; empty where it shall not know.
    options
        Those of mapping count.

    Returns
    -------
    What the stages did to keypoints, which pairs were matched, and how models were made.

    Raises
    ------
    MappingError
        When COLMAP finds no model.
    """
    workspace, runner, context = session.workspace, session.runner, session.context
    cameras = {record.name: record.camera for record in records if record.used}
    mapping, rig = _decide_refinement(options.mapping, cameras), recording.capture.rig

    def features(partial: Sequence[Path]) -> None:
        folders = [camera.name for camera in rig]
        found_features = _find_features(workspace.colmap_images, cameras, partial[0], stages, options, context, folders)
        write_gravity_priors(partial[0], gravity)
        write_record(partial[1], found_features)

    settings = context.colmap.identity
    depends = {**_identify_extraction(options, context), "stages": stages, "gravity": gravity}
    pairing = {
        **depends,
        "colmap": settings("features", "matches"),
        "pairing": [mapping.pairing, mapping.overlap],
        "gyroscope": [recording.imu, recording.timing, recording.prior, recording.max_offset_s],
    }
    if rig:
        pairing["rig"] = [rig, mapping, settings("mapping")]
    outputs = [workspace.colmap_database, workspace.keypoints, workspace.matches, workspace.orientations]

    def matches(partial: Sequence[Path]) -> None:
        # the database holds the features, too: they are made when there are no matches, and need not stay
        record = workspace.stamps / "keypoints_of_features.json"
        runner.run("features", depends, [workspace.colmap_features, record], features, after=["frames"])
        shutil.copyfile(record, partial[1])
        first_camera = next(iter(cameras.values()), None)
        matched, orientations = match_capture(
            workspace.colmap_features, partial[0], recording, first_camera, mapping, context
        )
        if rig:
            matched = match_rig_images(partial[0], matched, recording.timing.names, rig, context)
            _add_rig(partial[0], workspace.colmap_images, mapping, rig, context)
        write_record(partial[2], matched)
        write_record(partial[3], orientations)
        remove(context.scratch / CHUNKS_FOLDER)

    def models(partial: Sequence[Path]) -> None:
        database, images, own = workspace.colmap_database, workspace.colmap_images, _keep_declared_poses(context, rig)
        in_time = () if rig else recording.timing.names
        judged = read_record(workspace.matches, MatchRecord).judged
        orientations = read_record(workspace.orientations, ImageOrientations)
        record = map_images(
            database, images, partial[0], mapping, own, in_time=in_time, judged=judged, orientations=orientations
        )
        write_record(partial[1], record)

    runner.run("matches", pairing, outputs, matches, after=["frames"])
    decided = {"mapping": options.mapping, "colmap": settings("mapping", "adjustment")}
    runner.run("mapping", decided, [workspace.colmap_sparse, workspace.mapped], models, after=["matches"])
    return (
        read_record(workspace.keypoints, KeypointRecords),
        read_record(workspace.matches, MatchRecord),
        read_record(workspace.mapped, MapRecord),
    )


def _decide_refinement(mapping: MappingOptions, cameras: Mapping[str, CameraModel | None]) -> MappingOptions:
    """Refine the cameras where that was asked for, or else where one is unknown."""
    unknown = any(camera is None for camera in cameras.values())
    return mapping if mapping.refine_intrinsics is not None else replace(mapping, refine_intrinsics=unknown)


def _keep_declared_poses(context: RunContext, rig: Sequence[RigCamera]) -> RunContext:
    """The context in which the mapper keeps declared poses of a rig's cameras, unless the user set otherwise."""
    known = bool(rig) and poses_are_known(rig)
    return replace(context, colmap=context.colmap.after(FIXED_POSES)) if known else context


def _add_rig(
    database: Path, images: Path, mapping: MappingOptions, rig: Sequence[RigCamera], context: RunContext
) -> None:
    """Make the cameras of a database a rig, with declared poses, or those of a model without a rig.

    COLMAP's mapper needs poses to begin with; where they are not declared, it refines them.
    """
    poses = {camera.name: camera.cam_from_reference for camera in rig if camera.cam_from_reference is not None}
    if not poses_are_known(rig):
        apart = context.scratch / "mapped_apart"
        remove(apart)
        map_images(database, images, apart, mapping, context)
        poses = find_rig_poses((read_model(folder) for folder in find_models(apart).values()), rig)
        remove(apart)
    write_rig(database, rig, poses)


def _find_features(
    images: Path,
    cameras: Mapping[str, CameraModel | None],
    database: Path,
    stages: Sequence[KeypointStage],
    options: ReconstructOptions,
    context: RunContext,
    rig: Sequence[str],
) -> KeypointRecords:
    """Features of the images into a new database: found here, by an installed COLMAP, or those of a given database.

    A rig, whose other cameras' folders are named, has features that are found here.
    """
    if options.database is not None:
        given, rectified = read_given(options.database), options.database_images == "rectified"
        return import_features(
            given, images, cameras, database, keypoint_stages=stages, rectified=rectified, context=context
        )
    if context.executable is None:
        return extract_features(
            images, cameras, database, options.mapping, keypoint_stages=stages, context=context, rig=rig
        )
    with tempfile.TemporaryDirectory(dir=context.scratch) as folder:
        theirs = Path(folder) / "installed.db"
        require_room_for_features(theirs, len(cameras), options.mapping)
        installed = InstalledColmap(executable=context.executable, scratch=context.scratch)
        installed.find_features(images, list(cameras), theirs, options.mapping, context.progress)
        given = _read_extracted(theirs, list(cameras), context.executable)
        return import_features(
            given, images, cameras, database, keypoint_stages=stages, rectified=False, context=context
        )


def _read_extracted(database: Path, names: Sequence[str], executable: ColmapExecutable) -> GivenDatabase:
    try:
        given = read_given(database)
    except FormatError as error:
        raise MappingError(Fact("written-database-unusable", program=str(executable.path), why=error.fact)) from error
    missing = sorted(set(names) - given.sizes.keys())
    if missing:
        raise MappingError(
            Fact("features-missing", program=str(executable.path), image=missing[0], others=len(missing) - 1)
        )
    return given


def _identify_extraction(options: ReconstructOptions, context: RunContext) -> dict[str, object]:
    """Values that decide the features, beside the images."""
    chosen: list[object] = [options.database_images]
    if options.database is None:
        names = ("max_image_size", "max_num_features", "first_octave")
        chosen = [getattr(options.mapping, name) for name in names]
    return {
        "extraction": chosen,
        "database": None if options.database is None else fingerprint(options.database),
        "colmap": context.colmap.identity("features"),
        **context.identity(),
    }
