"""Make the textures of a room's rectangles, with the light of its lamps baked in."""

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.synthetic.scene import Quad, Scene, named_rng
from toolkit.synthetic.textures import Image, in_color

LEVELS = 6  # mip levels; texture sides are multiples of 2 ** (LEVELS - 1)
SOLD_OFTEN = ("books", "crate", "door", "drawers", "window")  # materials that look alike in a world with look-alikes
MODELS = 2  # textures per such material and size in whole meters


def _blocked(scene: Scene, start: Image, way: Image) -> NDArray[np.bool_]:
    """Return which segments start + t * way, t in (0, 1), (N, 3) each, intersect a box of the scene (slab test)."""
    hit = np.zeros(len(start), bool)
    if not len(start):
        return hit
    ends = np.concatenate([start, start + way])
    lows, highs = scene.blocker_bounds
    near = ((highs >= ends.min(0)) & (lows <= ends.max(0))).all(1)
    for k in np.flatnonzero(near):
        center, half, yaw = scene.blockers[k]
        c, s = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
        px, py, pz = (start - center.astype(np.float32)).T
        vx, vy, vz = way.T
        enter, leave = np.zeros(len(start), np.float32), np.ones(len(start), np.float32)
        for origin, along, side in (
            (c * px + s * py, c * vx + s * vy, half[0]), (c * py - s * px, c * vy - s * vx, half[1]),
            (pz, vz, half[2]),
        ):  # fmt: skip
            inverse = 1 / np.where(np.abs(along) < 1e-6, np.float32(1e-6), along)
            middle, spread = -origin * inverse, np.abs(np.float32(side) * inverse)
            np.maximum(enter, middle - spread, out=enter)
            np.minimum(leave, middle + spread, out=leave)
        hit |= enter < leave
    return hit


def _light(scene: Scene, quad: Quad) -> Image:
    """Return the light on a rectangle as a coarse float32 image: lamps with shadows, and ambient occlusion."""
    rows, columns = max(2, round(quad.height / 0.15)), max(2, round(quad.width / 0.15))
    t, s = np.mgrid[0:rows, 0:columns] + 0.5
    points = quad.corner + (s.ravel() * quad.width / columns)[:, None] * quad.right
    points = points + (t.ravel() * quad.height / rows)[:, None] * quad.down + 0.02 * quad.normal
    points = points.astype(np.float32)
    # Cosine-weighted directions over the hemisphere (Lambert's law), on a spiral with the golden angle.
    i = np.arange(14) + 0.5
    radius, angle = np.sqrt(i / 14), i * 2.399963
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - i / 14)], -1)
    ways = (1.3 * local @ np.stack([quad.right, quad.down, quad.normal])).astype(np.float32)
    w, d, h = scene.size
    low = scene.origin - np.array([w / 2, d / 2, 0])
    high = scene.origin + np.array([w / 2, d / 2, 99 if scene.outdoor else h])
    starts, ways = np.repeat(points, len(ways), 0), np.tile(ways, (len(points), 1))
    ends = starts + ways
    closed = ((ends < low) | (ends > high)).any(1)
    inside = np.flatnonzero(~closed)
    closed[inside] = _blocked(scene, starts[inside], ways[inside])
    lit = (0.62 if scene.outdoor else 0.58) * (1 - 0.65 * closed.reshape(len(points), -1).mean(1))
    offsets = np.array([[0, 0], [0.35, 0.1], [-0.35, -0.1]], np.float32) * (1.5 if scene.outdoor else 1.0)
    lit_by, ways_to = [], []
    for lamp_at in scene.lamps:
        for dx, dy in offsets:
            way = (lamp_at + np.array([dx, dy, 0]) - points).astype(np.float32)
            distance = np.linalg.norm(way, axis=1)
            cosine = np.clip(way @ quad.normal.astype(np.float32) / distance, 0, 1)
            if not cosine.any():
                continue
            fall = 0.85 / len(scene.lamps) if scene.outdoor else 1.5 / len(scene.lamps) * 6 / (distance**2 + 3.0)
            lit_by.append(fall * cosine / len(offsets))
            ways_to.append(way)
    if ways_to:  # one call for all lamps, because most rectangles have few points
        blocked = _blocked(scene, np.tile(points, (len(ways_to), 1)), np.concatenate(ways_to))
        for light, shadow in zip(lit_by, blocked.reshape(len(ways_to), -1), strict=True):
            lit = lit + light * ~shadow
    return cv2.GaussianBlur(lit.reshape(rows, columns).astype(np.float32), (3, 3), 0)


def paint(scene: Scene, seed: int, index: int, number: int, look_alikes: bool = False) -> None:
    """Make the texture of rectangle `number` of room `index`, with light baked in, and its mip levels."""
    quad = scene.quads[number]
    multiple = 2 ** (LEVELS - 1)
    h, w = (max(multiple, round(side * quad.ppm / multiple) * multiple) for side in (quad.height, quad.width))
    rng = named_rng(seed, index, "quad", number)
    name = getattr(quad.material, "func", quad.material).__name__
    if look_alikes and name in SOLD_OFTEN:
        # Draw the texture for whole meters and crop it, so that objects of different widths share their left part.
        full_h, full_w = (round(np.ceil(side) * quad.ppm) + multiple for side in (quad.height, quad.width))
        model = named_rng(seed, "model", name, int(rng.integers(MODELS)))
        image = quad.material(model, full_h, full_w, quad.ppm)[:h, :w]
    else:
        image = quad.material(rng, h, w, quad.ppm)
    if quad.lit:
        light = cv2.resize(_light(scene, quad), (w, h), interpolation=cv2.INTER_LINEAR)
        image = cv2.multiply(image, in_color(light), dtype=cv2.CV_8U)
    for pyramid, level in ((quad.color, image), (quad.gray, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))):
        pyramid.append(level)
        for _ in range(LEVELS - 1):
            height, width = level.shape[:2]
            level = cv2.resize(level, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            pyramid.append(level)
