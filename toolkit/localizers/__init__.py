"""Localizers: a query's features and its references in, a pose and how far to trust it out."""
