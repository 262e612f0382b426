"""The pose of a query: matches with the map, hypotheses, refinement, and how far to trust it."""

from toolkit.pose.base import Localizer, Query, QueryResult, References, RoughPose, Status, View

__all__ = ["Localizer", "Query", "QueryResult", "References", "RoughPose", "Status", "View"]
