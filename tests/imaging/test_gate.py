"""The gate of deblurring."""

from types import SimpleNamespace

import pytest

from colmap_inertial.imaging import gate


@pytest.mark.parametrize(("support", "mirrored", "clear"), [(2.0, -1.0, True), (2.0, 1.9, False), (0.1, 0.0, False)])
def test_frames_confirm_a_gyroscope_together_but_not_its_mirror_image(support, mirrored, clear):
    scale = gate.GATE_LIMITS.together_support
    together = SimpleNamespace(
        support=support * scale, mirrored_support=mirrored * scale, extent_is_plausible=True, extent_factor=1.0
    )
    telling = [SimpleNamespace(support=9.0, mirrored_support=0.0)] * 9
    assert gate._is_clear_together(telling, together) is clear
