"""Readers: what users' files hold, in SI units and one set of axes, with typed errors.

``imu`` reads inertial recordings of the families in ``imu_formats`` (one module for each recorder or family), which
other packages add to, and which finds recordings that describe themselves; ``capture`` describes whole recordings
(``capture.toml``), ``frames`` gives images and their times, ``trajectories`` poses in text files, ``calibration`` what
is known of camera and IMU, ``tables`` numbers in text, ``files`` JSON and text that are written whole or not at all,
checks of names, and locks.
"""
