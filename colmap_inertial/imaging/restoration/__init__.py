"""Images restored by networks: DeepGyro undoes motion blur, LSD2 makes one image of a short and a long exposure.

The networks come with the package and run in onnxruntime, which the extra ``restore`` installs.
"""

from colmap_inertial.imaging.restoration.network import Device, Network, load_network, require_network
from colmap_inertial.imaging.restoration.shipped import NetworkName

__all__ = ["Device", "Network", "NetworkName", "load_network", "require_network"]
