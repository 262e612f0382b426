"""Captures and images in, models, pairs and submissions out."""
