"""A small part of ``scripts/studies/fuzz.py``: each reader's files damaged a few times; its table counts what is."""

from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from scripts.studies.fuzz import READERS, outcome, whole_files
from tests.helpers.cases import loop_over
from tests.helpers.fuzz_readers import Reader

MUTANTS = 12


@loop_over("name", [name for name, reader in READERS.items() if reader.cost < 10])
def test_only_errors_of_our_own_come_out(tmp_path, name):
    reader = READERS[name]
    files = whole_files(reader, tmp_path)
    for number in range(max(2, round(MUTANTS / reader.cost))):
        found, told = outcome(reader, tmp_path, files, (7, number))
        assert found in ("read", "refused", "gated"), told


@loop_over("name", [name for name, reader in READERS.items() if reader.cost < 10 and name != "dji"])
def test_what_is_damaged_is_read_whole(tmp_path, name):
    READERS[name].build(tmp_path)
    READERS[name].read(tmp_path)


def _fails(error: BaseException):
    def read(folder: Path) -> None:
        if (folder / "a").read_bytes() != b"whole":
            raise error

    return read


def _build(folder: Path) -> list[Path]:
    (folder / "a").write_bytes(b"whole")
    return [folder / "a"]


def test_each_outcome_is_counted_as_what_it_is(subtests, tmp_path_factory):
    for error, counted in (
        (FormatError("a", Fact.stated("damaged")), "refused"),
        (KeyError("a"), "foreign"),
        (MemoryError(), "large"),
    ):
        with subtests.test(error=error, counted=counted):
            tmp_path = tmp_path_factory.mktemp("given")
            reader = Reader(_build, _fails(error))
            files = whole_files(reader, tmp_path)
            found = [outcome(reader, tmp_path, files, (0, number))[0] for number in range(20)]
            assert counted in found and set(found) <= {"read", counted}
            assert (tmp_path / "a").read_bytes() == b"whole"
