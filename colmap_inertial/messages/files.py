"""Words of files that cannot be read or written, of any kind."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_missing

# what the gate of all readers says

state("is-damaged", "is damaged")
state("changed-record", "was changed since it was written", advice="remove it and start again")
state("no-result-of-reconstruct", "is not a result of `colmap-inertial reconstruct`")


@message(example={"names": ("result.json", "report_data")})
def changed_records(names: Sequence[str]) -> str:
    return f"its {', '.join(names[:-1])} or {names[-1]} was changed since it was written"


@message(example={"what": "a calibration"})
def not_readable_as(what: str) -> str:
    return f"cannot be read as {what}"


@message(example={"fault": {"code": "is-damaged", "values": {}}, "detail": "KeyError: 'a'"})
def damaged(fault: Said, detail: str) -> str:
    return f"{fault.with_advice} ({detail})"


# entries of files of keys and values


@message(example={"entry": "[imu] path", "fault": {"code": "nul-character", "values": {}}})
def wrong_entry(entry: str, fault: Said) -> str:
    return f"{entry}: {fault.with_advice}"


@message(example={"detail": "width must be above 0"})
def invalid_values(detail: str) -> str:
    return detail


# text, YAML, JSON and names


@message(example={"path": "out/run.json", "detail": "No space left on device"})
def cannot_be_written(path: str, detail: str) -> str:
    return f"{path} cannot be written: {detail}"


@message(example={"what": "calibration", "count": 600000})
def too_many_characters(what: str, count: int) -> str:
    return f"is not a {what}: its {count} characters are too many"


@message(example={"detail": "mapping values are not allowed here"})
def invalid_yaml(detail: str) -> str:
    return f"not valid YAML: {detail}"


@message(example={"what": "a calibration"})
def no_keys_and_values(what: str) -> str:
    return f"not {what}: expected keys and values"


@message(advice="keep one of them", example={"what": "a calibration", "count": 2})
def documents_differ(what: str, count: int) -> str:
    return f"not {what}: its {count} documents differ"


@message(example={"found": "list"})
def no_json_object(found: str) -> str:
    return f"expected a JSON object, found {found}"


@message(example={"detail": "Expecting value"})
def invalid_json(detail: str) -> str:
    return f"not valid JSON: {detail}"


@message(example={"largest_gib": 4.0, "what": "file"})
def file_too_large(largest_gib: float, what: str) -> str:
    return f"is larger than {largest_gib:g} GiB; such a {what} is not read (raise --limits.file-gib)"


@message(example={"what": "file"})
def no_such_file(what: str) -> str:
    return say_missing(what)


@message(example={"detail": "Permission denied"})
def file_not_readable(detail: str) -> str:
    return f"cannot be read: {detail}"


state("not-a-regular-file", "is a device, a pipe or a socket, not a file", advice="copy what it gives into one")


@message(advice="remove it, or put the file or folder itself there", joint=": ", example={"target": "/data/elsewhere"})
def link_in_output(target: str) -> str:
    return f"is a link to {target}; links in an output folder are not followed"


state("is-empty", "is empty")
state("name-absolute", "is absolute")
state("name-leads-out", 'leads out of its folder by ".."')
state("name-unprintable", "is not UTF-8, or holds a control character")


@message(example={"longest": 255})
def name_too_long(longest: int) -> str:
    return f"is longer than {longest} bytes"


@message(example={"name": "/a.jpg", "fault": {"code": "name-absolute", "values": {}}})
def unsafe_name(name: str, fault: Said) -> str:
    return f"names the file {name!r}, which {fault}; such names are not followed"


state(
    "unprintable-path",
    "its name, or that of a folder above it, is not UTF-8 or holds a control character",
    advice="rename it",
)


@message(
    advice="put the file itself there", joint=": ", example={"name": "a.jpg", "folder": "images", "real": "/data/a.jpg"}
)
def link_leads_out(name: str, folder: str, real: str) -> str:
    return f"names the file {name!r}, a link out of {folder} to {real}; such links are not followed"


state("sqlite-cannot-read", "SQLite cannot read it")
_UNREAD = {"code": "sqlite-cannot-read", "values": {}}


@message(example={"fault": _UNREAD, "kind": "trigger", "name": "t"})
def code_in_database(fault: Said, kind: str, name: str) -> str:
    drop = kind.split()[-1].upper()
    return f"{fault.with_advice}: it holds the {kind} {name!r}, which is not run; drop it (DROP {drop})"


@message(example={"fault": _UNREAD})
def database_takes_long(fault: Said) -> str:
    return f"{fault.with_advice}: reading takes longer than its size explains"


@message(example={"fault": _UNREAD, "detail": "database disk image is malformed"})
def database_not_readable(fault: Said, detail: str) -> str:
    return f"{fault.with_advice}: {detail}"


state("truncated", "truncated")


@message(example={"byte": 100, "fault": {"code": "mp4-timescale-zero", "values": {}}})
def damaged_at_byte(byte: int, fault: Said) -> str:
    return f"is damaged at byte {byte}: {fault}"


@message(example={"text": "NaN"})
def not_a_known_number(text: str) -> str:
    return f"{text} is not a supported number"
