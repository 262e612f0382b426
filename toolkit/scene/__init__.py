"""A finished run in the hand: its maps, and the way of an image through them."""

from toolkit.scene.map import Map, create_localizer
from toolkit.scene.run import Run

__all__ = ["Map", "Run", "create_localizer"]
