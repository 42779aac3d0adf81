"""A finished reconstruction in the forms that other programs read, metres and up kept.

:func:`~colmap_inertial.tools.export.whole.export_model` writes one folder that all splatting and NeRF trainers read,
and what single programs ask for: velocities for deblurring, camera paths, cameras, points. Images become those of
pinhole cameras with the principal point exactly in the middle, because some trainers know no other.
"""
