"""What commands say at their end: each number in its unit, each file by its name, and nothing that does not hold."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.cli import terminal
from colmap_inertial.cli.apply import Apply
from colmap_inertial.cli.calibrate_imu import CalibrateImu
from colmap_inertial.cli.export import Export
from colmap_inertial.cli.reconstruct import Reconstruct
from colmap_inertial.cli.scale import Scale
from colmap_inertial.cli.validate import Validate
from colmap_inertial.cli.view import View
from colmap_inertial.core.types import CAL, Action
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.run.commands import result as results
from colmap_inertial.run.stages.frame_folder import FrameRecord


@pytest.fixture
def told(monkeypatch, capsys):
    """What a function prints, with single spaces."""
    monkeypatch.setenv("COLUMNS", "300")

    def tell(show, *given):
        show(*given)
        return " ".join(capsys.readouterr().out.replace("\u2502", " ").split())

    return tell


def test_a_calibration_says_degrees_seconds_and_milliseconds(told):
    known = calibration_prior(Declared(cam_from_imu_xyzw=[0, 0, 0.6, 0.8], gyro_time_offset_s=-1.25))
    cov = np.zeros((CAL.COUNT, CAL.COUNT))
    cov[CAL.ROTATION, CAL.ROTATION] = np.diag([0.01, 0.02, 0.005]) ** 2
    cov[CAL.GYRO_TIME_OFFSET, CAL.GYRO_TIME_OFFSET] = 0.0025**2
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = np.diag([1e-4, 2e-4, 3e-4]) ** 2
    known = replace(known, gyro_bias_rad_s=np.array([0.01, -0.02, 0.0]), cov=cov)
    words = told(terminal.show_calibration, known, Path("desk"))
    assert "xyzw: +0.00000, +0.00000, +0.60000, +0.80000, +-1.1 deg" in words
    assert "-1.2500 s, +-2.5 ms (camera time = timestamp + offset)" in words
    assert "+0.0100, -0.0200, +0.0000 rad/s, +-0.0003" in words and "remembered" not in words.lower()
    assert "kept.json; reconstruct and scale take it" in told(
        terminal.show_calibration, known, Path("desk"), Path("kept.json")
    )


def test_what_was_applied_is_said_by_model_and_kind(told):
    def change(path, kind, *changed):
        return SimpleNamespace(path=path, kind=kind, changed=changed)

    metric = SimpleNamespace(similarity=SimpleNamespace(scale=2.5), verdict="trusted", reasons=("not said",))
    own = SimpleNamespace(similarity=None, verdict="refused", reasons=("it hardly moved",))
    applied = SimpleNamespace(
        models={0: ("sparse/0", metric), 1: ("sparse/1", own)},
        changes=[
            change("a.ply", "point cloud", "positions"),
            change("0.geometric.bin", "depth map", "depths"),
            change("1.geometric.bin", "depth map", "depths"),
            change("2.geometric.bin", "depth map", "depths"),
        ],
        unchanged={"linked": 7},
        notes=("one note", "another"),
        out=Path("metric"),
    )
    words = told(terminal.show_applied, applied)
    assert "Model 0 sparse/0: lengths times 2.5 (trusted)" in words and "not said" not in words
    assert "Model 1 sparse/1: kept its own units (refused) it hardly moved" in words
    assert "Point cloud a.ply (positions) Depth map 0.geometric.bin (depths) and 2 more Unchanged 7 linked" in words
    assert "Note one note another Written metric" in words
    applied.unchanged = {}
    assert "Unchanged nothing" in told(terminal.show_applied, applied)


def outcome(tmp_path, *, metric, **more):
    """The end of a reconstruction with a model for each that is metric or not."""
    (tmp_path / "colmap" / "sparse").mkdir(parents=True, exist_ok=True)
    space = SimpleNamespace(
        root=tmp_path,
        images=tmp_path / "images",
        sparse=tmp_path / "sparse",
        dense=tmp_path / "dense",
        colmap=tmp_path / "colmap",
        colmap_sparse=tmp_path / "colmap" / "sparse",
        report=tmp_path / "report.html",
    )
    models = [
        SimpleNamespace(
            index=k,
            colmap_index=k if k < 2 else k + 1,
            sparse=tmp_path / "colmap" / "sparse" / f"{k}",
            sparse_metric=tmp_path / "sparse" / f"{k}" if known else None,
            dense=None,
        )
        for k, known in enumerate(metric)
    ]
    return SimpleNamespace(
        **{
            "unchanged": False,
            "waiting": (),
            "models": models,
            "workspace": space,
            "fragments": (),
            "gaps": (),
            "project_metric": None,
            **more,
        }
    )


def test_a_reconstruction_says_where_metres_are_and_how_to_get_them(subtests, told, tmp_path_factory, monkeypatch):
    monkeypatch.setattr(terminal, "_model_lines", lambda model, result: [("scale", f"of {model.index}")])
    monkeypatch.setattr(terminal, "next_command", lambda result, source: "look")
    for metric in ((True, False), (True, True), (False, False), (True,), (False,)):
        with subtests.test(metric=metric):
            tmp_path = tmp_path_factory.mktemp("given")
            (tmp_path / "sparse").mkdir()
            words = told(terminal.show_result, outcome(tmp_path, metric=metric), Path("desk"))
            assert ("metres without the IMU" in words) == (not any(metric))
            assert (f"{tmp_path} is a COLMAP project in metres (sparse); in COLMAP's units" in words) == any(metric)
            assert ("nothing here is in metres" in words) == (not any(metric))
            assert words.endswith("next: look") and "nothing to do" not in words
            assert all(f"Scale of {k}" in words for k in range(len(metric)))


def test_a_reconstruction_says_what_was_left_out_or_not_joined(told, tmp_path, monkeypatch):
    monkeypatch.setattr(terminal, "_model_lines", lambda model, result: [("scale", "known")])
    monkeypatch.setattr(terminal, "next_command", lambda result, source: "look")
    gaps = [
        SimpleNamespace(first=0, second=1, seconds=2.04, joined=True, reason=""),
        SimpleNamespace(first=1, second=3, seconds=4.56, joined=False, reason="no IMU"),
    ]
    fragments = [SimpleNamespace(colmap_index=2, registered_images=5)]
    result = outcome(tmp_path, metric=(True, True, True), gaps=gaps, fragments=fragments, unchanged=True)
    words = told(terminal.show_result, result, Path("desk"))
    assert "COLMAP's models 1 and 3, 4.6 s apart, are not joined: no IMU" in words and "models 0 and 1" not in words
    assert "COLMAP's model 2 is a fragment of 5 images, left out" in words
    assert "Model 1 " in words and "Model 2 (COLMAP's 3)" in words and "Model 1 (COLMAP" not in words
    assert "nothing to do: kept from the earlier run" in words
    result.waiting = ("later",)
    assert "nothing to do" not in told(terminal.show_result, result, Path("desk"))
    result.project_metric = tmp_path
    assert f"{tmp_path} is the whole project in metres" in told(terminal.show_result, result, Path("desk"))


def test_deblurring_is_counted_by_what_was_done(monkeypatch):
    monkeypatch.setattr(results, "describe_shutter", lambda plan, rectified: "global")

    def lines(*actions, view=None):
        plan = SimpleNamespace(view=view, deblur_note="by the gyroscope")
        frames = [FrameRecord(name="a", action=Action(action), sharpened=action == "deblurred") for action in actions]
        return dict(terminal.imaging_lines(frames, plan, ()))

    found = lines("deblurred", "dropped", "deblurred", "passed")
    assert found == {"deblurring": "2 deblurred, 1 dropped of 4 frames: by the gyroscope", "shutter": "global"}
    assert lines("passed")["deblurring"] == "by the gyroscope"
    assert lines("passed", view=SimpleNamespace(notes=("a note",)))[""] == "a note"


def test_an_export_says_unit_model_and_command(told):
    made = SimpleNamespace(
        model=1, others=(0, 1), unit="m", images=12, points=345, notes=(), says="", folder=Path("out"), program="Brush",
        command="brush out",
    )  # fmt: skip
    words = told(terminal.show_exported, made)
    assert "Export for Brush" in words and "Model 1 of 2; --model takes 0, 1 Unit metres" in words
    assert "Images 12 Points 345 Written out" in words and words.endswith("brush out")
    made.others, made.unit, made.images, made.points, made.program, made.command = (0,), "model", 0, 0, None, ""
    words = told(terminal.show_exported, made)
    assert "Model 1 Unit unknown: not metres Written out" in words and "Export for" not in words


def test_a_viewer_that_others_can_reach_says_so(subtests, told):
    for host, warned in (("127.0.0.1", False), ("localhost", False), ("0.0.0.0", True)):
        with subtests.test(host=host):
            words = told(terminal.show_view, Path("out"), "http://address", host)
            assert words.startswith("out is shown at http://address (Ctrl-C ends this)")
            assert ("anyone on the network" in words) == warned


HERE = Path("here")
ALLOWED = [
    (Reconstruct, {"capture": HERE, "out": HERE}, {"workers": 1}),
    (Reconstruct, {"capture": HERE, "out": HERE}, {"scheduler": "tcp://host:1"}),
    (Scale, {"source": HERE}, {"first_s": 1e-3}),
    (Apply, {"project": HERE, "out": HERE}, {"factor": 1e-9}),
    (Apply, {"project": HERE, "out": HERE}, {"undo": True}),
    (Apply, {"project": HERE, "out": HERE}, {"scale": HERE, "keep": ("old/*",)}),
    (Validate, {"model": HERE, "images": HERE, "target": "x"}, {"tolerance": 1e-3}),
    (Validate, {"model": HERE, "images": HERE, "target": "x"}, {"tolerance": 99.9}),
    (Export, {"out": HERE, "dir": HERE}, {"capture": HERE, "images": "original"}),
    (Export, {"out": HERE, "dir": HERE}, {"capture": HERE, "georeference": True}),
    (View, {"out": HERE}, {"max_points": 1, "port": 0}),
    (View, {"out": HERE}, {"port": 65535}),
    (View, {"out": HERE}, {"quiet": True}),
    (View, {"out": HERE}, {"verbose": True}),
]
REFUSED = [
    (Reconstruct, {"capture": HERE, "out": HERE}, {"workers": 0}, "workers"),
    (Reconstruct, {"capture": HERE, "out": HERE}, {"workers": 2, "scheduler": "tcp://host:1"}, "--scheduler"),
    (Scale, {"source": HERE}, {"first_s": 0.0}, "first_s"),
    (CalibrateImu, {"recording": (), "out": HERE}, {}, "name the recording"),
    (Apply, {"project": HERE, "out": HERE}, {"factor": 0.0}, "factor"),
    (Apply, {"project": HERE, "out": HERE}, {"factor": float("inf")}, "factor"),
    (Apply, {"project": HERE, "out": HERE}, {}, "give one of"),
    (Apply, {"project": HERE, "out": HERE}, {"factor": 2.0, "undo": True}, "give one of"),
    (Apply, {"project": HERE, "out": HERE}, {"undo": True, "keep": ("old/*",)}, "--keep"),
    (Validate, {"model": HERE, "images": HERE, "target": "x"}, {"tolerance": 0.0}, "tolerance"),
    (Validate, {"model": HERE, "images": HERE, "target": "x"}, {"tolerance": 100.0}, "tolerance"),
    (Export, {"out": HERE, "dir": HERE}, {"capture": HERE}, "--capture"),
    (View, {"out": HERE}, {"max_points": 0}, "max_points"),
    (View, {"out": HERE}, {"port": -1}, "port"),
    (View, {"out": HERE}, {"port": 65536}, "port"),
]


def test_options_are_allowed_up_to_their_ends(subtests):
    for command, given, options in ALLOWED:
        with subtests.test(command=command.__name__, options=options):
            made = command(**given, **options)
            assert {name: getattr(made, name) for name in options} == options


def test_options_beyond_their_ends_or_against_each_other_are_refused(subtests):
    for command, given, options, said in REFUSED:
        with (
            subtests.test(command=command.__name__, options=options, said=said),
            pytest.raises(ValueError, match=said),
        ):
            command(**given, **options)
