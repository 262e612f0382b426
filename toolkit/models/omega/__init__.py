"""VGGT-Omega: the network, the loader of its images, and its pose encoding, which is VGGT's."""

from toolkit.models.omega.network import HEADS, VGGTOmega
from toolkit.models.omega.preprocess import load_images
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding, unproject_depth
from toolkit.models.views import Views
