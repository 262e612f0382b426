"""VGGT: the network, the loader of its images, and its pose encoding."""

from toolkit.models.vggt.network import HEADS, VGGT
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding, unproject_depth
from toolkit.models.vggt.preprocess import load_images
from toolkit.models.views import Views
