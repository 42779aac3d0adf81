"""COLMAP's own options as the user gives them: ``SECTION.option=value``, or a ``project.ini``."""

from __future__ import annotations

import configparser
import difflib
import logging
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_text
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.model import load_pycolmap

log = logging.getLogger(__name__)

Options = TypeVar("Options")
Step = Literal["features", "matches", "mapping", "adjustment", "stereo", "fusion"]


@dataclass(frozen=True)
class _Section:
    """A section of COLMAP's ``project.ini``.

    Attributes
    ----------
    kind
        The class of pycolmap that holds its options.
    step
        What they decide.
    places
        By what names of options begin with: the attribute whose attributes they are.
    """

    kind: str
    step: Step
    places: tuple[tuple[str, str], ...] = (("", ""),)


_LEARNED_MATCHING = (("lightglue_", "lightglue"), ("brute_force_", "brute_force"), ("bruteforce_", "brute_force"))
_SECTIONS = {
    "ImageReader": _Section("ImageReaderOptions", "features"),
    "FeatureExtraction": _Section("FeatureExtractionOptions", "features"),
    "SiftExtraction": _Section("FeatureExtractionOptions", "features", (("", "sift"),)),
    "AlikedExtraction": _Section("FeatureExtractionOptions", "features", (("", "aliked"),)),
    "FeatureMatching": _Section("FeatureMatchingOptions", "matches"),
    "SiftMatching": _Section("FeatureMatchingOptions", "matches", (("", "sift"), ("lightglue_", "sift.lightglue"))),
    "AlikedMatching": _Section(
        "FeatureMatchingOptions",
        "matches",
        tuple((prefix, f"aliked.{place}") for prefix, place in _LEARNED_MATCHING),
    ),
    "TwoViewGeometry": _Section("TwoViewGeometryOptions", "matches", (("", ""), ("", "ransac"))),
    "Mapper": _Section("IncrementalPipelineOptions", "mapping", (("", ""), ("", "mapper"), ("tri_", "triangulation"))),
    "GlobalMapper": _Section(
        "GlobalPipelineOptions",
        "mapping",
        (
            ("", ""),
            ("", "mapper"),
            ("ra_", "mapper.rotation_averaging"),
            ("gp_", "mapper.global_positioning"),
            ("ba_", "mapper.bundle_adjustment"),
            ("ba_ceres_", "mapper.bundle_adjustment.ceres"),
            ("ba_ceres_", "mapper.bundle_adjustment.ceres.solver_options"),
            ("tri_", "mapper.retriangulation"),
        ),
    ),
    "BundleAdjustment": _Section("BundleAdjustmentOptions", "adjustment"),
    "BundleAdjustmentCeres": _Section(
        "BundleAdjustmentOptions", "adjustment", (("", "ceres"), ("", "ceres.solver_options"))
    ),
    "PatchMatchStereo": _Section("PatchMatchOptions", "stereo"),
    "StereoFusion": _Section("StereoFusionOptions", "fusion"),
    "PoissonMeshing": _Section("PoissonMeshingOptions", "fusion"),
}
#: Sections of a ``project.ini`` that decide nothing here, and what decides in their place.
_UNUSED = {
    **dict.fromkeys(
        [
            f"{way}{what}"
            for way in ("Exhaustive", "Sequential", "VocabTree", "Spatial", "Transitive", "ImagePairs", "Imported")
            for what in ("Matching", "Pairing")
        ],
        "mapping-pairing-chooses",
    ),
    "DelaunayMeshing": "dense-mesh-chooses",
    "Render": "of-colmaps-window",
}
#: Options of any section that are not COLMAP's to decide here, and what decides in their place.
_DECIDED = {
    "num_threads": "deterministic-decides",
    "random_seed": "seed-decides",
    "use_gpu": "mapping-device-decides",
    "type": "mapping-features-decides",
    "skip_geometric_verification": "pairs-by-verified-matches",
    **dict.fromkeys(
        ("single_camera", "single_camera_per_folder", "single_camera_per_image", "existing_camera_id"),
        "capture-says-camera",
    ),
    **dict.fromkeys(
        (
            *("image_path", "image_names", "image_list_path", "match_list_path", "snapshot_path"),
            *("snapshot_frames_freq", "constant_rig_list_path", "constant_camera_list_path"),
        ),
        "run-has-own-files",
    ),
}


@dataclass(frozen=True)
class ColmapSettings:
    """Options of COLMAP that the user set.

    Attributes
    ----------
    settings
        Each as ``SECTION.option=value``; of the same option the last one counts.
    """

    settings: tuple[str, ...] = ()

    def of(self, *steps: Step) -> tuple[str, ...]:
        """Those of some steps."""
        return tuple(text for text in self.settings if _SECTIONS[_section(text)].step in steps)

    def identity(self, *steps: Step) -> list[object]:
        """Values that decide these steps, with the content of files that settings name."""
        chosen = self.of(*steps)
        files = [Path(text.partition("=")[2]) for text in chosen]
        return [*chosen, *(fingerprint(path) for path in files if path != Path() and path.exists())]

    def after(self, *settings: str) -> ColmapSettings:
        """These settings, with defaults before them that count where the user set nothing."""
        return ColmapSettings((*settings, *self.settings))

    def apply(self, options: Options) -> Options:
        """Set what belongs to an object of pycolmap's options; returns the object."""
        for text in self.settings:
            if _SECTIONS[_section(text)].kind == type(options).__name__:
                _set(options, text)
        return options


NO_SETTINGS: ColmapSettings = ColmapSettings()


def read_settings(given: tuple[str, ...], project: Path | None) -> ColmapSettings:
    """Settings of ``--colmap`` and of a ``project.ini``, checked against the installed pycolmap.

    Parameters
    ----------
    given
        Settings, which go before those of the file.
    project
        COLMAP's ``project.ini``. As COLMAP writes all options into one, only those count that differ from COLMAP's
        defaults; those that are decided otherwise are left out.

    Raises
    ------
    FormatError
        For a file that is none, or names what COLMAP does not have.
    InertialError
        For a setting that COLMAP does not have, with the nearest one, or of a value that it refuses.
    """
    load_pycolmap()
    of_file = [] if project is None else list(_read_project(project))
    for text in given:
        try:
            _check(text)
        except InertialError as error:
            raise InertialError(Fact("colmap-setting-wrong", why=error.fact)) from error
    kept = {text.partition("=")[0]: text for text in (*of_file, *given)}
    return ColmapSettings(tuple(kept[name] for name in sorted(kept)))


def _read_project(path: Path) -> Iterator[str]:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    try:
        parser.read_string("[project]\n" + read_text(path), source=str(path))
    except configparser.Error as error:
        raise FormatError(path, Fact("no-project-ini", detail=error.message)) from error
    wrong: list[Fact] = []
    for section in parser.sections()[1:]:
        if section in _UNUSED:
            continue
        for option, value in parser.items(section):
            text = f"{section}.{option}={_absolute(value, path.parent)}"
            if option in _DECIDED:
                continue
            try:
                if _check(text):
                    log.info("%s: %s", path.name, text)
                    yield text
            except InertialError as error:
                wrong.append(error.fact)
    if wrong:
        raise FormatError(path, Fact("found-together", found=wrong))


def _absolute(value: str, folder: Path) -> str:
    """A value of a file in which paths count from its folder."""
    # the system refuses names that are too long; os.path does not raise
    return str((folder / value).resolve()) if value and os.path.exists(folder / value) else value


def _check(text: str) -> bool:
    """Whether a setting changes anything; an ``InertialError`` where it has no meaning."""
    name, equals, _ = text.partition("=")
    section, dot, option = name.partition(".")
    if not (equals and dot):
        raise InertialError(Fact("setting-unreadable", setting=text))
    if section in _UNUSED:
        raise InertialError(Fact("setting-not-taken", setting=text, why=Fact(_UNUSED[section])))
    if section not in _SECTIONS:
        raise InertialError(Fact("no-section-of-colmap", setting=text, nearest=_nearest(section, _SECTIONS)))
    if option in _DECIDED:
        raise InertialError(Fact("setting-not-taken", setting=text, why=Fact(_DECIDED[option])))
    options = _defaults(section)
    holder, attribute = _find(options, name)
    before = getattr(holder, attribute)
    _set(options, text)
    for part in (holder, options):
        try:
            # some raise, the others write what they refuse to COLMAP's log alone
            refused = hasattr(part, "check") and part.check() is False
        except ValueError:
            refused = True
        if refused:
            raise InertialError(Fact("value-refused", setting=text, default=_spell(before)))
    return bool(getattr(holder, attribute) != before)


def _section(text: str) -> str:
    return text.partition(".")[0]


def _set(options: object, text: str) -> None:
    name, _, value = text.partition("=")
    holder, attribute = _find(options, name)
    before = getattr(holder, attribute)
    try:
        setattr(holder, attribute, _parse(value.strip(), before))
    except (ValueError, KeyError, TypeError) as error:
        raise InertialError(
            Fact("value-of-other-type", setting=text, value=value, name=name, default=_spell(before))
        ) from error


def _find(options: object, name: str) -> tuple[Any, str]:
    """The object that holds an option, and the name of its attribute."""
    section, _, option = name.partition(".")
    known: list[str] = []
    for prefix, holder in _holders(options, section):
        plain = _plain_names(holder)
        if option.startswith(prefix) and option.removeprefix(prefix) in plain:
            return holder, option.removeprefix(prefix)
        known += [f"{section}.{prefix}{key}" for key in plain]
    if not known:
        raise InertialError(Fact("section-not-installed", name=name, section=section))
    # versions of COLMAP moved options between the sections of a step
    steps = [other for other, kind in _SECTIONS.items() if kind.step == _SECTIONS[section].step]
    moved = [
        f"{other}.{option}"
        for other in steps
        for _, holder in _holders(_defaults(other), other)
        if option in _plain_names(holder)
    ]
    raise InertialError(Fact("no-such-setting", name=name, nearest=_nearest(name, moved or known)))


def _defaults(section: str) -> object:
    import pycolmap

    return getattr(pycolmap, _SECTIONS[section].kind)()


def _holders(options: object, section: str) -> Iterator[tuple[str, Any]]:
    """The objects whose attributes are a section's options, each with the beginning of their names."""
    for prefix, place in _SECTIONS[section].places:
        holder: Any = options
        for part in filter(None, place.split(".")):
            holder = getattr(holder, part, None)
        if holder is not None:
            yield prefix, holder


def _plain_names(holder: Any) -> list[str]:
    """Names of an object's options that are values."""
    return [key for key in holder.todict(recursive=False) if not hasattr(getattr(holder, key), "todict")]


def _parse(value: str, before: Any) -> Any:
    """A value of the type that an option has."""
    if isinstance(before, bool):
        return {"true": True, "1": True, "false": False, "0": False}[value.lower()]
    if hasattr(type(before), "__members__"):
        return type(before).__members__[value.upper()]
    if isinstance(before, int | float | str | Path):
        return type(before)(value)
    raise ValueError("no plain value")


def _spell(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(getattr(value, "name", value))


def _nearest(word: str, known: Iterable[str]) -> str | None:
    like = difflib.get_close_matches(word, list(known), n=1, cutoff=0.4)
    return like[0] if like else None
