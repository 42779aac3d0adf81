"""A reconstruction in the browser: what is shown (``scene``), how one measures in it (``measure``), and the server."""

from colmap_inertial.tools.view.measure import Measured, measure_distance, nearest_to_ray, round_length
from colmap_inertial.tools.view.scene import Scene, load_scene

__all__ = ["Measured", "Scene", "load_scene", "measure_distance", "nearest_to_ray", "round_length"]
