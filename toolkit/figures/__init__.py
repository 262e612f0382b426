"""Figures: one function or class for each, for notebooks and PNG files."""
