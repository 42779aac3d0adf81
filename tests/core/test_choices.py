"""What is wrong with options and arrays is said where they enter."""

import re
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial import (
    BatchOptions,
    CameraTrajectory,
    ImuRecording,
    MappingOptions,
    ProjectOptions,
    ReconstructOptions,
    ScaleOptions,
    load_capture,
    reconstruct,
    reconstruct_project,
    run_batch,
)
from colmap_inertial.core.types import AcceptedScale, Gap, Similarity
from colmap_inertial.imaging.path_filters import DeblurOptions
from colmap_inertial.model.project import Applied
from colmap_inertial.model.similarities import ModelScale
from colmap_inertial.motion.align import AlignOptions
from colmap_inertial.run.commands.result import Fragment
from colmap_inertial.run.stages.frame_folder import FrameRecord
from colmap_inertial.tools.batch.manifest import BatchCapture


def test_an_option_is_refused_where_it_is_given(subtests):
    for make, message in (
        (lambda: ReconstructOptions(world="zup"), r"world: 'zup' is not one of .*; did you mean 'z-up'"),
        (lambda: ReconstructOptions(deblur="weiner"), "did you mean 'wiener'"),
        (lambda: ReconstructOptions(dense="yes"), "dense: 'yes' is not true or false"),
        (lambda: ReconstructOptions(scale=MappingOptions()), "scale: a MappingOptions is not a ScaleOptions"),
        (lambda: MappingOptions(overlap=2.5), "overlap: 2.5 is not a whole number"),
        (lambda: MappingOptions(gravity_priors=1), "gravity_priors: 1 is not true or false"),
        (lambda: ScaleOptions(max_offset_s="1"), "max_offset_s: '1' is not a number"),
        (lambda: ScaleOptions(latitude_deg=100), "from -90 to 90"),
    ):
        with subtests.test(message), pytest.raises(ValueError, match=message):
            make()


def test_a_field_that_there_is_not_is_refused_with_the_nearest_one(subtests):
    for make, message in (
        (lambda: ReconstructOptions(wolrd="z-up"), "ReconstructOptions has no field 'wolrd'; did you mean 'world'?"),
        (lambda: AlignOptions(min_overlp=0.3), "AlignOptions has no field 'min_overlp'; did you mean 'min_overlap'?"),
        (lambda: DeblurOptions(qqq=1), "DeblurOptions has no field 'qqq'"),
    ):
        with subtests.test(message), pytest.raises(TypeError, match=re.escape(message) + "$"):
            make()


def test_options_of_all_rooms_are_checked(subtests):
    for make, message in (
        (lambda: AlignOptions(max_offset_s="1"), "max_offset_s: '1' is not a number"),
        (lambda: DeblurOptions(threads=1.5), "threads: 1.5 is not a whole number"),
        (lambda: BatchCapture(name="a", path="b", options=ScaleOptions()), "is not a ReconstructOptions"),
    ):
        with subtests.test(message):
            with pytest.raises(ValueError, match=message):
                make()
            assert BatchCapture(name="a", path="b").path == Path("b")


def test_results_print_on_a_screen_and_in_a_notebook():
    shown = [
        Similarity(
            scale=2, rotation_xyzw=np.eye(4)[3], translation_m=np.zeros(3), cov=np.zeros((7, 7)), provenance="x"
        ),
        Gap(first=0, second=1, seconds=2.5, reason="<b>", joined=False),
        Fragment(colmap_index=3, registered_images=2, sparse=Path("sparse/3")),
        FrameRecord(name="a.jpg", action="passed"),
        AcceptedScale(metres_per_unit=0.5, sigma_log=np.float64(0.01), ci95=(0.49, 0.51)),
        ModelScale(similarity=None, verdict="refused", reasons=("hardly moves",)),
        Applied(out=Path("metric"), models={0: ("sparse/0", None)}, changes=(), unchanged={"copied": 3}, notes=()),
        load_capture(Path(__file__).parents[2] / "example_scenes" / "desk"),
    ]
    for value in shown:
        assert str(value).splitlines()[0] == type(value).__name__ and len(str(value).splitlines()) <= 20
        assert value._repr_html_().startswith("<table>")
    assert "sigma_log        0.01" in str(shown[4])
    assert "array 7 x 7" in str(shown[0]) and "&lt;b&gt;" in shown[1]._repr_html_()


def test_values_become_what_their_annotation_says():
    options = ReconstructOptions(calibration="a.json", seed=np.int64(3), colmap=["Mapper.x=1"])
    assert options.calibration == (Path("a.json"),) and type(options.seed) is int and options.colmap == ("Mapper.x=1",)
    assert ProjectOptions(imu="imu.csv").imu == Path("imu.csv")
    assert ScaleOptions(max_offset_s=1).max_offset_s == 1.0


def test_options_in_the_place_of_others_are_refused_before_the_work(tmp_path):
    with pytest.raises(TypeError, match="give it as batch="):
        run_batch([], tmp_path / "out", BatchOptions())
    with pytest.raises(TypeError, match=r"captures\[0\] must be a BatchCapture, not 'desk'"):
        run_batch(["desk"], tmp_path / "out")
    with pytest.raises(TypeError, match="options must be a ReconstructOptions, not a ScaleOptions"):
        reconstruct(tmp_path, tmp_path / "out", ScaleOptions())
    with pytest.raises(TypeError, match="give it as options="):
        reconstruct_project(tmp_path, tmp_path / "out", ReconstructOptions())
    assert not (tmp_path / "out").exists()


def test_an_array_is_refused_where_it_is_given(subtests):
    for t_s, rates, message in (
        (np.arange(9) * 5e6, np.zeros((9, 3)), "gyro_t_s: spans 4e.07.*give seconds, not nanoseconds"),
        (np.arange(9) * 5.0, np.zeros((9, 3)), "samples lie 5 s apart"),
        (np.arange(9) * 5e-3, np.zeros((3, 9)), r"gyro_rad_s: shape \(3, 9\), expected \(9, 3\); transpose it"),
        (np.arange(9)[::-1], np.zeros((9, 3)), "times must increase"),
        (["a"] * 9, np.zeros((9, 3)), "gyro_t_s: is no array of numbers"),
        (np.arange(9) * 5e-3, np.full((9, 3), np.nan), "not finite"),
    ):
        with subtests.test(message), pytest.raises(ValueError, match=message):
            ImuRecording(gyro_t_s=t_s, gyro_rad_s=rates, accel_t_s=np.arange(9) * 5e-3, accel_m_s2=np.zeros((9, 3)))


def test_poses_in_nanoseconds_are_refused_before_memory_is_asked_for():
    t_s = 1.4e18 + np.arange(9) * 1e8
    with pytest.raises(ValueError, match="t_s: spans"):
        CameraTrajectory(
            names=tuple("abcdefghi"),
            t_s=np.concatenate([t_s[:-1], t_s[-1:] + 1e9 * 3600]),
            cam_from_world_xyzw=np.tile([0, 0, 0, 1.0], (9, 1)),
            cam_in_world=np.zeros((9, 3)),
        )
