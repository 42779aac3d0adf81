"""What becomes of a frame that may be deblurred, decision by decision; the picture's part is made up."""

from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Frame
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import GATE_LIMITS, Decision, FrameDecision, GateOptions, RecordingVerdict
from colmap_inertial.run.stages import deblur
from colmap_inertial.run.stages.deblur import DeblurStage


def verdict_of(trusted):
    return RecordingVerdict(
        trusted=trusted, support=3.0, extent_factor=1.0, frames=5, reason=Fact.stated("by five frames")
    )


@pytest.fixture
def treat(monkeypatch):
    """Treats one frame of 20 px of blur; each part of what is seen may be said."""

    def treated(action="deblur", *, trusted=True, length=20.0, factor=1.0, kept=0.0, departs=0.0, doubt="", **options):
        seen = {}
        field = BlurField.uniform(64, 48, (length, 0.0))

        def blur_field(motion, camera, shutter, *, parallax):
            seen["parallax"] = parallax
            if length == 0:
                raise NotObservableError("motion blur", Fact.stated("no exposure"))
            return field

        def blur_path(motion, camera, shutter, *, parallax, extent_factor=1.0):
            seen["path"] = extent_factor
            return SimpleNamespace(departure_px=lambda: departs)

        def keep_sharp(image, out, blur):
            seen["blur"] = float(blur.vector_px.max())
            return out, kept

        monkeypatch.setattr(deblur, "blur_field", blur_field)
        monkeypatch.setattr(deblur, "blur_path", blur_path)
        monkeypatch.setattr(deblur, "keep_sharp", keep_sharp)
        monkeypatch.setattr(deblur, "judge_frame", lambda *_: (factor, Fact.stated("judged")))
        decision = FrameDecision(name="a.jpg", action=Decision(action), reason=Fact.stated("decided"), blur_px=length)
        stage = DeblurStage(
            view=SimpleNamespace(sign_doubt=Fact.stated(doubt) if doubt else None),
            decisions=(decision,),
            verdict=verdict_of(trusted),
            parallaxes={"a.jpg": "slid"},
            **options,
        )
        frame = Frame(name="a.jpg", image=np.full((48, 64), 7, np.uint8), t_s=0.0)
        made = stage._treated(frame, decision, None, None, None, lambda image, path: image + 1)
        (told,) = made.treatments
        assert told.stage == "deblur" and told.values["blur_px"] == length
        return SimpleNamespace(
            frame=made,
            said=str(told.reason),
            values=told.values,
            done=told.action,
            changed=made.image[0, 0] == 8,
            seen=seen,
        )

    return treated


def test_a_frame_that_is_not_deblurred_keeps_its_pixels_and_says_why(subtests, treat):
    for given, said, dropped in (
        ({"action": "keep"}, "decided", False),
        ({"trusted": False}, "by five frames", False),
        ({"action": "drop", "trusted": False}, "by five frames", False),
        ({"action": "drop"}, "decided", True),
        ({"action": "drop", "trusted": None}, "decided", False),
        ({"length": 0.0}, "no exposure", False),
        ({"length": 340.0}, "340 px of blur, too long to deblur", False),
        ({"doubt": "no sign", "departs": GATE_LIMITS.straight_px * 1.01}, "no sign, and the opposite sign", False),
        ({"factor": None}, "judged", False),
    ):
        with subtests.test(given=given, said=said, dropped=dropped):
            found = treat(**given)
            assert said in found.said and not found.changed and found.frame.dropped == dropped
            assert found.done == "" and found.frame.smoothing_px == 0
            assert found.values["kept_share"] == 1 and found.values["extent_factor"] == 1


def test_a_frame_that_may_be_deblurred_is(subtests, treat):
    for given in (
        {},
        {"trusted": None},
        {"action": "drop", "drop": False},
        {"length": 330.0},
        {"doubt": "no sign", "departs": GATE_LIMITS.straight_px * 0.99},
        {"departs": GATE_LIMITS.straight_px * 9},
    ):
        with subtests.test(given=given):
            found = treat(**given)
            assert found.said == "judged" and found.changed and not found.frame.dropped and found.done == "deblurred"
            assert found.seen["parallax"] == "slid" and found.seen["path"] == 1


def test_the_extent_that_the_picture_shows_is_that_of_the_field_and_the_path(treat):
    found = treat(factor=1.2)
    assert found.seen["blur"] == pytest.approx(24) and found.seen["path"] == 1.2
    assert found.values["extent_factor"] == 1.2


def test_features_see_what_was_deblurred_smoothed_by_its_blur(treat):
    assert treat(smoothing=0.05, most_smoothing_px=9.0).frame.smoothing_px == pytest.approx(1.0)
    assert treat(smoothing=0.05, most_smoothing_px=9.0, factor=1.5).frame.smoothing_px == pytest.approx(1.5)
    assert treat(smoothing=0.05, most_smoothing_px=0.8).frame.smoothing_px == pytest.approx(0.8)
    # not where much of it stayed as it was
    limit = deblur.SMOOTHING.kept_share
    for kept, smoothed in ((0.99 * limit, True), (limit, False), (1.0, False)):
        found = treat(smoothing=0.05, kept=kept)
        assert (found.frame.smoothing_px > 0) == smoothed and found.values["kept_share"] == kept


def test_frames_that_speak_for_themselves_must_speak_clearly_for_a_filter(subtests):
    for method, clear in (("wiener", True), ("path", True), ("deepgyro", False)):
        with subtests.test(method=method, clear=clear):
            plan = SimpleNamespace(view=object(), method=method, parallaxes={}, deblur=((), verdict_of(None)))
            stage = DeblurStage.of_plan(plan, drop=False, smoothing=False)
            assert stage.gate.min_support == (GATE_LIMITS.clear_support if clear else 0.0)
            assert not stage.drop and stage.smoothing == 0 and bool(stage.weights) == (method == "deepgyro")
            plan.deblur = ((), verdict_of(True))
            stage = DeblurStage.of_plan(plan)
            assert stage.gate == GateOptions() and stage.drop and stage.smoothing == deblur.SMOOTHING.share
            plan.deblur = None
            assert DeblurStage.of_plan(plan) is None
            with pytest.raises(ValueError, match="not fourier"):
                DeblurStage(view=object(), decisions=(), verdict=verdict_of(True), method="fourier")
