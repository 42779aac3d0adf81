"""Printed summaries."""

from colmap_inertial.core import summary


def test_a_text_as_long_as_its_room_is_not_cut():
    assert [summary._cut("abcdef", width) for width in (5, 6, 7)] == ["ab...", "abcdef", "abcdef"]
