"""Cameras that agree with the gyroscope."""

import numpy as np

from colmap_inertial.core.types.consensus import RotationConsensus


def test_deviations_of_cameras_that_were_registered_again_are_the_later_ones():
    def consensus(names, deviation_deg, part):
        return RotationConsensus(
            names=names,
            t_s=np.arange(len(names), dtype=float),
            judged=np.ones(len(names), dtype=bool),
            deviation_deg=np.array(deviation_deg),
            part=np.array(part),
            ref_from_part_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]]),
        )

    before = consensus(("a", "b", "c"), [0.5, 40.0, 90.0], [0, -1, -1])
    after = before.updated(consensus(("b", "a"), [0.25, 0.75], [0, 0]))
    assert after.deviations_deg == {"a": 0.75, "b": 0.25, "c": 90.0}
    assert after.registered_again == ("b",) and [camera.name for camera in after.wrong] == ["c"]
