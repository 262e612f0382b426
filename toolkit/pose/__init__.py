"""The pose of a query: matches with the map, hypotheses, refinement, and how far to trust it."""

from toolkit.pose.base import Localizer, Query, References, RoughPose, View
from toolkit.pose.result import QueryResult, Status

__all__ = ["Localizer", "Query", "QueryResult", "References", "RoughPose", "Status", "View"]
