"""COLMAP's own options: what is refused, what reaches COLMAP, which steps they make again, and our page of them."""

import re
from pathlib import Path

import pycolmap
import pytest

from colmap_inertial.cli import parse
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.depth_maps import fusion_options
from colmap_inertial.colmap.features.extraction import (
    extraction_options,
    matching_options,
    require_features,
    verification_options,
)
from colmap_inertial.colmap.loops.closure import MappedCapture, _adjustment
from colmap_inertial.colmap.mapping.mapper import global_options, incremental_options
from colmap_inertial.colmap.settings import _SECTIONS, ColmapSettings, read_settings
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.steps.config import config_as_toml, read_config

SCENE = Path(__file__).parents[2] / "example_scenes" / "desk"
PAGE = Path(__file__).parents[2] / "docs" / "colmap.md"


def context_of(*settings, **more):
    return RunContext.of(ReconstructOptions(colmap=settings, **more))


def test_a_setting_reaches_colmap_s_options():
    context = context_of(
        "SiftExtraction.peak_threshold=0.01",
        "SiftExtraction.normalization=l2",
        "FeatureExtraction.max_image_size=800",
        "FeatureMatching.guided_matching=true",
        "SiftMatching.max_ratio=.7",
        "TwoViewGeometry.max_error=3",
        "TwoViewGeometry.min_num_inliers=20",
        "Mapper.init_num_trials=7",
        "Mapper.init_min_tri_angle=8",
        "Mapper.tri_min_angle=2",
        "Mapper.ba_global_frames_ratio=1.2",
        "GlobalMapper.ra_max_rotation_error_deg=5",
        "GlobalMapper.ba_ceres_max_num_iterations=11",
        "BundleAdjustment.refine_principal_point=1",
        "BundleAdjustmentCeres.function_tolerance=3e-6",
        "StereoFusion.min_num_pixels=3",
        "PatchMatchStereo.filter=false",
        "PoissonMeshing.trim=5",
    )
    extraction = extraction_options(MappingOptions(max_image_size=1000), context)
    assert (extraction.sift.peak_threshold, extraction.max_image_size) == (0.01, 800)
    assert extraction.sift.normalization == pycolmap.Normalization.L2
    matching = matching_options(context)
    assert (matching.guided_matching, matching.sift.max_ratio) == (True, 0.7)
    verification = verification_options(context)
    assert (verification.ransac.max_error, verification.min_num_inliers) == (3, 20)
    mapper = incremental_options(False, context)
    assert (mapper.init_num_trials, mapper.mapper.init_min_tri_angle, mapper.triangulation.min_angle) == (7, 8, 2)
    assert (mapper.ba_global_frames_ratio, mapper.ba_global_points_ratio) == (1.2, 1.4)
    pipeline = global_options(MappingOptions(), context).mapper
    assert pipeline.rotation_averaging.max_rotation_error_deg == 5
    assert pipeline.bundle_adjustment.ceres.solver_options.max_num_iterations == 11
    capture = MappedCapture(database=Path(), pipeline=mapper, names=(), settings=context.colmap)
    adjustment = capture.settings.apply(_adjustment(mapper, pycolmap.Reconstruction(), of_parts=True))
    assert adjustment.refine_principal_point and adjustment.ceres.solver_options.function_tolerance == 3e-6
    assert context.colmap.apply(pycolmap.StereoFusionOptions()).min_num_pixels == 3
    assert not context.colmap.apply(pycolmap.PatchMatchOptions()).filter
    assert context.colmap.apply(pycolmap.PoissonMeshingOptions()).trim == 5


def test_what_colmap_does_not_have_is_refused(subtests):
    for setting, said in (
        ("Mapper.init_num_trial=3", r"no such option; did you mean Mapper\.init_num_trials\?"),
        ("SiftExtraction.max_image_size=3", r"did you mean FeatureExtraction\.max_image_size\?"),
        ("Maper.init_num_trials=3", r"no such section; did you mean Mapper\?"),
        ("Mapper.mapper=3", "no such option"),
        ("Mapper.init_num_trials=x", "'x' is not a value of Mapper.init_num_trials"),
        ("SiftExtraction.upright=maybe", "such as false"),
        ("SiftExtraction.normalization=l3", "such as L1_ROOT"),
        ("SiftExtraction.max_num_features=-5", "COLMAP refuses this value"),
        ("TwoViewGeometry.max_error=-1", "COLMAP refuses this value"),
        ("Mapper.num_threads=3", "set by --deterministic"),
        ("SequentialMatching.overlap=3", r"--mapping\.pairing"),
        ("AlikedExtraction.min_score=1", "the installed pycolmap has no AlikedExtraction"),
        ("Mapper.init_num_trials", "write SECTION.option=value"),
        ("x=1", "write SECTION.option=value"),
    ):
        with subtests.test(setting=setting, said=said):
            if "Aliked" in setting and hasattr(pycolmap.FeatureExtractionOptions(), "aliked"):
                pytest.skip("this pycolmap has ALIKED")
            with pytest.raises(InertialError, match=f"^--colmap .*{said}"):
                read_settings((setting,), None)


def test_of_a_project_ini_counts_what_differs_and_a_setting_goes_before_it(tmp_path):
    (tmp_path / "masks").mkdir()
    ini = tmp_path / "project.ini"
    ini.write_text(
        "log_to_stderr=false\ndatabase_path=/x.db\nimage_path=\n[ImageReader]\nmask_path=masks\nsingle_camera=true\n"
        "[SiftExtraction]\nmax_num_features=8192\npeak_threshold=0.01\n[FeatureExtraction]\nuse_gpu=true\n"
        "[SequentialMatching]\noverlap=10\n[Mapper]\ninit_num_trials=50\nnum_threads=4\n[Render]\nmax_error=2\n"
    )
    kept = read_settings(("Mapper.init_num_trials=60",), ini).settings
    assert kept == (
        f"ImageReader.mask_path={tmp_path / 'masks'}",
        "Mapper.init_num_trials=60",
        "SiftExtraction.peak_threshold=0.01",
    )
    ini.write_text("[SiftMatching]\nguided_matching=1\n[Mapper]\nba_global_images_ratio=1.1\n")
    with pytest.raises(FormatError, match=r"FeatureMatching\.guided_matching\?.*Mapper\.ba_global_frames_ratio\?"):
        read_settings((), ini)
    ini.write_text(f"[Mapper]\ninit_num_trials={'x' * 5000}\n")
    with pytest.raises(FormatError, match="init_num_trials"):
        read_settings((), ini)
    ini.write_text("[Mapper\n")
    with pytest.raises(FormatError, match=r"is not a project\.ini"):
        read_settings((), ini)


def test_a_step_is_made_again_by_its_own_settings_and_by_files_that_they_name(subtests, tmp_path_factory):
    for absolute in (True, False):
        with subtests.test(absolute=absolute), pytest.MonkeyPatch.context() as monkeypatch:
            tmp_path = tmp_path_factory.mktemp("given")
            monkeypatch.chdir(tmp_path)
            mask = tmp_path / "mask.png"
            mask.write_bytes(b"1")
            named = mask if absolute else mask.name
            settings = ColmapSettings((f"ImageReader.camera_mask_path={named}", "Mapper.init_num_trials=60"))
            assert settings.of("mapping") == ("Mapper.init_num_trials=60",)
            before = settings.identity("features"), settings.identity("mapping")
            mask.write_bytes(b"22")
            assert settings.identity("features") != before[0] and settings.identity("mapping") == before[1]


def test_the_command_line_takes_it_several_times_and_swallows_no_path(tmp_path):
    for words in (
        ["--colmap", "Mapper.init_num_trials=3", "capture", "out", "--colmap", "SiftMatching.max_ratio=.7"],
        ["--colmap=Mapper.init_num_trials=3", "capture", "--colmap", "SiftMatching.max_ratio=.7", "out"],
        ["capture", "--colmap", "Mapper.init_num_trials=3", "out", "--colmap", "SiftMatching.max_ratio=.7"],
    ):
        command = parse(["reconstruct", *words])
        assert command.options.colmap == ("Mapper.init_num_trials=3", "SiftMatching.max_ratio=.7")
        assert (command.capture, command.out) == (Path("capture"), Path("out"))
    config = tmp_path / "config.toml"
    config.write_text(config_as_toml(command.options))
    assert read_config(config, ReconstructOptions) == command.options
    more = parse(["reconstruct", "capture", "out", "--config", str(config), "--colmap", "Mapper.init_num_trials=4"])
    assert more.options.colmap == (*command.options.colmap, "Mapper.init_num_trials=4")  # of which the last one counts
    assert read_settings(more.options.colmap, None).settings == (
        "Mapper.init_num_trials=4",
        "SiftMatching.max_ratio=.7",
    )


def listed():
    """The rows of the page: by option, what we set."""
    rows = re.findall(r"^\| `(\w+\.\w+)` \| `([^`]+)` \|", PAGE.read_text(), re.M)
    assert len(rows) == len(dict(rows)) > 5
    return dict(rows)


def changed(section, options):
    """Values of a section that are not COLMAP's defaults, as they are written."""
    default, found = type(options)(), {}
    for prefix, place in _SECTIONS[section].places:
        pair = [options, default]
        for part in filter(None, place.split(".")):
            pair = [getattr(one, part, None) for one in pair]
        for key in pair[0].todict(recursive=False) if pair[0] is not None else ():
            value, usual = (getattr(one, key) for one in pair)
            if not hasattr(value, "todict") and str(value) != str(usual):
                found[f"{section}.{prefix}{key}"] = str(value).lower()
    return found


def test_the_page_lists_what_is_set_against_colmap_s_defaults():
    context, mapping = RunContext(num_threads=1, seed=5), MappingOptions()
    set_by_us = {
        **changed("FeatureExtraction", extraction_options(mapping, context)),
        **changed("SiftExtraction", extraction_options(mapping, context)),
        **changed("FeatureMatching", matching_options(context)),
        **changed("SiftMatching", matching_options(context)),
        **changed("TwoViewGeometry", verification_options(context)),
        **changed("Mapper", incremental_options(False, context)),
        **changed("GlobalMapper", global_options(mapping, context)),
        **changed("StereoFusion", fusion_options("plane sweep", context)),
    }
    # threads and seeds are options of ours
    set_by_us = {name: value for name, value in set_by_us.items() if value not in ("1", "5")}
    assert {name: value for name, value in listed().items() if not name.startswith("Bundle")} == set_by_us
    assert changed("StereoFusion", fusion_options("patch-match", context)).keys() == {"StereoFusion.num_threads"}
    pipeline = incremental_options(True, context)
    assert changed("Mapper", pipeline).keys() <= {"Mapper.num_threads", "Mapper.random_seed"}


def test_learned_features_need_onnx_and_files_that_are_there(tmp_path, monkeypatch):
    options = ReconstructOptions(mapping=MappingOptions(features="aliked"))
    require_features(RunContext())
    if not hasattr(pycolmap.FeatureExtractionOptions(), "aliked"):
        with pytest.raises(InertialError, match=r"built without ONNX.*--database"):
            require_features(RunContext.of(options))
        with pytest.raises(InertialError, match="built without ONNX"):
            reconstruct(SCENE, tmp_path / "out", options)
        assert not (tmp_path / "out").exists()
    monkeypatch.setattr(pycolmap, "FeatureExtractionOptions", type("Built", (), {"aliked": None}))
    network = tmp_path / "network.onnx"
    network.write_bytes(b"")
    first = f"AlikedExtraction.n16rot_model_path={network}"
    context = RunContext(features="aliked", colmap=ColmapSettings((first,)))
    with pytest.raises(
        InertialError, match=r"nothing is downloaded; .*by --colmap AlikedMatching\.lightglue_model_path=FILE$"
    ):
        require_features(context)
    both = ColmapSettings((first, f"AlikedMatching.lightglue_model_path={network}"))
    require_features(RunContext(features="aliked", colmap=both))


def test_learned_features_are_extracted_and_matched_as_such():
    context = RunContext(features="aliked")
    assert extraction_options(MappingOptions(), context).type == pycolmap.FeatureExtractorType.ALIKED_N16ROT
    assert matching_options(context).type == pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
