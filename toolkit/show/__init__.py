"""Recordings for the rerun viewer, still pictures, figures and the report."""
