"""The ways to find a pose, behind one interface."""

from toolkit.localizers.base import Localizer, PoseEstimate, Query, References, RoughPose, View
from toolkit.localizers.map import Map, create_localizer
