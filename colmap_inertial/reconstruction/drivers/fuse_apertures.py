"""``fuse-apertures``: the images of a multi-aperture camera alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.options import FuseAperturesOptions
from colmap_inertial.core.types import Frame
from colmap_inertial.imaging.multi_aperture import refocus, require_colours
from colmap_inertial.io.capture import ImageFolder, load_capture
from colmap_inertial.io.files import StrPath, path_in
from colmap_inertial.io.frames import image_names, picture_folders
from colmap_inertial.io.images import read_image
from colmap_inertial.pipeline.run.context import RunContext
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.pipeline.run.runner import fingerprint, remove
from colmap_inertial.pipeline.run.session import open_session
from colmap_inertial.pipeline.stages.apertures import ApertureStage, write_maps
from colmap_inertial.pipeline.stages.frame_folder import FramePaths, encode_image, read_frame_records, write_frames


def fuse_captured(
    capture: StrPath,
    out: StrPath,
    options: FuseAperturesOptions | None = None,
    *,
    progress: Progress = silent,
) -> tuple[Path, ...]:
    """Fuse every exposure of a capture, for images alone: no times and no IMU are needed.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[apertures]``, or its folder.
    out
        A folder that does not exist, or holds a run of the same capture, which is then gone on with: ``images/``, and
        where asked for ``refocused/``, ``disparity/``, ``depth/``.
    options
        Defaults serve.
    progress
        Called with stage, exposures done and exposures in all.

    Returns
    -------
    The fused pictures.

    Raises
    ------
    FormatError, InertialError
        For what cannot be read or does not fit together.
    OutputExistsError
        Where ``out`` holds something else.
    """
    options = options or FuseAperturesOptions()
    loaded = load_capture(Path(capture))
    if loaded.apertures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, "describes no multi-aperture camera: add [images] and [apertures]")
    names, folder = image_names(loaded.frames), loaded.frames.folder
    stage = ApertureStage(pictures=loaded.apertures, options=options.fusion)
    require_colours(loaded.apertures.rig)
    canvas = stage.canvas()
    pictures = picture_folders(loaded)
    with open_session(
        Path(out), loaded.path, options, RunContext(progress=progress), pictures=pictures, command="fuse-apertures"
    ) as session:
        workspace = session.workspace
        root = workspace.root
        kinds = [
            *(["disparity", "depth"] if options.fusion.depth else []),
            *(["refocused"] if options.refocus is not None else []),
        ]

        for kind in {"disparity", "depth", "refocused"} - set(kinds):
            remove(root / kind)

        def work(partial: Sequence[Path]) -> None:
            maps = dict(zip(kinds, partial[2:], strict=True))

            def through(frames: Iterator[Frame]) -> Iterator[Frame]:
                for frame in frames:
                    fused = stage.fused(frame.name, frame.image)
                    if options.fusion.depth:
                        write_maps(maps["disparity"], maps["depth"], frame.name, fused)
                    if options.refocus is not None:
                        shift_px = canvas.disparity(options.refocus)
                        image = refocus(fused.image, fused.disparity_px, shift_px, strength=options.lens_width)
                        target = path_in(maps["refocused"], frame.name)
                        target.parent.mkdir(parents=True, exist_ok=True)
                        encode_image(target, image, path_in(folder, frame.name))
                    yield replace(frame, image=fused.image)

            write_frames(
                (Frame(name=name, image=read_image(path_in(folder, name)), t_s=0.0) for name in names),
                names,
                [through],
                FramePaths(source=folder, images=partial[0], records=partial[1]),
                lambda _, done, total: progress("fusing", done, total),
                least=1,
            )

        inputs = [*(path_in(folder, name) for name in names), *loaded.apertures.files(names)]
        depends = {"capture": loaded, "options": options, "inputs": [fingerprint(path) for path in inputs]}
        outputs = [workspace.images, workspace.frames, *(root / kind for kind in kinds)]
        session.runner.run("frames", depends, outputs, work)
        session.finish(
            {
                "versions": {"colmap_inertial": __version__},
                "capture": str(loaded.path),
                "source": str(folder),
                "frames": [record.name for record in read_frame_records(workspace.frames)],
                "seconds": session.runner.seconds,
            }
        )
        return tuple(workspace.images / name for name in names)
