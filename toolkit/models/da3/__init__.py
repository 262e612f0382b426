"""Depth Anything 3: the network, the loader of its images, and its pose encoding."""

from toolkit.models.da3.cameras import cameras_from_pose_encoding
from toolkit.models.da3.network import HEADS, DepthAnything3
from toolkit.models.da3.preprocess import load_images
from toolkit.models.vggt.pose_encoding import unproject_depth
from toolkit.models.views import Views
