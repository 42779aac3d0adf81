"""COLMAP models on disk: finding, reading, timing and rescaling them. The only place where lengths are multiplied."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array, set_fields
from colmap_inertial.core.errors import AlreadyMetricError, FormatError, OutputExistsError, TimingError
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types import (
    CameraModel,
    CameraTrajectory,
    FrameTiming,
    JoinedPart,
    RotationConsensus,
    ScaleEstimate,
    Similarity,
    SolvedMotion,
    Treatment,
)
from colmap_inertial.io.files import StrPath, convert_to_plain, read_json, reader, write_json
from colmap_inertial.io.picture_names import check_image_names
from colmap_inertial.io.stand_ins import what_stands_in
from colmap_inertial.model.pose_covariances import pose_covariances
from colmap_inertial.model.references import check_references
from colmap_inertial.model.rigs import list_posed_frames
from colmap_inertial.model.soundness import add_tracks, check_binary_model, check_values
from colmap_inertial.model.text_model import count_images, text_model_as_binary

if TYPE_CHECKING:
    import pycolmap


#: Written into every folder whose lengths we have changed; its presence means "already metric".
TRANSFORM_FILE = "transform.json"


_MODEL_FILES = ("cameras", "images", "points3D")


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A COLMAP model on its way through the model stages.

    Attributes
    ----------
    reconstruction
        The model in memory. A stage leaves it as it is and returns another one where it changes something
        (``pycolmap.Reconstruction(model.reconstruction)`` is a copy).
    colmap_index
        COLMAP's number, that of its folder in ``sparse/``.
    timing
        When the frames were exposed.
    rectified
        Whether it was mapped from keypoints without the rolling shutter.
    doubts
        What was found wrong with the recording beforehand; with any of them, no scale is trusted.
    rotations
        Which cameras of COLMAP's model agree with the gyroscope, where others were taken from it.
    torn_off
        Of a model that is torn, the images of its smaller parts: models of their own for a stage that joins models.
    scale
        What the inertial estimate said; ``None`` before it.
    similarity
        What was applied to get here from COLMAP's model; ``None`` while it has COLMAP's own units.
    treatments
        What the stages before did, in order.
    observed_px
        By image name, (N, 2) where its keypoints were when COLMAP mapped them, where a stage moved them since.
    parts
        What it was joined of; empty where it is one of COLMAP's models.
    joined_covs
        Of a joined model, (6, 6) covariances of images' positions and rotations against the first image, by name.
    motion
        How the camera moved, where a stage solved for it; without it, the path is smoothed.
    """

    reconstruction: pycolmap.Reconstruction
    colmap_index: int
    timing: FrameTiming
    rectified: bool = False
    doubts: tuple[Fact, ...] = ()
    rotations: RotationConsensus | None = None
    torn_off: tuple[tuple[str, ...], ...] = ()
    scale: ScaleEstimate | None = None
    similarity: Similarity | None = None
    treatments: tuple[Treatment, ...] = ()
    observed_px: Mapping[str, Array] = field(default_factory=dict)
    parts: tuple[JoinedPart, ...] = ()
    joined_covs: Mapping[str, Array] = field(default_factory=dict)
    motion: SolvedMotion | None = None

    def __post_init__(self) -> None:
        doubts = tuple(map(as_fact, self.doubts))
        set_fields(self, doubts=doubts, scale=None if self.scale is None else add_doubts(self.scale, doubts))

    def scaled(self, estimate: ScaleEstimate, similarity: Similarity | None) -> Model:
        """Apply a scale estimate, unless its units were refused.

        Raises
        ------
        AlreadyMetricError
            Where a stage before has scaled the model.
        """
        if self.similarity is not None:
            raise AlreadyMetricError(
                Fact("scaled-before", model=self.colmap_index, provenance=self.similarity.provenance)
            )
        reconstruction = self.reconstruction if similarity is None else transform_model(self.reconstruction, similarity)
        return replace(
            self,
            reconstruction=reconstruction,
            scale=estimate,
            similarity=similarity,
        )

    def rescaled(self, estimate: ScaleEstimate, factor: float) -> Model:
        """A metric model whose metres were found to be another length.

        Parameters
        ----------
        estimate
            Of COLMAP's model, with the new length.
        factor
            New lengths over those before.
        """
        similarity = self.similarity
        if similarity is None or estimate.sigma_log is None:
            raise ValueError("only a metric model is scaled again, by a scale that was not refused")
        longer = Similarity(
            scale=factor, rotation_xyzw=np.array([0, 0, 0, 1.0]), translation_m=np.zeros(3), cov=np.zeros((7, 7))
        )
        moved = np.diag([*(factor,) * 3, 1.0, 1.0, 1.0])
        return replace(
            self,
            reconstruction=transform_model(self.reconstruction, longer),
            scale=estimate,
            similarity=_scaled_again(similarity, factor, estimate.sigma_log),
            parts=tuple(
                replace(
                    part,
                    similarity=_scaled_again(part.similarity, factor, float(np.sqrt(part.similarity.cov[0, 0]))),
                    sigma_m=factor * part.sigma_m,
                )
                for part in self.parts
            ),
            joined_covs={name: moved @ cov @ moved for name, cov in self.joined_covs.items()},
            motion=None if self.motion is None else self.motion.scaled(factor),
        )


def _scaled_again(similarity: Similarity, factor: float, sigma_log: float) -> Similarity:
    """A similarity to lengths that are larger by a factor, with another standard deviation of the scale."""
    before = float(np.sqrt(similarity.cov[0, 0]))
    by = np.array([sigma_log / before if before > 0 else 1.0, 1.0, 1.0, 1.0, factor, factor, factor])
    cov = similarity.cov * np.outer(by, by)
    cov[0, 0] = sigma_log**2
    return replace(
        similarity, scale=factor * similarity.scale, translation_m=factor * similarity.translation_m, cov=cov
    )


def add_doubts(estimate: ScaleEstimate, doubts: Sequence[Fact]) -> ScaleEstimate:
    """An estimate that is weak at most where there are doubts, which are its first reasons."""
    if not doubts:
        return estimate
    verdict = "weak" if estimate.verdict == "trusted" else estimate.verdict
    new = [fact for fact in map(as_fact, doubts) if fact not in estimate.reasons]
    return replace(estimate, verdict=verdict, reasons=(*new, *estimate.reasons))


def model_format(folder: Path) -> str | None:
    """``".bin"`` or ``".txt"`` where the folder holds a COLMAP model (binary first), else ``None``."""
    return next(iter(model_formats(folder)), None)


def require_format(folder: Path) -> str:
    """:func:`model_format`; a :class:`FormatError` where the folder holds no model."""
    suffix = model_format(folder)
    if suffix is None:
        raise FormatError(folder, _why_no_model(folder))
    return suffix


def _why_no_model(folder: Path) -> Fact:
    """What is missing in a folder, and whether a cloud drive keeps it."""
    if folder.is_file():
        with open(folder, "rb") as file:
            return what_stands_in(file.read(512)) or Fact("file-for-folder")
    for suffix in (".bin", ".txt"):
        missing = [name + suffix for name in _MODEL_FILES if not (folder / (name + suffix)).is_file()]
        if any((folder / f".{name}.icloud").is_file() for name in missing):
            return Fact("kept-in-cloud", names=missing)
        if len(missing) < len(_MODEL_FILES):
            return Fact("model-incomplete", names=missing)
    return Fact("no-model-here")


def model_formats(folder: Path) -> list[str]:
    """The formats in which the folder holds a COLMAP model, binary first."""
    return [s for s in (".bin", ".txt") if all((folder / f"{name}{s}").is_file() for name in _MODEL_FILES)]


def model_files(folder: Path, suffix: str) -> list[Path]:
    """The files of a model that are there in one format, rigs and frames among them."""
    names = (*_MODEL_FILES, "rigs", "frames")
    return [folder / f"{name}{suffix}" for name in names if (folder / f"{name}{suffix}").is_file()]


def find_models(folder: StrPath) -> dict[int, Path]:
    """The COLMAP models in a folder: itself (as number 0), or its numbered subfolders.

    Raises
    ------
    FormatError
        When there is none.
    """
    folder = Path(folder)
    if model_format(folder) is not None:
        return {0: folder}
    numbered = [path for path in folder.iterdir() if path.name.isdigit()] if folder.is_dir() else []
    models = {int(path.name): path for path in numbered if model_format(path) is not None}
    if not models:
        require_format(folder)
    return dict(sorted(models.items()))


def num_registered(folder: Path) -> int:
    """The number of registered images of a model, without reading it.

    Raises
    ------
    FormatError
        When the folder holds no model.
    """
    suffix = require_format(folder)
    file = folder / f"images{suffix}"
    if suffix == ".bin":
        with open(file, "rb") as opened:
            return int.from_bytes(opened.read(8), "little")
    return count_images(file)


@reader("a COLMAP model")
def read_model(folder: StrPath, suffix: str | None = None, *, unique_names: bool = True) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, whatever program wrote it.

    What names something that the model lacks counts as naming nothing; the user is told
    (:mod:`~colmap_inertial.model.notes`).

    Parameters
    ----------
    folder
        The model.
    suffix
        ``".bin"`` or ``".txt"`` where it has to be this one; otherwise what ``model_format`` says.
    unique_names
        Whether images that share a name are refused; else the user is told.

    Raises
    ------
    FormatError
        When the folder holds no model, a damaged one, or one whose names or numbers cannot be.
    """
    folder = Path(folder)
    suffix = suffix or require_format(folder)
    if suffix == ".bin":
        check_binary_model(folder)
        files = {path.stem: path.read_bytes() for path in model_files(folder, suffix)}
    else:
        files = text_model_as_binary(folder)
    sound = check_references(files, folder, suffix, unique_names=unique_names)
    load_pycolmap()
    try:
        if suffix == ".bin" and not sound.changed:
            reconstruction = _read_from(folder)
        else:
            reconstruction = _read_files({**files, **sound.changed})
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise FormatError(folder, Fact("model-not-read", detail=str(error))) from error
    if reconstruction.num_reg_images() == 0:
        raise FormatError(folder, Fact("no-registered-image"))
    check_values(reconstruction, folder, suffix)
    check_image_names((image.name for image in reconstruction.images.values()), folder / f"images{suffix}")
    add_tracks(reconstruction, sound.untracked, folder / f"points3D{suffix}")
    return reconstruction


def _read_from(folder: Path) -> pycolmap.Reconstruction:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_binary(str(folder))
    return reconstruction


def _read_files(files: Mapping[str, bytes]) -> pycolmap.Reconstruction:
    with tempfile.TemporaryDirectory(prefix="colmap-inertial-") as folder:
        for name, data in files.items():
            (Path(folder) / f"{name}.bin").write_bytes(data)
        return _read_from(Path(folder))


def colmap_camera(camera: CameraModel, camera_id: int = 1) -> pycolmap.Camera:
    """The pycolmap camera of our intrinsics.

    Raises
    ------
    ValueError
        When the model's name or the number of parameters is not COLMAP's.
    """
    load_pycolmap()
    import pycolmap

    try:
        built = pycolmap.Camera(
            camera_id=camera_id, model=camera.model, width=camera.width, height=camera.height, params=camera.params
        )
    except (AttributeError, RuntimeError, KeyError) as error:
        raise ValueError(f"{camera.model} is no COLMAP camera model: {error}") from error
    if not built.verify_params():
        raise ValueError(f"COLMAP's {camera.model} takes {built.params_info}, got {len(camera.params)} values")
    return built


def trajectory_from_model(
    reconstruction: pycolmap.Reconstruction, timing: FrameTiming, *, covariances: bool = True
) -> tuple[CameraTrajectory, tuple[Fact, ...]]:
    """Camera poses of a model in the order of time.

    Parameters
    ----------
    reconstruction
        A COLMAP model.
    timing
        Frame times; joined with the images by name.
    covariances
        Whether the poses' covariances are of use: they take longer than all the rest.

    Returns
    -------
    CameraTrajectory, tuple of Fact
        The poses at mid-exposure of the middle row, in model units, with covariances given the points where the
        observations determine them, and what was left out.

    Raises
    ------
    TimingError
        When fewer than two images have a time.
    """
    t_of = dict(zip(timing.names, timing.pose_t_s(), strict=True))
    frames = list_posed_frames(reconstruction)
    named = [(next((image.name for image in frame.images if image.name in t_of), ""), frame) for frame in frames]
    timed = sorted(((name, frame) for name, frame in named if name), key=lambda entry: float(t_of[entry[0]]))
    if len(timed) < 2:
        example = frames[0].images[0].name if frames else "none"
        raise TimingError(
            Fact("names-disagree", timed=len(timed), frames=len(frames), example=example, named=timing.names[0])
        )
    notes: tuple[Fact, ...] = ()
    if len(timed) < len(frames):
        notes = (Fact("images-without-time", images=len(frames) - len(timed), frames=len(frames)),)
    posed = [frame for _, frame in timed]
    trajectory = CameraTrajectory(
        names=tuple(name for name, _ in timed),
        t_s=np.array([t_of[name] for name, _ in timed]),
        cam_from_world_xyzw=np.array([frame.pose.rotation.quat for frame in posed]),
        cam_in_world=np.array([frame.centre() for frame in posed]),
        epoch_ns=timing.epoch_ns,
        pose_cov=pose_covariances(reconstruction, posed) if covariances else None,
    )
    return trajectory, notes


def similarity_as_json(similarity: Similarity) -> dict[str, object]:
    """The similarity's fields in JSON types; ``undoes`` where it takes another one back."""
    fields = dict(convert_to_plain(similarity))
    if similarity.undoes is None:
        del fields["undoes"]
    return fields


def is_metric(folder: Path) -> bool:
    """Whether a folder's lengths were already changed by us: other programs' files may have that name."""
    path = folder / TRANSFORM_FILE
    if not path.is_file():
        return False
    try:
        record = read_json(path)
    except FormatError:
        return False
    ours = isinstance(record.get("provenance"), str) and ("rotation_xyzw" in record or "models" in record)
    return ours


def apply_similarity(source: StrPath, target: StrPath, similarity: Similarity) -> None:
    """Write a transformed copy of a COLMAP model, in the source's format; the source stays as it is.

    Parameters
    ----------
    source
        A COLMAP model folder.
    target
        A folder that does not exist yet. It appears whole or not at all.
    similarity
        Target from source.

    Raises
    ------
    AlreadyMetricError
        When the source already carries a similarity of ours.
    OutputExistsError
        When the target exists.
    FormatError
        When the source is no COLMAP model.
    """
    source, target = Path(source), Path(target)
    if is_metric(source):
        provenance = read_json(source / TRANSFORM_FILE).get("provenance", "unknown")
        raise AlreadyMetricError(Fact("metric-already", folder=str(source), provenance=provenance))
    if target.exists():
        raise OutputExistsError(Fact("target-exists", path=str(target)))
    write_model(transform_model(read_model(source), similarity), target, similarity, suffix=model_format(source))


def transform_model(reconstruction: pycolmap.Reconstruction, similarity: Similarity) -> pycolmap.Reconstruction:
    """Make a transformed copy of a model in memory."""
    import pycolmap

    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation_xyzw)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation_m))
    return copy


def write_model(
    reconstruction: pycolmap.Reconstruction, target: Path, similarity: Similarity, *, suffix: str | None = ".bin"
) -> None:
    """Write a transformed model to a new folder, whole or not at all, with the similarity that was applied.

    Parameters
    ----------
    suffix
        ``".bin"`` or ``".txt"``.
    """
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_files(reconstruction, partial, suffix)
    write_json(partial / TRANSFORM_FILE, similarity_as_json(similarity))
    os.replace(partial, target)


def write_files(reconstruction: pycolmap.Reconstruction, folder: Path, suffix: str | None) -> None:
    """Write a model's files into a folder that is there, as ``".txt"`` or ``".bin"``."""
    (reconstruction.write_text if suffix == ".txt" else reconstruction.write_binary)(str(folder))


def mean_reprojection_error_px(reconstruction: pycolmap.Reconstruction) -> float:
    """Mean over all observations, computed afresh rather than read from the file."""
    reconstruction.update_point_3d_errors()
    return float(reconstruction.compute_mean_reprojection_error())


def summarize(reconstruction: pycolmap.Reconstruction) -> dict[str, int | float]:
    """Counts and mean reprojection error, as COLMAP's model analyzer gives them."""
    return {
        "registered_images": reconstruction.num_reg_images(),
        "points": reconstruction.num_points3D(),
        "observations": reconstruction.compute_num_observations(),
        "mean_reprojection_error_px": mean_reprojection_error_px(reconstruction),
    }


def load_pycolmap() -> None:
    """Load it, and keep our answer to SIGTERM: its logging library takes it away and prints a trace in place of it."""
    first = "pycolmap" not in sys.modules
    import pycolmap  # noqa: F401

    if not first or threading.current_thread() is not threading.main_thread():
        return
    ours = signal.getsignal(signal.SIGTERM)  # what Python was told last, which loading does not change
    if ours is not None:
        signal.signal(signal.SIGTERM, ours)


def points_of_features(image: pycolmap.Image) -> Int64Array:
    """Point numbers of an image's features; -1 without a point."""
    points = np.full(image.num_points2D(), -1, dtype=np.int64)
    seen = np.array(image.get_observation_point2D_idxs(), dtype=np.intp)
    points[seen] = [point.point3D_id for point in image.get_observation_points2D()]
    return points
