"""Submodels of one capture, the constraints between them, their placement, and one model of all of them.

Three sources give constraints: images that two submodels share, verified matches between images of two submodels, and
the IMU (:mod:`colmap_inertial.inertial.join`).
"""
