"""Tables in a zip are those of the folder that it was unpacked to."""

import resource
import zipfile

import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.options import ReadLimits
from colmap_inertial.io.files import reading_within
from colmap_inertial.io.tables import _unpacking, head_of, members_of, text_of
from tests.helpers.cases import loop_over

TABLES = {
    "plain.csv": "t,x\n1,2\n",
    "bom.csv": "\ufefft,x\n1,2\n",
    "long.csv": "t" * 400 + "\n" + "1,2\n" * 3000,
    "umlaut.csv": "größe,µT\n1,2\n",
}


@pytest.fixture
def both(tmp_path):
    """The same tables in a folder, and in a zip of it that holds them one folder down."""
    folder, archive = tmp_path / "folder", tmp_path / "tables.zip"
    folder.mkdir()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, text in TABLES.items():
            (folder / name).write_bytes(text.encode())
            opened.writestr(f"export/{name}", text.encode())
    (folder / "notes.txt").touch()
    return folder, archive


def test_a_zip_reads_as_its_folder(both):
    folder, archive = both
    assert members_of(folder) == {name: name for name in TABLES}
    assert members_of(archive) == {name: f"export/{name}" for name in TABLES}
    for name, text in TABLES.items():
        whole = text.removeprefix("\ufeff")
        assert text_of(folder, name) == text_of(archive, f"export/{name}") == whole
        assert head_of(folder, name).rstrip("\n") == head_of(archive, f"export/{name}") == whole.split("\n")[0]


def test_tables_lie_at_the_top_or_one_folder_down(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("top.csv", "one/down.csv", "two/folders/deep.csv", "one/notes.txt", "csv"):
            archive.writestr(name, "t\n")
    assert members_of(path) == {"top.csv": "top.csv", "down.csv": "one/down.csv"}
    (tmp_path / "no.zip").write_bytes(b"PK no archive")
    assert members_of(tmp_path / "no.zip") == members_of(tmp_path / "absent.zip") == {}


def test_the_head_of_a_table_without_lines_is_its_first_thousand_bytes(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.csv", "x" * 5000)
    assert head_of(path, "a.csv") == "x" * 1000
    assert head_of(path, "b.csv") == ""


@loop_over("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_table_is_read_up_to_the_limit(tmp_path, compression):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("a.csv", "t,x\n" * 100)
    with reading_within(ReadLimits(file_gib=400 / 2**30)):
        assert text_of(path, "a.csv") == "t,x\n" * 100
    told = r"a\.zip: its a\.csv unpacks to more than .* GiB \(--limits.file-gib"
    with reading_within(ReadLimits(file_gib=399 / 2**30)), pytest.raises(FormatError, match=told):
        text_of(path, "a.csv")
    with pytest.raises(FormatError, match=r"its b\.csv cannot be unpacked"):
        text_of(path, "b.csv")


@pytest.mark.parametrize("line", [b"1,2\n", b"0" * 4000 + b"\n"])
def test_a_packed_table_out_of_proportion_takes_no_memory(tmp_path, line):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.csv", line * ((200 << 20) // len(line)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FormatError, match=r"its a\.csv unpacks to \d+ MB and more, out of proportion to \d+ packed"):
        text_of(path, "a.csv")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_table_is_packed_as_recorders_do(subtests, tmp_path_factory):
    for compression in (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        with subtests.test(compression=compression):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "a.zip"
            with zipfile.ZipFile(path, "w", compression) as archive:
                archive.writestr("a.csv", "t,x\n1,2\n")
            assert members_of(path) == {"a.csv": "a.csv"} and head_of(path, "a.csv") == ""
            with pytest.raises(FormatError, match=r"its a\.csv is packed by method (12|14), not by deflate; unpack it"):
                text_of(path, "a.csv")


@pytest.mark.parametrize("stated", [10, 10**9])
def test_packed_bytes_are_those_stated_and_no_more_than_the_zip_has(both, monkeypatch, stated):
    _, archive = both
    true = zipfile.ZipFile.getinfo

    def claimed(opened, member):
        info = true(opened, member)
        info.compress_size = stated
        if hasattr(info, "_end_offset"):
            info._end_offset = None  # later Pythons refuse what reaches beyond it by themselves
        return info

    monkeypatch.setattr(zipfile.ZipFile, "getinfo", claimed)
    with _unpacking(archive, "export/plain.csv") as (_, packed):
        assert packed == min(stated, archive.stat().st_size)
