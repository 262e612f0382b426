"""Tell where a photograph was taken: metric 6-DoF poses of queries in a map of posed photographs."""

__version__ = "0.1.0"
