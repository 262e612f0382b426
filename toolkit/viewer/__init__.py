"""Recordings for the rerun viewer: sessions, maps, localized queries."""
