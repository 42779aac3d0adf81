"""Remarks and refusals of a validation."""

from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.errors import TargetNotFoundError
from colmap_inertial.validate import measure
from colmap_inertial.validate.measure import _list_remarks
from colmap_inertial.validate.targets import parse_target


def test_few_views_are_remarked_on_below_five():
    search = SimpleNamespace(sightings=[], searched=range(9), views=range(9), target=parse_target("aruco:4X4_50:0.1"))
    fit = SimpleNamespace(noise=SimpleNamespace(pose_ratio=np.zeros(2)))
    said = [_list_remarks(search, None, fit, tuple(range(count))) for count in (4, 5)]
    assert [any("the interval is wide" in str(line) for line in lines) for lines in said] == [True, False]


@pytest.mark.parametrize(("images", "agree"), [(10, True), (11, False)])
def test_a_fifth_of_the_images_that_show_a_target_agree_where_it_is(images, agree):
    sightings = [SimpleNamespace(view=i) for i in range(images)]
    search = SimpleNamespace(parts={0: sightings}, sightings=sightings, target=SimpleNamespace(spec="board"))
    placed = {0: SimpleNamespace(chosen=[3, 7])}
    if agree:
        assert measure._require_agreement(search, placed) is None
    else:
        with pytest.raises(TargetNotFoundError, match=rf"detected in {images} images, but only 2 of them agree"):
            measure._require_agreement(search, placed)
