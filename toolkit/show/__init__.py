"""Recordings for the rerun viewer, still pictures, figures and the report."""

TEXT_BARS = "TOOLKIT_TEXT_BARS"
"""Variable of the environment that is set where no one sees widgets: progress bars are text then."""
