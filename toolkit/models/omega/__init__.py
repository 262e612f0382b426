"""VGGT-Omega: the network, its images, and the cameras it returns, which are encoded as VGGT's."""

from toolkit.models.omega.network import HEADS, VGGTOmega
from toolkit.models.omega.preprocess import load_images
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding, unproject_depth
from toolkit.models.views import Views
