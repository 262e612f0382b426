"""Read, write and check captures in the format of LaMAR and CroCoDL: sessions of images with calibration and poses."""

from toolkit.capture.images import CAMERA_TYPES, camera_text, parse_camera
from toolkit.capture.session import Capture, Session
from toolkit.capture.tables import COLUMNS, DEPTH_SCALE, Trajectory, read_depth, write_depth, write_session
