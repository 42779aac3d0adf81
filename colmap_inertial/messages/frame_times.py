"""Words of frames and their times: of tables, names, EXIF, recorders and rigs."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import message, state

_HOW = (
    'give a CSV with the header "name,t_s" (or t_ms, t_us, t_ns) and one row for each frame, or put the times into the '
    'file names and set times = "name" with time_unit under [images] in capture.toml'
)


@message(advice=_HOW, joint=": ", example={"path": "times.csv"})
def times_without_header(path: str) -> str:
    return f"{path} has no header"


@message(advice=_HOW, example={"path": "times.csv", "header": "t,x"})
def times_without_names(path: str, header: str) -> str:
    return f"{path} has no column of names (the header is: {header})"


@message(advice=_HOW, example={"path": "times.csv", "count": 0, "header": "name,x"})
def not_one_time_column(path: str, count: int, header: str) -> str:
    return f"{path} has {'several columns' if count else 'no column'} of times (the header is: {header})"


@message(advice=_HOW, joint=": ", example={"path": "images/IMG_1234_5678.jpg", "numbers": ("1234", "5678")})
def name_without_one_time(path: str, numbers: Sequence[str]) -> str:
    what = f"several numbers of one length ({', '.join(numbers)})" if numbers else "no number"
    return f'{path}: the name holds {what}; times = "name" cannot time it'


@message(
    advice=lambda pattern, units: (
        f"give a unit ({', '.join(units)}), the number's place as in 'cam0_{{ns}}_*', or a date with a fraction of the "
        "second as in 'PXL_%Y%m%d_%H%M%S%f'"
    ),
    joint=": ",
    example={"pattern": "IMG_*", "units": ("s", "ms")},
)
def pattern_without_time(pattern: str, units: Sequence[str]) -> str:
    return f"{pattern!r} does not describe how names hold times"


@message(
    advice=lambda count, first, endings, **_: (
        f"convert them to PNG or JPEG and name those, or take their rows out (endings: {', '.join(endings)})"
    ),
    joint=": ",
    example={"count": 3, "first": "a.heic", "endings": (".jpg", ".png")},
)
def names_of_other_pictures(count: int, first: str, endings: Sequence[str]) -> str:
    return f"names {count} files that are not images COLMAP reads (first: {first})"


@message(
    example={"width": 480, "height": 640, "declared_width": 640, "declared_height": 480, "declared_in": "capture.toml"}
)
def picture_of_other_size(width: int, height: int, declared_width: int, declared_height: int, declared_in: str) -> str:
    turned = (width, height) == (declared_height, declared_width)
    return f"is {width}x{height}, but the camera is declared as {declared_width}x{declared_height} ({declared_in})" + (
        "; give images as the sensor was read, not rotated by 90 deg for display" if turned else ""
    )


def _shared_frames(camera: str, found: int, frames: int) -> str:
    return f"[rig.{camera}]: {found} of the main camera's {frames} frames have an image of it"


@message(
    advice="give times, or rename them",
    example={"camera": "left", "found": 3, "frames": 100, "folder": "left", "main": "a.jpg"},
)
def rig_names_differ(camera: str, found: int, frames: int, folder: str, main: str) -> str:
    return f"{_shared_frames(camera, found, frames)} under the same name in {folder} (the main camera has {main})"


@message(
    advice="correct the times, or reconstruct cameras that are not synchronised separately",
    joint=": ",
    example={"camera": "left", "found": 3, "frames": 100, "within_ms": 1.0, "images": 90, "apart_ms": 12.0},
)
def rig_times_differ(camera: str, found: int, frames: int, within_ms: float, images: int, apart_ms: float) -> str:
    return (
        f"{_shared_frames(camera, found, frames)} within {within_ms:g} ms; of its {images} images the nearest one is "
        f"{apart_ms:.3g} ms away (median). Cameras of a rig are triggered together and timed by one clock"
    )


@message(
    advice="give --frame-times, or --video where they were taken from one",
    joint=": ",
    example={"path": "a.jpg", "to_tenths": False},
)
def exif_time_coarse(path: str, to_tenths: bool) -> str:
    tells = "tenths of a second" if to_tenths else "whole seconds"
    return (
        f"{path}: its EXIF gives the time only to {tells} (SubSecTimeOriginal, two digits or more, is needed); a scale "
        "needs the times of its images to some milliseconds"
    )


@message(example={"camera": "left", "image": "left/1.jpg"})
def main_image_in_camera_folder(camera: str, image: str) -> str:
    return f"[rig.{camera}]: the main camera's image {image} lies in a folder of that name"


@message(advice="leave out a camera that ran at another time", example={"together": 3, "frames": 100})
def rig_frames_too_few(together: int, frames: int) -> str:
    return f"[rig]: {together} of the main camera's {frames} frames have an image of every camera"


@message(example={"source": "times.csv", "first": "a.jpg", "second": "b.jpg"})
def frames_at_one_time(source: str, first: str, second: str) -> str:
    return (
        f"{source}: the frames {first} and {second} have the same time. Images of several cameras may share "
        "one where COLMAP's model holds the cameras as a rig; else give the times of one camera's images"
    )


@message(
    advice="give them one time, or map cameras that are not synchronised without a rig",
    joint=": ",
    example={"source": "times.csv", "first": "a.jpg", "last": "b.jpg", "apart_ms": 3.0},
)
def rig_images_apart(source: str, first: str, last: str, apart_ms: float) -> str:
    return (
        f"{source}: {first} and {last} are of one frame of a rig, but their times are {apart_ms:.3g} ms apart. "
        "COLMAP's rig has one pose for both"
    )


@message(example={"path": "images", "folder": "cam0"})
def no_image_in_folder(path: str, folder: str) -> str:
    return f"{path}: no image lies in a folder {folder!r}, as --name-times states"


@message(example={"path": "images/a.jpg", "pattern": "cam0_{ns}"})
def name_fits_no_pattern(path: str, pattern: str) -> str:
    return f"{path}: the name does not fit {pattern!r} (without folder and ending)"


@message(advice='name the time column, for example "t_ns"', example={"path": "times.csv", "width": 3})
def frame_times_without_header(path: str, width: int) -> str:
    return f"{path} has {width} columns and no header"


@message(example={"frame": 7})
def frame_time_not_after(frame: int) -> str:
    return f"the time of frame {frame} is not after the previous one"


@message(advice="correct one of them", example={"path": "times.csv", "written": "ns", "declared": "s"})
def time_units_contradict(path: str, written: str, declared: str) -> str:
    return f"{path}: the header says {written}, time_unit says {declared}"


@message(advice="name the column t_s, t_ms, t_us or t_ns", example={"path": "times.csv"})
def time_unit_missing(path: str) -> str:
    return f"{path} does not state the unit of its times"


@message(advice="name it exposure_s or exposure_ns", joint=": ", example={"column": "exposure"})
def exposure_without_unit(column: str) -> str:
    return f'column "{column}" needs a unit'


state("exposure-not-in-range", "an exposure must be from 0 to 10 s")
state("row-without-name", "a row has no name")


@message(example={"frame": "a.jpg"})
def frame_twice(frame: str) -> str:
    return f"the frame {frame} appears twice"


@message(
    advice='set times under [images] in capture.toml to "name" (with time_unit) or to a CSV with the header "name,t_s"',
    joint=": ",
    example={"folder": "images", "count": 100},
)
def pictures_untimed(folder: str, count: int) -> str:
    return f"{folder}: the times of its {count} images are not known (EXIF is too coarse)"


@message(example={"times": "times.csv", "untimed": 3, "count": 100, "first": "a.jpg"})
def pictures_without_row(times: str, untimed: int, count: int, first: str) -> str:
    return f"{times}: no row for {untimed} of {count} images (first: {first})"


@message(
    advice="give frame_times under [video] in a capture.toml", example={"video": "a.mp4", "frames": 100, "noted": 99}
)
def recorder_noted_other_count(video: str, frames: int, noted: int) -> str:
    return f"{video} has {frames} frames, but its recorder logged the times of {noted}"


@message(example={"times_file": "times.csv", "times": 99, "video": "a.mp4", "frames": 100})
def times_of_other_count(times_file: str, times: int, video: str, frames: int) -> str:
    return f"{times_file} has {times} times, the video {video} has {frames} frames"


@message(example={"times_file": "times.csv", "row": 7})
def frame_times_back(times_file: str, row: int) -> str:
    return f"{times_file}: the times do not increase at row {row}"


state("exif-without-date", "its EXIF has no DateTimeOriginal", advice="give --frame-times")
state("exif-missing", "has no EXIF to take its time from", advice="give --frame-times")
state("exif-damaged", "its EXIF is damaged or empty", advice="give --frame-times")


@message(advice="give --frame-times", example={"path": "images/a.jpg", "other": "b.jpg"})
def exif_offset_of_some(path: str, other: str) -> str:
    return (
        f"{path}: its EXIF does not state the offset from universal time, that of {other} does: their times "
        "cannot be compared"
    )
