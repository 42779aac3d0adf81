"""Features and matches of many images, in one database or by chunks that other machines do."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_inertial.colmap.chunks import Chunk, Executor, do_chunks
from colmap_inertial.colmap.parts import write_part_database
from colmap_inertial.core.errors import FormatError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.disk import remove
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.sqlite import open_foreign

if TYPE_CHECKING:
    import pycolmap

_MADE, _FEATURES = "made.db", "part.db"


@dataclass(frozen=True, kw_only=True)
class ChunkSizes:
    """Sizes of chunks; they decide no result."""

    #: Pairs that are matched in one go: to index their images' features costs a tenth of it.
    pairs: int = 400
    #: Fewer pairs take less time than a process to begin.
    least_pairs: int = 100


SIZES = ChunkSizes()


@dataclass(frozen=True, kw_only=True)
class _DatabaseWork:
    """Work by COLMAP that makes a database.

    Attributes
    ----------
    device
        What it is done on.
    seed
        Of COLMAP.
    settings
        Identity of what the user set, with the files that it names.
    """

    device: str
    seed: int
    settings: Sequence[object] = ()

    def check(self, made: Path) -> None:
        """As of :class:`~colmap_inertial.colmap.chunks.Work`."""
        path = made / _MADE
        with open_foreign(path) as opened:
            if opened.execute("PRAGMA quick_check").fetchone() != ("ok",):
                raise FormatError(path, Fact("database-damaged"))


@dataclass(frozen=True, kw_only=True)
class FindFeatures(_DatabaseWork):
    """Finds features of some images.

    Attributes
    ----------
    names
        Of the images.
    reader
        COLMAP's options, as of :func:`state_reader`.
    extraction
        COLMAP's options, as a dictionary.
    """

    names: tuple[str, ...]
    reader: dict[str, Any]
    extraction: dict[str, Any]

    def find(self, database: Path, images: Path) -> None:
        """Find them in a database that may hold the images."""
        import pycolmap

        reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
        reader.mergedict(self.reader)
        extraction.mergedict(self.extraction)
        pycolmap.set_random_seed(self.seed)
        pycolmap.extract_features(
            str(database),
            str(images),
            image_names=list(self.names),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device(self.device),
        )

    def __call__(self, folder: Path, images: Path, made: Path, told: Callable[[], None]) -> None:
        """As of :class:`~colmap_inertial.colmap.chunks.Work`."""
        import pycolmap

        for path in self.reader.values():
            if isinstance(path, Path) and not path.exists():
                raise MappingError(Fact("file-unseen", path=str(path)))
        new = {"existing_camera_id": pycolmap.ImageReaderOptions().existing_camera_id}
        replace(self, reader={**self.reader, **new}).find(made / _MADE, images)
        with pycolmap.Database.open(str(made / _MADE)) as opened:
            found = {image.name for image in opened.read_all_images()}
        for name in self.names:
            if name not in found:
                raise MappingError(Fact("image-unread", path=str(images / name)))
            told()


def state_reader(options: pycolmap.ImageReaderOptions) -> dict[str, Any]:
    """Options of reading as a dictionary, with paths that hold in another folder; one that is empty would come back."""
    values = options.todict()
    return {
        name: value.absolute() if isinstance(value, Path) else value
        for name, value in values.items()
        if value != Path()
    }


@dataclass(frozen=True, kw_only=True)
class MatchPairs(_DatabaseWork):
    """Matches and verifies pairs of images.

    Attributes
    ----------
    pairs
        Names.
    matching, verification
        COLMAP's options, as dictionaries.
    database
        Of the features, for a chunk; it does not change meanwhile.
    """

    pairs: tuple[tuple[str, str], ...]
    matching: dict[str, Any]
    verification: dict[str, Any]
    database: Path = field(default=Path(), repr=False)

    def numbered(self, database: pycolmap.Database) -> list[tuple[int, int]]:
        """The pairs by a database's numbers of images, the smaller one first."""
        number = {image.name: image.image_id for image in database.read_all_images()}
        return [(min(number[a], number[b]), max(number[a], number[b])) for a, b in self.pairs]

    def match(self, database: Path, folder: Path) -> None:
        """Match them in a database; ``folder`` takes a list of them."""
        import pycolmap

        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.mergedict(self.matching)
        verification.mergedict(self.verification)
        listed = folder / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in self.pairs))
        pycolmap.set_random_seed(self.seed)
        pycolmap.match_image_pairs(
            str(database),
            matching_options=matching,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(listed)),
            verification_options=verification,
            device=pycolmap.Device(self.device),
        )

    def __call__(self, folder: Path, images: Path, made: Path, told: Callable[[], None]) -> None:
        """As of :class:`~colmap_inertial.colmap.chunks.Work`."""
        import pycolmap

        part = folder / _FEATURES
        names = list(dict.fromkeys(name for pair in self.pairs for name in pair))
        write_part_database(self.database, names, part, to_match=True)
        self.match(part, folder)
        with pycolmap.Database.open(str(part)) as source, pycolmap.Database.open(str(made / _MADE)) as target:
            _copy_pairs(source, target, self.numbered(source))
        for _ in self.pairs:
            told()


def find_elsewhere(
    works: Sequence[FindFeatures],
    database: Path,
    images: Path,
    folder: Path,
    executor: Executor,
    told: Callable[[int], None],
) -> None:
    """Let others find features, and write them to a database that holds the images; of no other image."""
    import pycolmap

    with pycolmap.Database.open(str(database)) as opened:
        own = {image.name: image.image_id for image in opened.read_all_images()}
    chunks = []
    for number, work in enumerate(works):
        names = tuple(name for name in work.names if name in own)
        if not names:
            continue
        prints = [fingerprint(images / name) for name in names]
        name = f"finding features of {names[0]} to {names[-1]}"
        chunks.append(_begin(replace(work, names=names), name, folder / str(number), images, len(names), prints))
    for chunk in do_chunks(chunks, executor, told):
        with (
            pycolmap.Database.open(str(chunk.made / _MADE)) as source,
            pycolmap.Database.open(str(database)) as target,
        ):
            for image in source.read_all_images():
                target.write_keypoints(own[image.name], source.read_keypoints(image.image_id))
                target.write_descriptors(own[image.name], source.read_descriptors(image.image_id))


def is_worth_chunks(pairs: Sequence[tuple[str, str]], executor: Executor) -> bool:
    """Whether pairs are to be matched by others."""
    return executor.remote and len(pairs) >= SIZES.least_pairs


def match_elsewhere(work: MatchPairs, folder: Path, executor: Executor, told: Callable[[int], None]) -> None:
    """Let others match pairs by the features of a database, and write what they found to it."""
    import pycolmap

    with open(work.database, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    chunks = []
    for number, begin in enumerate(range(0, len(work.pairs), SIZES.pairs)):
        own = replace(work, pairs=work.pairs[begin : begin + SIZES.pairs], database=work.database.absolute())
        name = f"matching pairs {begin + 1} to {begin + len(own.pairs)}"
        chunks.append(_begin(own, name, folder / str(number), folder, len(own.pairs), digest))
    # others read the database until all are done
    made = [chunk.made for chunk in do_chunks(chunks, executor, told)]
    with pycolmap.Database.open(str(work.database)) as target:
        pairs = work.numbered(target)
        for path in made:
            with pycolmap.Database.open(str(path / _MADE)) as source:
                _copy_pairs(source, target, pairs)


def _begin(work: FindFeatures | MatchPairs, name: str, folder: Path, images: Path, size: int, reads: object) -> Chunk:
    remove(folder)  # of a run that was killed
    folder.mkdir(parents=True)
    return Chunk.of(work, name=name, folder=folder, images=images, size=size, reads=reads, gpu=work.device == "cuda")


def _copy_pairs(source: pycolmap.Database, target: pycolmap.Database, pairs: Iterable[tuple[int, int]]) -> None:
    """Copy what there is of pairs, and not yet in ``target``."""
    for pair in pairs:
        if source.exists_matches(*pair) and not target.exists_matches(*pair):
            target.write_matches(*pair, source.read_matches(*pair))
        if source.exists_two_view_geometry(*pair) and not target.exists_two_view_geometry(*pair):
            target.write_two_view_geometry(*pair, source.read_two_view_geometry(*pair))
