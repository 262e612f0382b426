"""The pose of a query: matches with the map, hypotheses, refinement, and how far to trust it."""

from toolkit.pose.base import Localizer, PoseEstimate, Query, References, RoughPose, View

__all__ = ["Localizer", "PoseEstimate", "Query", "References", "RoughPose", "View"]
