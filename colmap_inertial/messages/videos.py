"""Words of videos that cannot be read, and of the index of MP4 files."""

from __future__ import annotations

from colmap_inertial.messages import message, state


@message(example={"sample": 3, "track": "gpmd", "byte": 5000, "length": 4000})
def sample_beyond_file(sample: int, track: str, byte: int, length: int) -> str:
    return (
        f"is cut off or damaged: sample {sample} of the {track} track at byte {byte} ends beyond the file's {length} "
        "bytes"
    )


@message(example={"box": "stts", "rows": 12, "bytes": 40, "needed": 104})
def mp4_box_cut_off(box: str, rows: int | None, bytes: int, needed: int) -> str:
    of_rows = "" if rows is None else f" with {rows} rows"
    return f"{box}{of_rows} is cut off ({bytes} bytes, {needed} needed)"


def _last(last_s: float | None) -> str:
    return "" if last_s is None else f", the last at {last_s:.3f} s"


@message(example={"held": 90, "listed": 100, "last_s": 3.0})
def video_lacks_frames(held: int, listed: int, last_s: float | None) -> str:
    return f"is cut off: it holds {held} of the {listed} frames that its index lists{_last(last_s)}"


@message(example={"duration_s": 4.0, "frames": 90, "last_s": 3.0})
def video_ends_early(duration_s: float, frames: int, last_s: float) -> str:
    return f"is cut off: it states {duration_s:.3f} s, but holds {frames} frames{_last(last_s)}"


@message(example={"old": (1920, 1080), "new": (1280, 720), "frame_s": 1.0})
def frame_size_changes(old: tuple[int, int], new: tuple[int, int], frame_s: float) -> str:
    return f"changes its size from {old[0]}x{old[1]} to {new[0]}x{new[1]} at {frame_s:.3f} s"


state("no-video-stream", "holds no video stream")
state("cover-picture-alone", "holds only a cover image, no video stream")


@message(example={"after_s": 1.0, "detail": "Invalid data found when processing input"})
def video_damaged(after_s: float | None, detail: str) -> str:
    after = "" if after_s is None else f" after the frame at {after_s:.3f} s"
    return f"is damaged or cut off{after}: {detail}"


@message(example={"what": "GoPro telemetry", "entry": "gpmd"})
def track_missing(what: str, entry: str) -> str:
    return f"holds no {what} (a track of format {entry})"


state("no-video", "holds no video")


@message(example={"entry": "avc1"})
def samples_at_one_time(entry: str) -> str:
    return f"two samples of its {entry} track have the same time"


@message(example={"entry": "avc1"})
def samples_overlap(entry: str) -> str:
    return f"is damaged: the samples of the {entry} track overlap"


@message(example={"box": "'free'", "byte": 100, "size": 4})
def mp4_box_size(box: str, byte: int, size: int) -> str:
    return f"is damaged: the box {box} at byte {byte} states a size of {size} bytes"


@message(example={"byte": 100, "length": 5000})
def mp4_index_cut_off(byte: int, length: int) -> str:
    return f"is cut off: its index at byte {byte} ends beyond the file's {length} bytes"


@message(example={"byte": 100, "size": 5000000000})
def mp4_index_size(byte: int, size: int) -> str:
    return f"is damaged: its index at byte {byte} states a size of {size} bytes"


state("mp4-without-index", "holds no index (moov): the recording was not finished, or the file is cut off")


@message(example={"box": "'trak'", "size": 500, "left": 40})
def mp4_box_beyond(box: str, size: int, left: int) -> str:
    return f"the box {box} states a size of {size} bytes where {left} are left"


state("mp4-timescale-zero", "a timescale of 0")


@message(example={"count": 1000, "sample_bytes": 5000})
def mp4_samples_beyond(count: int, sample_bytes: int) -> str:
    return f"stsz states {count} samples of {sample_bytes} bytes, more than the file holds"


@message(example={"table": "stts", "listed": 99, "count": 100})
def mp4_other_count(table: str, listed: int, count: int) -> str:
    return f"is damaged: {table} lists {listed} samples where stsz lists {count}"


state("mp4-chunks-unordered", "is damaged: stsc does not list its chunks in order")


@message(example={"held": 99, "count": 100})
def mp4_chunks_other_count(held: int, count: int) -> str:
    return f"is damaged: chunks hold {held} samples where stsz lists {count}"


state("no-video-frames", "holds no video frames")


@message(advice="give frame_times under [video] in capture.toml", example={"path": "a.mp4"})
def frames_without_stamps(path: str) -> str:
    return f"{path}: frames carry no presentation timestamps"


@message(advice="give frame_times under [video] in capture.toml", example={"path": "a.mp4", "stamp_s": 1.0})
def frames_of_one_stamp(path: str, stamp_s: float) -> str:
    return f"{path}: two frames have the presentation timestamp {stamp_s:.6f} s"


@message(example={"frame_s": 1.0})
def frame_damaged(frame_s: float) -> str:
    return f"is damaged: the frame at {frame_s:.3f} s cannot be fully decoded"


@message(example={"missing": 3, "wanted": 100, "first_s": 1.0})
def frames_not_decoded(missing: int, wanted: int, first_s: float) -> str:
    return f"{missing} of {wanted} frames cannot be decoded (first: at {first_s:.6f} s)"


@message(example={"path": "a.mp4"})
def pyav_missing(path: str) -> str:
    return f"{path} is a video, which PyAV decodes, and that is not installed: pip install av"


@message(example={"detail": "Invalid data found when processing input"})
def not_read_by_ffmpeg(detail: str) -> str:
    return f"is not a video that FFmpeg reads: {detail}"


@message(
    advice="write the one to use into a file of its own (ffmpeg -i IN -map 0:v:0 -c copy OUT)",
    example={"count": 2, "width": 1920, "height": 1080},
)
def several_video_streams(count: int, width: int, height: int) -> str:
    return f"holds {count} video streams of {width}x{height}"
