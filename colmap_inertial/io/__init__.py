"""Readers: what users' files hold, in SI units and one set of axes, with typed errors.

``imu`` finds and reads inertial recordings (one file for each recorder or family), ``recorders`` those that describe
themselves, ``capture`` describes whole recordings (``capture.toml``), ``frames`` gives
pictures and their times, ``trajectories`` poses in text files, ``calibration`` what is known of camera and IMU,
``files`` JSON and text that are written whole or not at all.
"""
