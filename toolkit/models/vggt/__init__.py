"""VGGT: the network, its images, and the cameras it returns."""

from toolkit.models.vggt.network import HEADS, VGGT
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding, unproject_depth
from toolkit.models.vggt.preprocess import Views, load_images
