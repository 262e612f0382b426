"""Read, write and check captures in the format of LaMAR and CroCoDL: sessions of images with calibration and poses."""

from toolkit.capture.cameras import CAMERA_TYPES, camera_text, parse_camera
from toolkit.capture.folder import Capture
from toolkit.capture.session import RAW_DATA, Session
from toolkit.capture.tables import COLUMNS
from toolkit.capture.trajectory import Trajectory
from toolkit.capture.writing import DEPTH_SCALE, read_depth, write_depth, write_session
