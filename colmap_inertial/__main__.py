"""``python -m colmap_inertial``."""

from colmap_inertial.cli import main

main()
