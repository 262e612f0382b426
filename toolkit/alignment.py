"""Align predicted cameras to the map; see `toolkit.localizers.alignment`."""

from toolkit.localizers.alignment import Alignment, AlignmentError, Sim3, align_to_map, is_trustworthy, query_pose

__all__ = ["Alignment", "AlignmentError", "Sim3", "align_to_map", "is_trustworthy", "query_pose"]
