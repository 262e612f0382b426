"""A finished run in the hand: its maps, and the way of an image through them."""

from toolkit.scene.images import localize_image, localize_images
from toolkit.scene.map import Map
from toolkit.scene.run import Run

__all__ = ["Map", "Run", "localize_image", "localize_images"]
