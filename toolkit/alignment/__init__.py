"""Robust estimates: similarity of predicted cameras and the map, scale of depths, averages of poses."""

from toolkit.alignment.similarity import Alignment, AlignmentError, Sim3, align_to_map, is_trustworthy, query_pose

__all__ = ["Alignment", "AlignmentError", "Sim3", "align_to_map", "is_trustworthy", "query_pose"]
