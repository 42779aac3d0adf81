"""Readers: what users' files hold, in SI units and one set of axes, with typed errors.

``imu`` reads inertial recordings of the families in ``imu_formats`` (one file for each recorder or family), which other
packages add to, ``recorders`` those that describe themselves; ``capture`` describes whole recordings
(``capture.toml``), ``frames`` gives images and their times, ``trajectories`` poses in text files, ``calibration`` what
is known of camera and IMU, ``files`` JSON and text that are written whole or not at all, and locks.
"""
