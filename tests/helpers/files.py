"""Files that tests write."""

from pathlib import Path


def write_anew(path: Path, data: bytes) -> None:
    """Put other bytes into a file's place; to empty a file and fill it again makes ext4 write to the disk at once."""
    path.unlink(missing_ok=True)
    path.write_bytes(data)
