"""A rendered capture: textured rooms seen by a phone, a headset and a robot, with exact ground truth.

Every surface is a textured planar rectangle (textures.py). A picture is made sample by sample, four a
pixel: the ray of each sample through the camera's own model (distortion included) meets the planes, the
nearest wins, and its texture is read at the mip level of the sample's footprint. So poses, intrinsics and
depths are exact. The world has z up and meters; the rooms stand far apart. All randomness comes from the
seed and the name of the thing that is drawn, never from the order of work: the bytes do not depend on the
number of cores.
"""

import json
import os
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CaptureError
from toolkit.geometry import Array, invert, make_pose, pose_from_qt, qt_from_pose, rotation_angle_deg
from toolkit.synthetic.textures import (
    Image,
    Material,
    Rng,
    books,
    cells,
    chalk,
    cloth,
    clouds,
    crate,
    door,
    drawers,
    lamp,
    leaves,
    notes,
    painting,
    plain,
    plaster,
    poster,
    random_color,
    window,
    wood,
)

if TYPE_CHECKING:
    import pycolmap

FORMAT = 1  # raise it when the same settings give other bytes
UP = np.array([0.0, 0.0, 1.0])
NEAR_M = 0.05
LEVELS = 6  # of the mip-maps; texture sides are multiples of 2 ** (LEVELS - 1)
SAMPLES = 2  # a side of a pixel
SOLD_OFTEN = ("books", "crate", "door", "drawers", "window")
MODELS = 2  # of each of these things and each size in whole meters, where a world has look-alikes


def _random(*key: int | str) -> Rng:
    """Return the generator of the thing named by `key`, whatever was drawn before it."""
    return np.random.default_rng([k if isinstance(k, int) else zlib.crc32(k.encode()) for k in key])


# ----------------------------------------------------------------------------------------------- the scene


@dataclass
class Quad:
    """A textured rectangle: its texture's top left corner and unit axes, in world meters."""

    corner: Array
    right: Array
    down: Array
    width: float
    height: float
    material: Material
    ppm: float
    lit: bool = True
    color: list[Image] = field(default_factory=list)  # mip levels, BGR; [0] is the finest
    gray: list[Image] = field(default_factory=list)

    @cached_property
    def normal(self) -> Array:
        """The unit normal on the side that is seen."""
        return np.cross(self.down, self.right)

    @cached_property
    def corners(self) -> Array:
        """The four corners (4, 3), clockwise from the texture's top left."""
        w, h = self.width, self.height
        return self.corner + np.array([[0, 0], [w, 0], [w, h], [0, h]]) @ np.stack([self.right, self.down])


@dataclass
class Scene:
    """The rectangles of one room, its boxes as obstacles to light, and its lamps."""

    origin: Array
    size: tuple[float, float, float]
    outdoor: bool
    quads: list[Quad] = field(default_factory=list)
    blockers: list[tuple[Array, Array, float]] = field(default_factory=list)  # center, half sizes, yaw
    lamps: list[Array] = field(default_factory=list)

    def plate(
        self, corner: Any, right: Any, down: Any, width: float, height: float, material: Material,
        ppm: float = 300.0, lit: bool = True,
    ) -> None:  # fmt: skip
        """Add one rectangle, its corner relative to the room's origin."""
        axes = np.asarray(right, float), np.asarray(down, float)
        self.quads.append(
            Quad(self.origin + np.asarray(corner, float), *axes, width, height, material, ppm, lit)
        )

    def box(
        self, x: float, y: float, z: float, size: tuple[float, float, float], yaw: float, front: Material,
        side: Material | None = None, top: Material | None = None, ppm: float = 350.0, lit: bool = True,
        back: bool = True,
    ) -> None:  # fmt: skip
        """Add a box standing at height z on (x, y); its front looks along +y turned by `yaw` radians."""
        half = np.array(size) / 2
        center = np.array([x, y, z + half[2]])
        axis_x, axis_y = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        for normal, reach, wide, material in (
            (axis_y, half[1], half[0], front), (-axis_y, half[1], half[0], side or front),
            (axis_x, half[0], half[1], side or front), (-axis_x, half[0], half[1], side or front),
        ):  # fmt: skip
            if normal @ axis_y < -0.5 and not back:
                continue
            right = np.cross(UP, normal)
            corner = center + normal * reach - right * wide + UP * half[2]
            self.plate(corner, right, -UP, 2 * wide, size[2], material, ppm, lit)
        corner = center - axis_x * half[0] + axis_y * half[1] + UP * half[2]
        self.plate(corner, axis_x, -axis_y, size[0], size[1], top or side or front, ppm, lit)
        if z > 0.1:  # its underside can be seen
            corner = center - axis_x * half[0] - axis_y * half[1] - UP * half[2]
            self.plate(corner, axis_x, axis_y, size[0], size[1], top or side or front, ppm, lit)
        if min(size) > 0.05 and lit:
            self.blockers.append((self.origin + center, half, yaw))


def _on_wall(scene: Scene, wall: int, along: float, depth: float) -> tuple[float, float, float]:
    """Return x, y, yaw of a box of this depth set against a wall, `along` meters from the wall's middle."""
    w, d, _ = scene.size
    gap = depth / 2 + 0.004
    x, y, yaw = [
        (along, d / 2 - gap, np.pi), (w / 2 - gap, -along, np.pi / 2),
        (-along, -d / 2 + gap, 0.0), (-w / 2 + gap, along, -np.pi / 2),
    ][wall]  # fmt: skip
    return x, y, yaw


def _flat(
    scene: Scene,
    wall: int,
    along: float,
    z: float,
    w: float,
    h: float,
    material: Material,
    ppm: float = 420.0,
) -> None:
    """Hang a thin board on a wall."""
    x, y, yaw = _on_wall(scene, wall, along, 0.03)
    scene.box(x, y, z, (w, 0.03, h), yaw, material, plain, ppm=ppm, back=False)


def _clutter(
    scene: Scene, rng: Rng, x: float, y: float, z: float, wide: float, deep: float, yaw: float, count: int
) -> None:
    """Stand small boxes on a surface, side by side."""
    for i in range(count):
        size = rng.uniform([0.1, 0.1, 0.08], [0.26, 0.24, 0.34])
        along, across = (i + 0.5) / count * wide - wide / 2, rng.uniform(-0.2, 0.2) * deep
        px, py = (
            x + along * np.cos(yaw) - across * np.sin(yaw),
            y + along * np.sin(yaw) + across * np.cos(yaw),
        )
        material = [poster, crate, books, cloth][int(rng.integers(4))]
        scene.box(px, py, z, tuple(size), yaw + rng.uniform(-0.5, 0.5), material, material, poster, 450)


def _furnish(scene: Scene, rng: Rng, wall: int, along: float, room: float, kind: str) -> float:
    """Put one thing against a wall from `along` on; return the width it takes, 0 where it does not fit."""
    tall = scene.size[2]
    width = {
        "shelf": rng.uniform(0.9, 1.6), "cabinet": rng.uniform(0.8, 1.4), "posters": rng.uniform(0.6, 0.9),
        "door": 1.0, "window": rng.uniform(1.1, 1.5), "board": rng.uniform(1.2, 1.8), "crates": 1.1,
        "pillar": 0.4,
        "painting": rng.uniform(0.9, 1.5), "planter": rng.uniform(0.9, 1.5), "bench": rng.uniform(1.3, 1.8),
    }[kind]  # fmt: skip
    if width > room:
        return 0.0
    mid = along + width / 2
    tone = partial(wood, color=np.asarray((60, 100, 145)) * rng.uniform(0.5, 1.5))
    if kind == "shelf":
        x, y, yaw = _on_wall(scene, wall, mid, 0.34)
        scene.box(x, y, 0, (width, 0.34, rng.uniform(1.75, 2.3)), yaw, books, tone, back=False)
    elif kind == "cabinet":
        x, y, yaw = _on_wall(scene, wall, mid, 0.45)
        scene.box(x, y, 0, (width, 0.45, 0.85), yaw, drawers, tone, back=False)
        _clutter(scene, rng, x, y, 0.85, width * 0.9, 0.3, yaw, int(rng.integers(2, 5)))
        _flat(
            scene,
            wall,
            mid,
            1.45,
            width * 0.8,
            rng.uniform(0.6, 0.9),
            [painting, poster, notes][rng.integers(3)],
        )
    elif kind == "posters":
        for z in (0.55, 1.45):
            _flat(scene, wall, mid + rng.uniform(-0.05, 0.05), z, width * rng.uniform(0.7, 0.95), 0.8, poster)
    elif kind == "door":
        _flat(scene, wall, mid, 0, 0.95, 2.05, door, 330)
        _flat(scene, wall, mid, 2.15, 0.6, 0.2, poster)
    elif kind == "window":
        _flat(scene, wall, mid, 1.0, width * 0.95, min(1.3, tall - 1.4), window)
        x, y, yaw = _on_wall(scene, wall, mid, 0.14)
        scene.box(
            x,
            y,
            0.12,
            (width * 0.8, 0.14, 0.6),
            yaw,
            partial(cells, size=(0.6, 0.07), colors=[(200, 205, 205)]),
            back=False,
        )
    elif kind == "board":
        _flat(scene, wall, mid, 0.95, width, 1.15, notes if rng.random() < 0.6 else chalk)
        x, y, yaw = _on_wall(scene, wall, mid, 0.4)
        scene.box(x, y, 0, (width * 0.8, 0.4, 0.45), yaw, cloth, cloth)
    elif kind == "painting":
        _flat(scene, wall, mid, rng.uniform(1.15, 1.35), width, width * rng.uniform(0.6, 0.9), painting)
        _flat(scene, wall, mid + rng.uniform(-0.2, 0.2), 0.6, 0.4, 0.3, poster)
    elif kind == "planter":
        x, y, yaw = _on_wall(scene, wall, mid, 0.5)
        brick = partial(cells, size=(0.08, 0.2), colors=[(60, 80, 150), (70, 95, 170)])
        scene.box(x, y, 0, (width, 0.5, 0.45), yaw, brick)
        scene.box(x, y, 0.45, (width * 0.9, 0.36, rng.uniform(0.3, 0.8)), yaw, leaves)
        _flat(scene, wall, mid, 1.5, width * 0.6, 0.8, poster)
    elif kind == "bench":
        x, y, yaw = _on_wall(scene, wall, mid, 0.45)
        scene.box(x, y, 0.38, (width, 0.45, 0.07), yaw, tone)
        for side in (-0.4, 0.4):
            scene.box(
                x + side * width * np.cos(yaw), y + side * width * np.sin(yaw), 0, (0.1, 0.4, 0.38), yaw, tone
            )
        _flat(scene, wall, mid - width * 0.22, 1.1, width * 0.4, 0.75, poster)
        _flat(scene, wall, mid + width * 0.24, 1.2, width * 0.4, 0.55, [painting, poster][rng.integers(2)])
    elif kind == "crates":
        x, y, yaw = _on_wall(scene, wall, mid, 0.7)
        scene.box(x, y, 0, (0.7, 0.5, 0.55), yaw + rng.uniform(-0.2, 0.2), crate)
        scene.box(x, y, 0.55, (0.5, 0.4, 0.42), yaw + rng.uniform(-0.4, 0.4), crate)
    else:
        x, y, yaw = _on_wall(scene, wall, mid, 0.4)
        stone = partial(
            cells, size=(0.3, 0.4), colors=[(150, 165, 175), (130, 150, 165)], joint=(90, 95, 100)
        )
        scene.box(x, y, 0, (0.4, 0.4, tall), yaw, stone)
        scene.box(x, y, 1.3, (0.42, 0.42, 0.5), yaw, poster)
    return width


BRICK = [(62, 84, 158), (70, 96, 172), (54, 70, 132), (84, 112, 182)]
SANDSTONE = [(150, 185, 205), (138, 172, 195), (162, 196, 214), (120, 155, 180)]
MOSAIC = [(110, 140, 155), (95, 120, 140), (120, 130, 125), (80, 95, 130)]
OAK = [(75, 120, 165), (62, 104, 150), (85, 135, 180)]
SLATE = [(95, 95, 90), (110, 108, 100), (85, 88, 90), (125, 120, 112)]
CHECK = [(205, 215, 220), (60, 65, 85), (190, 205, 215)]

# wall (None: plaster) and floor are cells: height, width, colors, stagger; things stand at the walls
KINDS: dict[str, dict[str, Any]] = {
    "library": {
        "wall": None, "floor": (0.14, 1.1, OAK, "random"),
        "things": ["shelf", "shelf", "shelf", "cabinet", "window", "painting", "posters"],
    },
    "courtyard": {
        "wall": (0.075, 0.24, BRICK, "half"), "floor": (0.32, 0.48, SLATE, "half"), "outdoor": True,
        "things": ["planter", "bench", "crates", "posters", "door", "posters", "bench"],
    },
    "gallery": {
        "wall": None, "floor": (0.3, 0.3, CHECK, "none"),
        "things": ["painting", "bench", "painting", "posters", "pillar", "cabinet", "door"],
    },
    "workshop": {
        "wall": (0.2, 0.42, SANDSTONE, "half"), "floor": (0.5, 0.5, SLATE, "none"),
        "things": ["board", "crates", "shelf", "cabinet", "window", "pillar", "board", "posters"],
    },
}  # fmt: skip


def build_room(seed: int, index: int) -> Scene:
    """Return room `index` of the world of `seed`: geometry and materials; `paint` makes its textures."""
    rng = _random(seed, index, "room")
    kinds = list(KINDS)
    name = kinds[(index + seed) % len(kinds)]
    kind = KINDS[name]
    outdoor = bool(kind.get("outdoor"))
    w, d, h = rng.uniform([7.4, 6.0, 3.0], [8.8, 7.0, 3.4])
    if outdoor:
        w, d, h = w + 1.2, d + 1.2, 5.4
    origin = np.array([28.0 * index, 4.0 * (index % 3), 0.0])
    scene = Scene(origin, (w, d, h), outdoor)
    if kind["wall"] is None:
        paint = np.asarray(random_color(rng, (0.08, 0.3), (0.7, 0.88)))
        wall: Material = partial(plaster, color=paint, band=paint * rng.uniform(0.5, 0.75))
    else:
        ch, cw, colors, stagger = kind["wall"]
        wall = partial(cells, size=(ch, cw), colors=colors, stagger=stagger)
    for k in range(4):
        x, y, yaw = _on_wall(scene, k, 0.0, -0.008)
        normal = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        length = w if k % 2 == 0 else d
        right = np.cross(UP, normal)
        scene.plate(np.array([x, y, h]) - right * length / 2, right, -UP, length, h, wall, 256)
    ch, cw, colors, stagger = kind["floor"]
    floor = partial(
        cells, size=(ch, cw), colors=colors, stagger=stagger, jitter=0.15, motifs=stagger == "none"
    )
    scene.plate((-w / 2, d / 2, 0), (1, 0, 0), (0, -1, 0), w, d, floor, 256)
    if outdoor:
        scene.plate((-150, -150, 40), (1, 0, 0), (0, 1, 0), 300, 300, clouds, 4, lit=False)
        scene.lamps = [origin + np.array([9.0 + 2 * i, -14.0, 22.0]) for i in (-0.5, 0.5)]
    else:
        ceiling = partial(cells, size=(0.6, 0.6), colors=[(215, 222, 225)], stagger="none", jitter=0.03)
        scene.plate((-w / 2, -d / 2, h), (1, 0, 0), (0, 1, 0), w, d, ceiling, 160)
        beam = partial(wood, color=np.asarray((50, 80, 115)) * rng.uniform(0.7, 1.4))
        for x in np.linspace(-w / 2, w / 2, 5)[1:-1]:
            scene.box(x, 0, h - 0.24, (0.18, d, 0.24), 0, beam, ppm=160)
        for x in (-w / 4 * 1.5, 0.12 * w, w / 4 * 1.5):
            for y in (-d / 5, d / 5):
                scene.box(x, y, h - 0.04, (0.9, 0.25, 0.04), 0, lamp, lit=False, ppm=120)
                scene.lamps.append(origin + np.array([x, y, h - 0.08]))
    for k in range(4):
        length = w if k % 2 == 0 else d
        along = -length / 2 + 0.5
        for thing in list(rng.permutation(kind["things"])) * 3:
            width = _furnish(scene, rng, k, along, length / 2 - 0.45 - along, thing)
            along += width and width + rng.uniform(0.08, 0.3)
        if outdoor:  # the upper story
            for at in np.arange(-length / 2 + 0.9, length / 2 - 0.6, 1.7):
                _flat(scene, k, at, 3.1, 1.05, 1.5, window, 300)
                x, y, yaw = _on_wall(scene, k, at, 0.18)
                scene.box(x, y, 2.98, (1.25, 0.18, 0.1), yaw, partial(plaster, color=(150, 165, 175)))
    _middle(scene, rng)
    return scene


def _middle(scene: Scene, rng: Rng) -> None:
    """Furnish the corners, the middle and the air; the ring between them is left free for walking."""
    w, d, h = scene.size
    for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        x, y, yaw = sx * (w / 2 - 0.42), sy * (d / 2 - 0.42), rng.uniform(0, 6)
        kind = rng.integers(3)
        if kind == 0:
            scene.box(x, y, 0, (0.42, 0.42, 0.9), yaw, poster)
            scene.box(x, y, 0.9, (0.3, 0.3, 0.35), yaw + 0.5, books)
        elif kind == 1:
            scene.box(x, y, 0, (0.4, 0.4, 0.4), yaw, crate)
            scene.box(x, y, 0.4, (0.36, 0.36, 0.8), yaw + 0.3, leaves)
        else:
            scene.box(x, y, 0, (0.5, 0.45, 0.5), yaw, crate)
            scene.box(x, y, 0.5, (0.4, 0.35, 0.4), yaw + 0.4, drawers)
    yaw, tone = rng.uniform(-0.4, 0.4), partial(wood, color=np.asarray(OAK[0]) * rng.uniform(0.6, 1.2))
    c, s = np.cos(yaw), np.sin(yaw)
    if not scene.outdoor and rng.random() < 0.7:  # a table
        scene.box(0, 0, 0.68, (1.3, 0.8, 0.05), yaw, tone, top=cloth if rng.random() < 0.5 else tone)
        for lx, ly in ((0.58, 0.34), (0.58, -0.34), (-0.58, 0.34), (-0.58, -0.34)):
            scene.box(lx * c - ly * s, lx * s + ly * c, 0, (0.07, 0.07, 0.68), yaw, tone)
        _clutter(scene, rng, 0, 0, 0.73, 1.1, 0.5, yaw, 4)
    else:  # a plinth
        scene.box(0, 0, 0, (0.8, 0.8, 0.45), yaw, poster, top=tone)
        scene.box(0, 0, 0.45, (0.45, 0.45, 0.4), yaw + 0.5, crate)
        scene.box(0, 0, 0.85, (0.25, 0.25, 0.45), yaw + 0.9, leaves if scene.outdoor else books)
    mosaic = partial(cells, size=(0.24, 0.24), colors=MOSAIC, stagger="none", motifs=True)
    rug = 0.3 * w * np.array([c, s, 0]), 0.3 * d * np.array([-s, c, 0])
    scene.plate(
        -rug[0] + rug[1] + [0, 0, 0.012],
        (c, s, 0),
        (s, -c, 0),
        0.6 * w,
        0.6 * d,
        mosaic if scene.outdoor else cloth,
        220,
    )
    for i in range(0 if scene.outdoor else 3):  # things that hang
        angle = yaw + i * 2.1
        x, y, z = 0.24 * w * np.cos(angle), 0.24 * d * np.sin(angle), min(h, 3.4) - rng.uniform(0.7, 0.9)
        scene.box(x, y, z, (0.45, 0.45, 0.3), angle, [cloth, poster, painting][i], ppm=300)
        scene.box(x, y, z + 0.3, (0.02, 0.02, h - z - 0.3), angle, lamp, lit=False)


# ------------------------------------------------------------------------------------------ light and paint


def _blocked(scene: Scene, start: Image, way: Image) -> NDArray[np.bool_]:
    """Tell which segments start + t * way, t in (0, 1), (N, 3) each, are cut by a box (slab test)."""
    hit = np.zeros(len(start), bool)
    ends = np.concatenate([start, start + way])
    low, high = ends.min(0), ends.max(0)
    for center, half, yaw in scene.blockers:
        reach = np.array([*[np.hypot(half[0], half[1])] * 2, half[2]])
        if (center + reach < low).any() or (center - reach > high).any():
            continue
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
    """Return the light on a rectangle, a small float32 picture: lamps with shadows and ambient occlusion."""
    rows, columns = max(2, round(quad.height / 0.15)), max(2, round(quad.width / 0.15))
    t, s = np.mgrid[0:rows, 0:columns] + 0.5
    points = quad.corner + (s.ravel() * quad.width / columns)[:, None] * quad.right
    points = (points + (t.ravel() * quad.height / rows)[:, None] * quad.down + 0.02 * quad.normal).astype(
        np.float32
    )
    # Directions spread evenly over the hemisphere, denser along the normal as Lambert's law has it.
    i = np.arange(14) + 0.5
    radius, angle = np.sqrt(i / 14), i * 2.399963
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - i / 14)], -1)
    ways = (1.3 * local @ np.stack([quad.right, quad.down, quad.normal])).astype(np.float32)
    w, d, h = scene.size
    low = scene.origin - np.array([w / 2, d / 2, 0])
    high = scene.origin + np.array([w / 2, d / 2, 99 if scene.outdoor else h])
    starts, ways = np.repeat(points, len(ways), 0), np.tile(ways, (len(points), 1))
    ends = starts + ways
    closed = ((ends < low) | (ends > high)).any(1) | _blocked(scene, starts, ways)
    lit = (0.62 if scene.outdoor else 0.58) * (1 - 0.65 * closed.reshape(len(points), -1).mean(1))
    offsets = np.array([[0, 0], [0.35, 0.1], [-0.35, -0.1]], np.float32) * (1.0 if not scene.outdoor else 1.5)
    for lamp_at in scene.lamps:
        for dx, dy in offsets:
            way = (lamp_at + np.array([dx, dy, 0]) - points).astype(np.float32)
            distance = np.linalg.norm(way, axis=1)
            cosine = np.clip(way @ quad.normal.astype(np.float32) / distance, 0, 1)
            if not cosine.any():
                continue
            fall = (
                0.85 / len(scene.lamps) if scene.outdoor else 1.5 / len(scene.lamps) * 6 / (distance**2 + 3.0)
            )
            lit = lit + fall * cosine / len(offsets) * ~_blocked(scene, points, way)
    return cv2.GaussianBlur(lit.reshape(rows, columns).astype(np.float32), (3, 3), 0)


def paint(scene: Scene, seed: int, index: int, number: int, look_alikes: bool = False) -> None:
    """Make the texture of one rectangle and its mip-maps, light baked in."""
    quad = scene.quads[number]
    multiple = 2 ** (LEVELS - 1)
    h, w = (max(multiple, round(side * quad.ppm / multiple) * multiple) for side in (quad.height, quad.width))
    rng = _random(seed, index, "quad", number)
    name = getattr(quad.material, "func", quad.material).__name__
    if look_alikes and name in SOLD_OFTEN:
        # A model is drawn for whole meters: things of unequal width then begin alike.
        tall, wide = (round(np.ceil(side) * quad.ppm) + multiple for side in (quad.height, quad.width))
        model = _random(seed, "model", name, int(rng.integers(MODELS)))
        image = quad.material(model, tall, wide, quad.ppm)[:h, :w]
    else:
        image = quad.material(rng, h, w, quad.ppm)
    if quad.lit:
        light = cv2.resize(_light(scene, quad), (w, h), interpolation=cv2.INTER_LINEAR)
        image = cv2.multiply(image, cv2.merge([light] * 3), dtype=cv2.CV_8U)
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    for pyramid, level in ((quad.color, image), (quad.gray, gray)):
        pyramid.append(level)
        for _ in range(LEVELS - 1):
            level = cv2.resize(
                level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA
            )
            pyramid.append(level)


# ---------------------------------------------------------------------------------------------- rendering


@dataclass
class Rays:
    """The rays of a camera's samples: x / z and y / z, each (SAMPLES * H, SAMPLES * W) float32."""

    camera: "pycolmap.Camera"
    x: Image
    y: Image
    planes: Array  # (5, 4) the view's borders in the camera frame; inside is positive

    @classmethod
    def of(cls, camera: "pycolmap.Camera") -> "Rays":
        """Unproject the sample grid; the center of the top-left pixel is (0.5, 0.5)."""
        u, v = ((np.arange(SAMPLES * n) + 0.5) / SAMPLES for n in (camera.width, camera.height))
        pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
        shape = (SAMPLES * camera.height, SAMPLES * camera.width)
        x, y = np.asarray(camera.cam_from_img(pixels)).T.astype(np.float32).reshape(2, *shape)
        planes = np.array([
            [0, 0, 1, -NEAR_M], [1, 0, -x.min(), 0], [-1, 0, x.max(), 0],
            [0, 1, -y.min(), 0], [0, -1, y.max(), 0],
        ])  # fmt: skip
        return cls(camera, np.ascontiguousarray(x), np.ascontiguousarray(y), planes)


def _visible_area(polygon: Array, rays: Rays) -> tuple[slice, slice] | None:
    """Return the rows and columns of samples that may see a polygon (N, 3), camera frame; None if none."""
    for plane in rays.planes:
        side = polygon @ plane[:3] + plane[3]
        if (side >= 0).all():
            continue
        kept: list[Array] = []
        for i in range(len(polygon)):
            a, b, sa, sb = polygon[i - 1], polygon[i], side[i - 1], side[i]
            if (sa >= 0) != (sb >= 0):
                kept.append(a + (b - a) * sa / (sa - sb))
            if sb >= 0:
                kept.append(b)
        if not kept:
            return None
        polygon = np.array(kept)
    # Distortion bends the edges: follow them, not only the corners.
    steps = np.linspace(0, 1, 6)[:, None, None]
    outline = (polygon + steps * (np.roll(polygon, -1, 0) - polygon)).reshape(-1, 3)
    pixels = np.asarray(rays.camera.img_from_cam(outline))
    low, high = np.floor(pixels.min(0) - 2), np.ceil(pixels.max(0) + 2)
    limits = np.array([rays.camera.width, rays.camera.height])
    (c0, r0), (c1, r1) = ((np.clip(p, 0, limits) * SAMPLES).astype(int) for p in (low, high))
    return (slice(r0, r1), slice(c0, c1)) if r1 > r0 and c1 > c0 else None


def _texture(level: Image, x: Image, y: Image) -> Image:
    """Read texels at N places, continuous coordinates (the first texel's center is 0.5)."""
    width = 4096  # OpenCV bounds the side of a map
    rows = -(-len(x) // width)
    maps = np.zeros((2, rows * width), np.float32)
    maps[0, : len(x)], maps[1, : len(x)] = x, y
    maps -= 0.5
    read = cv2.remap(level, maps[0].reshape(rows, width), maps[1].reshape(rows, width), cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return read.reshape(rows * width, -1)[: len(x)]


def render(quads: list[Quad], world_from_cam: Array, rays: Rays, gray: bool) -> tuple[Image, Image]:
    """Return a picture, (H, W, 3) BGR or (H, W), float32 0..255, and its depth, (H, W) float32 meters.

    Depth is along the optical axis at pixel centers; 0 on the sky and where a pixel straddles an edge.
    """
    height, width = rays.x.shape
    R, center = world_from_cam[:3, :3].T, world_from_cam[:3, 3]
    nearest = np.zeros((height, width), np.float32)  # inverse depth
    owner = np.full((height, width), -1, np.int16)
    seen: dict[int, tuple[tuple[slice, slice], NDArray[np.float32], float]] = {}
    corners = np.stack([quad.corners for quad in quads])
    normals = np.stack([quad.normal for quad in quads])
    distances = np.einsum("qi,qi->q", normals, center - corners[:, 0])
    corners = (corners - center) @ R.T
    beyond: Any = corners @ rays.planes[:, :3].T + rays.planes[:, 3] < 0
    outside = beyond.all(axis=1).any(axis=1)
    for k in np.flatnonzero((distances > 1e-6) & ~outside).tolist():
        quad, distance = quads[k], float(distances[k])
        area = _visible_area(corners[k], rays)
        if area is None:
            continue
        # With r = (x, y, 1) the ray, 1 / z = n.r / n.p, and texture coordinates times 1 / z are linear in r.
        p = R @ (quad.corner - center)
        inverse = R @ quad.normal / -distance
        right, down = (R @ axis - (R @ axis @ p) * inverse for axis in (quad.right, quad.down))
        linear = np.stack([inverse, right, down]).astype(np.float32)
        x, y = rays.x[area], rays.y[area]
        q, s, t = (a * x + (b * y + c) for a, b, c in linear)
        inside = (q > nearest[area]) & (s >= 0) & (t >= 0) & (s <= quad.width * q) & (t <= quad.height * q)
        if inside.any():
            np.copyto(nearest[area], q, where=inside)
            np.copyto(owner[area], np.int16(k), where=inside)
            seen[k] = area, linear, distance
    picture = np.zeros((height * width, 1 if gray else 3), np.uint8)
    focal = SAMPLES * (rays.camera.focal_length_x * rays.camera.focal_length_y) ** 0.5
    for k, (area, linear, distance) in seen.items():
        quad = quads[k]
        rows, columns = np.nonzero(owner[area] == k)
        if not len(rows):
            continue
        rows, columns = rows + area[0].start, columns + area[1].start
        index = rows * width + columns
        x, y = rays.x.ravel()[index], rays.y.ravel()[index]
        z = 1 / nearest.ravel()[index]
        s, t = ((a * x + (b * y + c)) * z for a, b, c in linear[1:])
        pyramid = quad.gray if gray else quad.color
        th, tw = pyramid[0].shape[:2]
        # The sample's footprint has the area z^3 / (f^2 * distance). The four samples of a pixel round its
        # level at four offsets, which blends the levels; the quarter keeps slanted surfaces from flickering.
        scale = tw / quad.width / focal / np.sqrt(distance)
        level = np.log2(scale * z**1.5) + 0.25 * np.log2(np.maximum(z / distance, 1))
        level += 0.25 * ((rows % 2) * 2 + (columns % 2)) - 0.125
        level = np.clip(level.astype(np.int8), 0, LEVELS - 1)
        for at in np.unique(level):
            chosen = level == at
            lx, ly = tw / quad.width / 2.0**at, th / quad.height / 2.0**at
            picture[index[chosen]] = _texture(
                pyramid[at], s[chosen] * np.float32(lx), t[chosen] * np.float32(ly)
            )
    size = (width // SAMPLES, height // SAMPLES)
    smooth = cv2.resize(
        picture.reshape(height, width, -1).astype(np.float32), size, interpolation=cv2.INTER_AREA
    )
    return smooth, _depth(quads, owner, nearest)


def _depth(quads: list[Quad], owner: Image, nearest: Image) -> Image:
    """Return depth at pixel centers (H, W): from the mean inverse depth of the samples, exact on a plane."""
    low = high = total = nearest[::SAMPLES, ::SAMPLES]
    for i in range(1, SAMPLES**2):
        sample = nearest[i // SAMPLES :: SAMPLES, i % SAMPLES :: SAMPLES]
        low, high, total = np.minimum(low, sample), np.maximum(high, sample), total + sample
    mean = total / SAMPLES**2
    depth = np.where(low > 0.97 * high, 1 / np.maximum(mean, 1e-6), 0).astype(np.float32)
    sky = np.array([not quad.lit and quad.ppm < 10 for quad in quads] + [True])
    depth[sky[owner[::SAMPLES, ::SAMPLES]]] = 0
    return depth


# ------------------------------------------------------------------------------------------ devices and walks


@dataclass(frozen=True)
class Sensor:
    """One camera of a device: its place and turn in the body frame (x forward, y left, z up)."""

    name: str
    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def body_from_cam(self) -> Array:
        """The camera's pose (4, 4) in the body frame."""
        return make_pose(_looking(self.yaw_deg, self.pitch_deg, self.roll_deg), self.at)


@dataclass(frozen=True)
class Device:
    """How one kind of device sees the world; `rig_from_body` is None where the camera is the device."""

    sensors: tuple[Sensor, ...]
    height_m: float
    sway_deg: float  # of the hand or the gait
    gray: bool
    brightness: float  # the mean that its exposure aims at
    gamma: float
    tint: tuple[float, float, float]  # BGR
    vignette: float
    noise: float
    quality: int  # JPEG
    rig_from_body: tuple[float, ...] | None = None  # qw qx qy qz tx ty tz


DEVICES = {
    "ios": Device(
        (Sensor("cam_phone", "PINHOLE", (960, 720), (735.0, 735.0, 481.8, 357.9)),),
        1.5, 4.0, False, 122.0, 0.95, (0.92, 1.0, 1.06), 0.12, 2.0, 93,
    ),
    "hl": Device(
        (
            Sensor("hetlf", "SIMPLE_RADIAL", (480, 640), (402.0, 243.1, 316.4, -0.021),
                   (0.02, 0.052, 0.0), 12.0),
            Sensor("hetrf", "SIMPLE_RADIAL", (480, 640), (405.0, 237.4, 322.9, -0.018),
                   (0.02, -0.05, 0.004), -12.0, 0.0, 90.0),
        ),
        1.65, 5.0, True, 98.0, 1.12, (1.0, 1.0, 1.0), 0.25, 3.5, 91,
        (0.36, 0.55, -0.42, 0.63, 0.08, -0.22, 0.31),
    ),
    "spot": Device(
        (
            Sensor("frontleft", "OPENCV", (640, 480),
                   (432.0, 430.0, 318.7, 242.2, -0.062, 0.011, 0.0004, -0.0003),
                   (0.38, 0.07, 0.0), -9.0, 2.0),
            Sensor("frontright", "OPENCV", (640, 480),
                   (428.0, 427.0, 322.6, 237.3, -0.058, 0.009, -0.0002, 0.0004),
                   (0.38, -0.07, 0.0), 9.0, 2.0),
            Sensor("left", "OPENCV", (640, 480),
                   (436.0, 434.0, 315.9, 239.7, -0.065, 0.012, 0.0001, 0.0002),
                   (0.16, 0.15, 0.02), 78.0, 4.0),
        ),
        0.7, 1.5, True, 126.0, 0.86, (1.0, 1.0, 1.0), 0.2, 3.0, 90,
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ),
}  # fmt: skip


def _looking(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Return a camera's rotation (3, 3) in a frame with z up: yaw left of x, pitch up, roll clockwise."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=-1)


BODY_FROM_LEVEL_CAM = make_pose(_looking(0, 0, 0), (0, 0, 0))


def _walk(rng: Rng, scene: Scene, device: Device, radius: float, angles: Array) -> Array:
    """Return poses world_from_body (N, 4, 4) along an ellipse around the room's middle, looking across it.

    `angles` (N,) are the directions of the look, radians; `radius` is a share of the room's sides. The wobble
    is a sum of slow waves, so the walk is smooth however many frames it has.
    """

    def wave(amplitude: float) -> Array:
        a, b = rng.uniform(0, 2 * np.pi, 2)
        return amplitude * (0.6 * np.sin(1.7 * angles + a) + 0.4 * np.sin(4.1 * angles + b))

    w, d, _ = scene.size
    across = np.stack([w * np.cos(angles), d * np.sin(angles)], -1)
    x, y = (scene.origin[:2] - (radius + wave(0.008)[:, None]) * across).T
    z = device.height_m + wave(0.05 * device.sway_deg / 4)
    yaw = np.degrees(np.arctan2(across[:, 1], across[:, 0])) + wave(7)
    pitch, roll = -3 + wave(device.sway_deg), wave(device.sway_deg)
    rotations = np.stack([_looking(*turn) for turn in zip(yaw, pitch, roll, strict=True)])
    return make_pose(rotations, np.stack([x, y, z], -1)) @ invert(BODY_FROM_LEVEL_CAM)


def _turn(poses: Array, degrees: Array) -> Array:
    """Turn poses world_from_body about the world's vertical through their own place."""
    a = np.radians(degrees)
    spin = np.zeros((len(poses), 3, 3))
    spin[:, 0, 0] = spin[:, 1, 1] = np.cos(a)
    spin[:, 1, 0] = np.sin(a)
    spin[:, 0, 1] = -spin[:, 1, 0]
    spin[:, 2, 2] = 1
    return make_pose(spin @ poses[:, :3, :3], poses[:, :3, 3])


def walks(scene: Scene, seed: int, index: int, frames: int, name: str) -> dict[tuple[str, int], Array]:
    """Return the poses world_from_body of one device in one room, by split and subsession.

    The two map walks follow an outer and an inner ring, the queries the ring between them, turned 10 to 25
    degrees away from the nearest map pose. From frame to frame the look turns 15 degrees at most, so that
    neighbors overlap however few there are.
    """
    device, rng = DEVICES[name], _random(seed, index, "walk", name)
    start = _random(seed, index, "start").uniform(0, 2 * np.pi)
    span = np.radians(min(360, 15 * frames))
    poses: dict[tuple[str, int], Array] = {}
    for split, total in (("map", frames), ("query", max(2, frames // 2))):
        phase = rng.uniform(0, 0.3)
        for part, count in enumerate((total - total // 2, total // 2)):
            share = (np.arange(count) + 0.5 * part + phase) / count
            margin = 0.0 if split == "map" else 0.1  # queries stay where the map has looked
            angles = start + span * (margin + (1 - 2 * margin) * share)
            radius = (0.32, 0.17)[part] if split == "map" else (0.235, 0.255)[part]
            poses[split, part] = _walk(rng, scene, device, radius, angles)
    mapped = np.concatenate([poses["map", 0], poses["map", 1]])
    for part in range(2):
        query = poses["query", part]
        nearest = np.argmin(np.linalg.norm(query[:, None, :3, 3] - mapped[None, :, :3, 3], axis=-1), axis=1)
        best, cost = np.zeros(len(query)), np.full(len(query), np.inf)
        for turn in np.arange(-30.0, 31.0, 1.0):
            turned = _turn(query, np.full(len(query), turn))
            angle = rotation_angle_deg(invert(mapped[nearest])[:, :3, :3] @ turned[:, :3, :3])
            # The least turn that is far enough, to the left on one walk and to the right on the other.
            price = abs(turn) + 100 * ((angle < 11) | (angle > 24)) + 8 * ((turn > 0) == bool(part))
            best, cost = np.where(price < cost, turn, best), np.minimum(price, cost)
        poses["query", part] = _turn(query, best)
    return poses


# ---------------------------------------------------------------------------------------------- the capture


@dataclass
class Shot:
    """One picture to take."""

    session: str
    timestamp: int
    sensor_id: str
    path: str  # below raw_data/
    depth_path: str | None
    camera: "pycolmap.Camera"
    world_from_cam: Array
    device: Device


@dataclass
class Tables:
    """The rows of a session's files, as they are collected."""

    sensors: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    rigs: list[tuple[int, str, str, Array]] = field(default_factory=list)
    poses: list[tuple[int, str, Array]] = field(default_factory=list)
    images: list[tuple[int, str, str]] = field(default_factory=list)
    depths: list[tuple[int, str, str]] = field(default_factory=list)
    subsessions: list[str] = field(default_factory=list)


def _subsession(name: str, split: str, part: int, hours: int) -> tuple[str, int]:
    """Return a subsession's name and its first timestamp, microseconds, on the device's clock."""
    after_us = (
        (2 * part + (split == "query")) * hours * 3600 + {"ios": 0, "hl": 600, "spot": 1200}[name]
    ) * 10**6
    day = 1714557600 * 10**6 + after_us  # 2024-05-01 10:00 UTC
    stamp = time.gmtime(day // 10**6)
    if name == "ios":
        return time.strftime("ios_%Y-%m-%d_%H.%M.%S_000", stamp), 630_000_000_000 + after_us
    if name == "hl":
        return time.strftime("hl_%Y-%m-%d-%H-%M-%S-417", stamp), 93_000_000_000 + after_us
    return time.strftime("spot_%Y-%m-%d-%H-%M", stamp), day


def _plan_room(
    scene: Scene, seed: int, index: int, frames: int, hours: int, tables: dict[str, Tables]
) -> Iterator[Shot]:
    """Add one room's frames to the tables of all sessions, and yield its pictures."""
    import pycolmap

    for name, device in DEVICES.items():
        for (split, part), bodies in walks(scene, seed, index, frames, name).items():
            session, table = f"{name}_{split}", tables[f"{name}_{split}"]
            subsession, start = _subsession(name, split, part, hours)
            if subsession not in table.subsessions:
                table.subsessions.append(subsession)
            rng = _random(seed, index, "frames", name, split, part)
            for i, world_from_body in enumerate(bodies):
                timestamp = start + int(
                    1e6 * (5 + 1.4 * (index * (frames + 8) + i)) + rng.integers(0, 700_000)
                )
                zoom = float(np.round(rng.normal(1, 0.004), 5))
                device_id = {
                    "hl": f"{subsession}/hetrig_{timestamp}",
                    "spot": f"{subsession}/{timestamp}-body",
                }.get(name)
                if device.rig_from_body is not None:
                    rig_from_body = pose_from_qt(device.rig_from_body)
                    table.poses.append((timestamp, str(device_id), world_from_body @ invert(rig_from_body)))
                for sensor in device.sensors:
                    params, size, label = list(sensor.params), sensor.size, sensor.name
                    if name == "ios":  # a phone focuses anew for every picture
                        params[:2] = [round(f * zoom, 3) for f in params[:2]]
                        label, short = f"phone camera for timestamp {timestamp}", f"cam_phone_{timestamp}"
                        path = f"{subsession}/images/{timestamp}"
                    elif name == "hl":
                        short, path = label, f"{subsession}/images/{label}/{timestamp}"
                    else:
                        short = label = f"spot-camera-{label}-image"
                        path = f"{subsession}/{label}/{timestamp}-{label}"
                    sensor_id = f"{subsession}/{short}"
                    table.sensors[sensor_id] = (sensor_id, label, "camera", sensor.model, *size, *params)
                    camera = pycolmap.Camera(model=sensor.model, width=size[0], height=size[1], params=params)
                    world_from_cam = world_from_body @ sensor.body_from_cam
                    if device.rig_from_body is None:
                        table.poses.append((timestamp, sensor_id, world_from_cam))
                    else:
                        rig_from_cam = rig_from_body @ sensor.body_from_cam
                        table.rigs.append((timestamp, str(device_id), sensor_id, rig_from_cam))
                    table.images.append((timestamp, sensor_id, f"{path}.jpg"))
                    depth_path = None
                    if split == "map":
                        folder, _, stem = path.partition("/")
                        depth_path = f"{folder}/depths/{stem.removeprefix('images/')}.png"
                        table.depths.append((timestamp, sensor_id, depth_path))
                    yield Shot(
                        session,
                        timestamp,
                        sensor_id,
                        f"{path}.jpg",
                        depth_path,
                        camera,
                        world_from_cam,
                        device,
                    )


def _take(shot: Shot, scene: Scene, rays: Rays | None, sessions: Path, seed: int) -> None:
    """Render one picture as its device sees it, and its depth, into the session's raw_data."""
    device = shot.device
    picture, depth = render(scene.quads, shot.world_from_cam, rays or Rays.of(shot.camera), device.gray)
    h, w = depth.shape
    y, x = np.ogrid[0:h, 0:w]
    radius2 = ((x - w / 2) ** 2 + (y - h / 2) ** 2).astype(np.float32) / ((w / 2) ** 2 + (h / 2) ** 2)
    # Exposure follows the scene only half way, as it does in a device that must not flicker.
    gain = (device.brightness / max(float(picture.mean()), 20.0)) ** 0.7
    picture = np.clip(picture * (gain / 255), 0, None) ** device.gamma * 255
    picture *= (1 - device.vignette * radius2).reshape(h, w, *[1] * (picture.ndim - 2))
    if not device.gray:
        picture *= np.asarray(device.tint, np.float32)
    noise = _random(seed, "noise", shot.sensor_id, str(shot.timestamp)).standard_normal(
        picture.shape, np.float32
    )
    image = np.clip(picture + device.noise * noise + 0.5, 0, 255).astype(np.uint8)
    raw = sessions / shot.session / "raw_data"
    _save(raw / shot.path, image, [cv2.IMWRITE_JPEG_QUALITY, device.quality])
    if shot.depth_path is not None:
        millimeters = np.where(depth < 65.0, depth * 1000 + 0.5, 0).astype(np.uint16)
        _save(raw / shot.depth_path, millimeters, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _save(path: Path, image: Image, options: list[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, encoded = cv2.imencode(path.suffix, image, options)
    if not done:
        raise CaptureError(f"Cannot encode {path} from an array {image.shape} {image.dtype}.")
    path.write_bytes(encoded.tobytes())


def _write_session(path: Path, split: str, table: Tables) -> None:
    """Write the text files of a session, rows in order of time."""
    import pandas as pd

    from toolkit.capture import Trajectory, write_session

    poses = sorted(table.poses, key=lambda row: row[:2])
    times, ids = [row[0] for row in poses], [row[1] for row in poses]
    trajectory = Trajectory(times, ids, qt_from_pose(np.stack([row[2] for row in poses])))
    frames = pd.DataFrame({"timestamp": times, "device_id": ids})
    pruned = frames[np.arange(len(frames)) % 6 != 5]
    keyframes = {
        "original": frames,
        "pruned": pruned,
        "pruned_subsampled": pruned[np.arange(len(pruned)) % 3 != 1],
    }
    write_session(
        path,
        sensors=table.sensors.values(),
        rigs=[row[1:] for row in sorted(table.rigs, key=lambda row: row[:3])] or None,
        trajectory=trajectory if split == "map" else None,
        images=sorted(table.images),
        depths=sorted(table.depths) or None,
        subsessions=table.subsessions,
        keyframes=keyframes if split == "query" else None,
        ground_truth=trajectory if split == "query" else None,
    )


def render_capture(
    out: str | Path,
    rooms: int = 2,
    frames: int = 12,
    seed: int = 0,
    progress: bool = True,
    look_alikes: bool = False,
) -> Path:
    """Render a capture of `rooms` rooms by a phone, a headset and a robot; return its folder.

    Each device has a map and a query session of two subsessions; each subsession walks through all rooms. A
    folder that holds this very capture already is left as it is. Time grows with rooms * frames, memory not.

    Args:
        out: the capture's folder; its name is the scene's. Settings are kept in `demo.json` in it.
        rooms: how many rooms, at least 1.
        frames: frames (rig poses) a room and map session, at least 2; query sessions have half as many.
        seed: of everything; the same seed gives the same bytes.
        progress: whether to show a bar.
        look_alikes: whether doors, windows, shelves, cabinets and crates come in few models, the same in all rooms,
            which are easily taken for one another.

    Raises:
        CaptureError: a setting is out of range, or `out` holds something else than a rendered capture.
    """
    from tqdm.auto import tqdm

    out = Path(out)
    if rooms < 1 or frames < 2 or seed < 0:
        raise CaptureError(
            f"Expected rooms >= 1, frames >= 2, seed >= 0; found {rooms=}, {frames=}, {seed=}."
        )
    settings = {"format": FORMAT, "rooms": rooms, "frames": frames, "seed": seed}
    settings |= {"look_alikes": 1} if look_alikes else {}
    if _is_complete(out, settings):
        return out
    if out.exists() and any(out.iterdir()) and not (out / "demo.json").exists():
        raise CaptureError(
            f"{out} is not empty and holds no demo.json, so it was not rendered here: choose another folder."
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    # A killed rendering leaves only a hidden folder beside OUT, which the next rendering clears away.
    for stale in out.parent.glob(f".{out.name}.rendering-*"):
        if time.time() - stale.stat().st_mtime > 3600:
            shutil.rmtree(stale, ignore_errors=True)
    partial_out = Path(tempfile.mkdtemp(prefix=f".{out.name}.rendering-", dir=out.parent))
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)  # the pool below has a thread a core
        sessions = partial_out / "sessions"
        tables = {f"{name}_{split}": Tables() for name in DEVICES for split in ("map", "query")}
        hours = 1 + int(1.4 * rooms * (frames + 8) / 3600)
        pictures = rooms * sum(len(d.sensors) for d in DEVICES.values()) * (frames + max(2, frames // 2))
        bar = tqdm(total=pictures, desc="render", unit="image", disable=not progress)
        rays: dict[tuple[float, ...], Rays] = {}
        with ThreadPoolExecutor(min(_cores(), 8)) as pool:  # a thread may hold 150 MB
            try:
                for index in range(rooms):
                    scene = build_room(seed, index)
                    painting_one = partial(paint, scene, seed, index, look_alikes=look_alikes)
                    for _ in pool.map(painting_one, range(len(scene.quads))):
                        pass
                    waiting = []
                    for shot in _plan_room(scene, seed, index, frames, hours, tables):
                        key = tuple(shot.camera.params)
                        if shot.device.rig_from_body is not None and key not in rays:
                            rays[key] = Rays.of(shot.camera)
                        waiting.append(pool.submit(_take, shot, scene, rays.get(key), sessions, seed))
                    for work in waiting:
                        work.result()
                        bar.update()
                    os.utime(partial_out)  # still at work: no other process may take it for a leftover
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        bar.close()
        for session, table in tables.items():
            _write_session(sessions / session, session.rpartition("_")[2], table)
        count = sum(1 for path in partial_out.rglob("*") if path.is_file())
        (partial_out / "demo.json").write_text(json.dumps({**settings, "files": count}, indent=1) + "\n")
        partial_out.chmod(0o755)
        if out.exists():
            if _is_complete(out, settings):  # another process was faster
                return out
            shutil.rmtree(out)
        partial_out.replace(out)
    finally:
        cv2.setNumThreads(threads)
        shutil.rmtree(partial_out, ignore_errors=True)
    return out


def _cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_complete(out: Path, settings: dict[str, int]) -> bool:
    """Tell whether `out` holds the capture of these settings with all its files."""
    try:
        found = json.loads((out / "demo.json").read_text())
    except (OSError, ValueError):
        return False
    count = sum(1 for path in out.rglob("*") if path.is_file()) - 1
    return bool(found == {**settings, "files": count})
