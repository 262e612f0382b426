"""The rooms of the rendered capture: textured rectangles, rendered to an image with exact depth.

Each pixel has four samples. The ray of each sample, from the camera model with its distortion, is intersected with the
rectangles; the nearest one gives the color, read from its texture at the mip level of the sample's footprint.

Each random generator is seeded by the seed and the name of the thing it draws, not by the order of work.
"""

import math
import zlib
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import Floats
from toolkit.synthetic import textures as tex
from toolkit.synthetic.textures import Image, Material, Rng

if TYPE_CHECKING:
    import pycolmap

UP = np.array([0.0, 0.0, 1.0])
TO_LIGHT = np.array([0.08, -0.15, 0.15])  # the brightness of a rectangle is 0.85 + normal @ TO_LIGHT
Place = tuple[float, float, float]  # position and heading of a box in its room: x, y (meters), yaw (radians)
BRICK = [(62, 84, 158), (70, 96, 172), (54, 70, 132), (84, 112, 182)]
SANDSTONE = [(150, 185, 205), (138, 172, 195), (162, 196, 214), (120, 155, 180)]
MOSAIC = [(110, 140, 155), (95, 120, 140), (120, 130, 125), (80, 95, 130)]
OAK = [(75, 120, 165), (62, 104, 150), (85, 135, 180)]
SLATE = [(95, 95, 90), (110, 108, 100), (85, 88, 90), (125, 120, 112)]
CHECK = [(205, 215, 220), (60, 65, 85), (190, 205, 215)]
# Walls (None: plaster) and floors are `tex.cells` with height, width (meters), colors, stagger; things stand at walls.
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
LEVELS = 6  # mip levels; texture sides are multiples of 2 ** (LEVELS - 1)
NEAR_M = 0.05  # nothing nearer is drawn
SAMPLES = 2  # per pixel and axis
OFFSETS = np.array([[-0.125, 0.125], [0.375, 0.625]], np.float32)  # added to the mip level of each sample of a pixel


def named_rng(*key: int | str) -> Rng:
    """Return a random generator that depends on `key` only."""
    return np.random.default_rng([k if isinstance(k, int) else zlib.crc32(k.encode()) for k in key])


# Rooms


@dataclass
class Quad:
    """A textured rectangle, given by the top-left corner of its texture and the texture's unit axes in the world frame.

    Lengths are in meters; `ppm` is the texture's resolution, pixels per meter.
    """

    corner: Floats
    right: Floats
    down: Floats
    width: float
    height: float
    material: Material
    ppm: float
    color: list[Image] = field(default_factory=list)  # mip levels, BGR; [0] is the finest
    gray: list[Image] = field(default_factory=list)

    @cached_property
    def normal(self) -> Floats:
        """The unit normal on the visible side."""
        return np.cross(self.down, self.right)

    @cached_property
    def corners(self) -> Floats:
        """The four corners (4, 3), clockwise from the texture's top left."""
        w, h = self.width, self.height
        return self.corner + np.array([[0, 0], [w, 0], [w, h], [0, h]]) @ np.stack([self.right, self.down])


@dataclass
class Scene:
    """The rectangles of one room."""

    origin: Floats
    size: tuple[float, float, float]
    outdoor: bool
    quads: list[Quad] = field(default_factory=list)

    def plate(
        self, corner: Any, right: Any, down: Any, width: float, height: float, material: Material, ppm: float = 300.0
    ) -> None:
        """Add one rectangle; `corner` is relative to the room's origin."""
        axes = np.asarray(right, float), np.asarray(down, float)
        self.quads.append(Quad(self.origin + np.asarray(corner, float), *axes, width, height, material, ppm))

    def box(
        self, place: Place, z: float, size: tuple[float, float, float], front: Material,
        side: Material | None = None, top: Material | None = None, ppm: float = 350.0, back: bool = True,
    ) -> None:  # fmt: skip
        """Add a box of `size` (width, depth, height) with its base at height z; its front faces +y rotated by yaw."""
        x, y, yaw = place
        half = np.array(size) / 2
        center = np.array([x, y, z + half[2]])
        axis_x, axis_y = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        sides = [(axis_y, half[1], half[0], front)]
        if back:  # the back side is visible
            sides.append((-axis_y, half[1], half[0], side or front))
        sides += [(normal, half[0], half[1], side or front) for normal in (axis_x, -axis_x)]
        for normal, reach, half_width, material in sides:
            right = np.cross(UP, normal)
            corner = center + normal * reach - right * half_width + UP * half[2]
            self.plate(corner, right, -UP, 2 * half_width, size[2], material, ppm)
        # Top, and the underside if it is visible.
        for sign in (1, -1) if z > 0.1 else (1,):
            corner = center - axis_x * half[0] + sign * (axis_y * half[1] + UP * half[2])
            self.plate(corner, axis_x, -sign * axis_y, size[0], size[1], top or side or front, ppm)

    def at_wall(self, wall: int, along: float, depth: float) -> Place:
        """Return the place of a box of this depth against a wall, `along` meters from the middle of the wall."""
        w, d, _ = self.size
        gap = depth / 2 + 0.004
        places: list[Place] = [
            (along, d / 2 - gap, np.pi), (w / 2 - gap, -along, np.pi / 2),
            (-along, -d / 2 + gap, 0.0), (-w / 2 + gap, along, -np.pi / 2),
        ]  # fmt: skip
        return places[wall]

    def hang(
        self, wall: int, along: float, z: float, w: float, h: float, material: Material, ppm: float = 420.0
    ) -> None:
        """Hang a thin board on a wall."""
        self.box(self.at_wall(wall, along, 0.03), z, (w, 0.03, h), material, tex.plain, ppm=ppm, back=False)


def _clutter(scene: Scene, rng: Rng, place: Place, z: float, wide: float, deep: float, count: int) -> None:
    """Put small boxes side by side on a surface."""
    x, y, yaw = place
    c, s = np.cos(yaw), np.sin(yaw)
    for i in range(count):
        size = rng.uniform([0.1, 0.1, 0.08], [0.26, 0.24, 0.34])
        along, across = (i + 0.5) / count * wide - wide / 2, rng.uniform(-0.2, 0.2) * deep
        material = [tex.poster, tex.crate, tex.books, tex.cloth][int(rng.integers(4))]
        box_place = x + along * c - across * s, y + along * s + across * c, yaw + rng.uniform(-0.5, 0.5)
        scene.box(box_place, z, tuple(size), material, material, tex.poster, 450)


def _furnish(scene: Scene, rng: Rng, wall: int, along: float, room: float, kind: str) -> float:
    """Put a thing against a wall from `along` on; return its width, or 0 if it is wider than `room` (all in meters)."""
    tall = scene.size[2]
    width = {
        "shelf": rng.uniform(0.9, 1.6), "cabinet": rng.uniform(0.8, 1.4), "posters": rng.uniform(0.6, 0.9),
        "door": 1.0, "window": rng.uniform(1.1, 1.5), "board": rng.uniform(1.2, 1.8), "crates": 1.1, "pillar": 0.4,
        "painting": rng.uniform(0.9, 1.5), "planter": rng.uniform(0.9, 1.5), "bench": rng.uniform(1.3, 1.8),
    }[kind]  # fmt: skip
    if width > room:
        return 0.0
    mid = along + width / 2
    tone = partial(tex.wood, color=np.asarray((60, 100, 145)) * rng.uniform(0.5, 1.5))
    hang, at = partial(scene.hang, wall), partial(scene.at_wall, wall, mid)
    if kind == "shelf":
        scene.box(at(0.34), 0, (width, 0.34, rng.uniform(1.75, 2.3)), tex.books, tone, back=False)
    elif kind == "cabinet":
        scene.box(at(0.45), 0, (width, 0.45, 0.85), tex.drawers, tone, back=False)
        _clutter(scene, rng, at(0.45), 0.85, width * 0.9, 0.3, int(rng.integers(2, 5)))
        hang(mid, 1.45, width * 0.8, rng.uniform(0.6, 0.9), [tex.painting, tex.poster, tex.notes][rng.integers(3)])
    elif kind == "posters":
        for z in (0.55, 1.45):
            hang(mid + rng.uniform(-0.05, 0.05), z, width * rng.uniform(0.7, 0.95), 0.8, tex.poster)
    elif kind == "door":
        hang(mid, 0, 0.95, 2.05, tex.door, 330)
        hang(mid, 2.15, 0.6, 0.2, tex.poster)
    elif kind == "window":
        hang(mid, 1.0, width * 0.95, min(1.3, tall - 1.4), tex.window)
        radiator = partial(tex.cells, size=(0.6, 0.07), colors=[(200, 205, 205)])
        scene.box(at(0.14), 0.12, (width * 0.8, 0.14, 0.6), radiator, back=False)
    elif kind == "board":
        hang(mid, 0.95, width, 1.15, tex.notes if rng.random() < 0.6 else tex.chalk)
        scene.box(at(0.4), 0, (width * 0.8, 0.4, 0.45), tex.cloth, tex.cloth)
    elif kind == "painting":
        hang(mid, rng.uniform(1.15, 1.35), width, width * rng.uniform(0.6, 0.9), tex.painting)
        hang(mid + rng.uniform(-0.2, 0.2), 0.6, 0.4, 0.3, tex.poster)
    elif kind == "planter":
        brick = partial(tex.cells, size=(0.08, 0.2), colors=[(60, 80, 150), (70, 95, 170)])
        scene.box(at(0.5), 0, (width, 0.5, 0.45), brick)
        scene.box(at(0.5), 0.45, (width * 0.9, 0.36, rng.uniform(0.3, 0.8)), tex.leaves)
        hang(mid, 1.5, width * 0.6, 0.8, tex.poster)
    elif kind == "bench":
        x, y, yaw = at(0.45)
        scene.box((x, y, yaw), 0.38, (width, 0.45, 0.07), tone)
        for side in (-0.4 * width, 0.4 * width):
            scene.box((x + side * np.cos(yaw), y + side * np.sin(yaw), yaw), 0, (0.1, 0.4, 0.38), tone)
        hang(mid - width * 0.22, 1.1, width * 0.4, 0.75, tex.poster)
        hang(mid + width * 0.24, 1.2, width * 0.4, 0.55, [tex.painting, tex.poster][rng.integers(2)])
    elif kind == "crates":
        x, y, yaw = at(0.7)
        scene.box((x, y, yaw + rng.uniform(-0.2, 0.2)), 0, (0.7, 0.5, 0.55), tex.crate)
        scene.box((x, y, yaw + rng.uniform(-0.4, 0.4)), 0.55, (0.5, 0.4, 0.42), tex.crate)
    else:
        stone = partial(tex.cells, size=(0.3, 0.4), colors=[(150, 165, 175), (130, 150, 165)], joint=(90, 95, 100))
        scene.box(at(0.4), 0, (0.4, 0.4, tall), stone)
        scene.box(at(0.4), 1.3, (0.42, 0.42, 0.5), tex.poster)
    return width


def _build_wall(scene: Scene, wall: int, material: Material) -> None:
    (x, y, yaw), (w, d, h) = scene.at_wall(wall, 0.0, -0.008), scene.size
    length = w if wall % 2 == 0 else d
    right = np.cross(UP, [-np.sin(yaw), np.cos(yaw), 0.0])
    scene.plate(np.array([x, y, h]) - right * length / 2, right, -UP, length, h, material, 256)


def _furnish_wall(scene: Scene, rng: Rng, wall: int, things: list[str]) -> None:
    """Put things side by side against a wall, and outdoors a row of windows above them."""
    length = scene.size[wall % 2]
    along = -length / 2 + 0.5
    for thing in list(rng.permutation(things)) * 3:
        width = _furnish(scene, rng, wall, along, length / 2 - 0.45 - along, thing)
        along += width and width + rng.uniform(0.08, 0.3)
    if scene.outdoor:  # the upper story
        sill = partial(tex.plaster, color=(150, 165, 175))
        for at in np.arange(-length / 2 + 0.9, length / 2 - 0.6, 1.7):
            scene.hang(wall, at, 3.1, 1.05, 1.5, tex.window, 300)
            scene.box(scene.at_wall(wall, at, 0.18), 2.98, (1.25, 0.18, 0.1), sill)


def _cells(height: float, width: float, colors: Any, stagger: str, **options: Any) -> Material:
    return partial(tex.cells, size=(height, width), colors=colors, stagger=stagger, **options)


def build_room(seed: int, index: int, look: int | None = None) -> Scene:
    """Return the geometry and materials of a room at the place of its index, with its own look or another's."""
    look = index if look is None else look
    rng = named_rng(seed, look, "room")
    kind = list(KINDS.values())[(look + seed) % len(KINDS)]
    outdoor = bool(kind.get("outdoor"))
    w, d, h = rng.uniform([7.4, 6.0, 3.0], [8.8, 7.0, 3.4])
    w, d, h = (w + 1.2, d + 1.2, 5.4) if outdoor else (w, d, h)
    origin = np.array([28.0 * index, 4.0 * (index % 3), 0.0])
    scene = Scene(origin, (w, d, h), outdoor)
    if kind["wall"] is None:
        paint = np.asarray(tex.random_color(rng, (0.08, 0.3), (0.7, 0.88)))
        wall: Material = partial(tex.plaster, color=paint, band=paint * rng.uniform(0.5, 0.75))
    else:
        wall = _cells(*kind["wall"])
    for k in range(4):
        _build_wall(scene, k, wall)
    floor = _cells(*kind["floor"], jitter=0.15, motifs=kind["floor"][3] == "none")
    scene.plate((-w / 2, d / 2, 0), (1, 0, 0), (0, -1, 0), w, d, floor, 256)
    if outdoor:
        scene.plate((-150, -150, 40), (1, 0, 0), (0, 1, 0), 300, 300, tex.clouds, 4)  # the sky
    else:
        ceiling = partial(tex.cells, size=(0.6, 0.6), colors=[(215, 222, 225)], stagger="none", jitter=0.03)
        scene.plate((-w / 2, -d / 2, h), (1, 0, 0), (0, 1, 0), w, d, ceiling, 160)
        beam = partial(tex.wood, color=np.asarray((50, 80, 115)) * rng.uniform(0.7, 1.4))
        for x in np.linspace(-w / 2, w / 2, 5)[1:-1]:
            scene.box((x, 0, 0), h - 0.24, (0.18, d, 0.24), beam, ppm=160)
        for x in (-w / 4 * 1.5, 0.12 * w, w / 4 * 1.5):
            for y in (-d / 5, d / 5):
                scene.box((x, y, 0), h - 0.04, (0.9, 0.25, 0.04), tex.lamp, ppm=120)
    for k in range(4):
        _furnish_wall(scene, rng, k, kind["things"])
    _furnish_middle(scene, rng)
    return scene


def _furnish_middle(scene: Scene, rng: Rng) -> None:
    """Furnish the corners, the middle, and the space below the ceiling. Leave a ring free for the walks."""
    w, d, h = scene.size
    for sx, sy in product((1, -1), repeat=2):
        x, y, yaw = sx * (w / 2 - 0.42), sy * (d / 2 - 0.42), rng.uniform(0, 6)
        below, above, turn = (
            (((0.42, 0.42, 0.9), tex.poster), ((0.3, 0.3, 0.35), tex.books), 0.5),
            (((0.4, 0.4, 0.4), tex.crate), ((0.36, 0.36, 0.8), tex.leaves), 0.3),
            (((0.5, 0.45, 0.5), tex.crate), ((0.4, 0.35, 0.4), tex.drawers), 0.4),
        )[rng.integers(3)]
        scene.box((x, y, yaw), 0, *below)
        scene.box((x, y, yaw + turn), below[0][2], *above)
    yaw, tone = rng.uniform(-0.4, 0.4), partial(tex.wood, color=np.asarray(OAK[0]) * rng.uniform(0.6, 1.2))
    c, s = np.cos(yaw), np.sin(yaw)
    if not scene.outdoor and rng.random() < 0.7:  # a table
        scene.box((0, 0, yaw), 0.68, (1.3, 0.8, 0.05), tone, top=tex.cloth if rng.random() < 0.5 else tone)
        for lx, ly in ((0.58, 0.34), (0.58, -0.34), (-0.58, 0.34), (-0.58, -0.34)):
            scene.box((lx * c - ly * s, lx * s + ly * c, yaw), 0, (0.07, 0.07, 0.68), tone)
        _clutter(scene, rng, (0, 0, yaw), 0.73, 1.1, 0.5, 4)
    else:  # a plinth
        scene.box((0, 0, yaw), 0, (0.8, 0.8, 0.45), tex.poster, top=tone)
        scene.box((0, 0, yaw + 0.5), 0.45, (0.45, 0.45, 0.4), tex.crate)
        scene.box((0, 0, yaw + 0.9), 0.85, (0.25, 0.25, 0.45), tex.leaves if scene.outdoor else tex.books)
    mosaic = partial(tex.cells, size=(0.24, 0.24), colors=MOSAIC, stagger="none", motifs=True)
    rug = 0.3 * w * np.array([c, s, 0]), 0.3 * d * np.array([-s, c, 0])
    corner, material = rug[1] - rug[0] + [0, 0, 0.012], mosaic if scene.outdoor else tex.cloth
    scene.plate(corner, (c, s, 0), (s, -c, 0), 0.6 * w, 0.6 * d, material, 220)
    for i in range(0 if scene.outdoor else 3):  # boxes hanging from the ceiling
        angle = yaw + i * 2.1
        x, y, z = 0.24 * w * np.cos(angle), 0.24 * d * np.sin(angle), min(h, 3.4) - rng.uniform(0.7, 0.9)
        scene.box((x, y, angle), z, (0.45, 0.45, 0.3), [tex.cloth, tex.poster, tex.painting][i], ppm=300)
        scene.box((x, y, angle), z + 0.3, (0.02, 0.02, h - z - 0.3), tex.lamp)


# Painting and rendering


def paint(scene: Scene, seed: int, index: int, number: int) -> None:
    """Make the texture of rectangle `number` of room `index`, shaded by its normal, and its mip levels."""
    quad = scene.quads[number]
    multiple = 2 ** (LEVELS - 1)
    h, w = (max(multiple, round(side * quad.ppm / multiple) * multiple) for side in (quad.height, quad.width))
    image = quad.material(named_rng(seed, index, "quad", number), h, w, quad.ppm)
    if quad.material not in (tex.lamp, tex.clouds):
        image = cv2.convertScaleAbs(image, alpha=0.85 + float(quad.normal @ TO_LIGHT))
    for pyramid, level in ((quad.color, image), (quad.gray, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))):
        pyramid.append(level)
        for _ in range(LEVELS - 1):
            height, width = level.shape[:2]
            level = cv2.resize(level, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            pyramid.append(level)


@dataclass
class Rays:
    """The rays of a camera's samples: x / z and y / z, each (SAMPLES * H, SAMPLES * W) float32, camera frame."""

    camera: "pycolmap.Camera"
    x: Image
    y: Image
    planes: Floats  # (5, 4) planes of the viewing frustum in the camera frame; positive inside

    @classmethod
    def of(cls, camera: "pycolmap.Camera") -> "Rays":
        """Unproject the sample grid. The center of the top-left pixel is (0.5, 0.5)."""
        u, v = ((np.arange(SAMPLES * n) + 0.5) / SAMPLES for n in (camera.width, camera.height))
        if camera.model.name == "PINHOLE":  # x depends only on u, y only on v
            x = np.asarray(camera.cam_from_img(np.stack([u, 0 * u], -1)))[:, 0]
            y = np.asarray(camera.cam_from_img(np.stack([0 * v, v], -1)))[:, 1]
            x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        else:
            pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
            x, y = np.asarray(camera.cam_from_img(pixels)).T.astype(np.float32).reshape(2, len(v), len(u))
        planes = np.array([
            [0, 0, 1, -NEAR_M], [1, 0, -x.min(), 0], [-1, 0, x.max(), 0],
            [0, 1, -y.min(), 0], [0, -1, y.max(), 0],
        ])  # fmt: skip
        return cls(camera, np.ascontiguousarray(x), np.ascontiguousarray(y), planes)


def _visible_area(polygon: Floats, rays: Rays) -> tuple[slice, slice] | None:
    """Return the rows and columns of samples that may see a polygon (N, 3) in the camera frame; None if none may."""
    for plane in rays.planes:
        side = polygon @ plane[:3] + plane[3]
        if (side >= 0).all():
            continue
        kept: list[Floats] = []
        for i in range(len(polygon)):
            a, b, sa, sb = polygon[i - 1], polygon[i], side[i - 1], side[i]
            if (sa >= 0) != (sb >= 0):
                kept.append(a + (b - a) * sa / (sa - sb))
            if sb >= 0:
                kept.append(b)
        if not kept:
            return None
        polygon = np.array(kept)
    # Distortion bends the edges, so project points along them, not only the corners.
    steps = np.linspace(0, 1, 6)[:, None, None]
    outline = (polygon + steps * (np.roll(polygon, -1, 0) - polygon)).reshape(-1, 3)
    pixels = np.asarray(rays.camera.img_from_cam(outline))
    low, high = np.floor(pixels.min(0) - 2), np.ceil(pixels.max(0) + 2)
    limits = np.array([rays.camera.width, rays.camera.height])
    (c0, r0), (c1, r1) = ((np.clip(p, 0, limits) * SAMPLES).astype(int) for p in (low, high))
    return (slice(r0, r1), slice(c0, c1)) if r1 > r0 and c1 > c0 else None


def _texture(level: Image, x: Image, y: Image) -> Image:
    """Interpolate a texture at N positions, in texels; the center of the first texel is (0.5, 0.5)."""
    width = 4096  # OpenCV limits the sides of a map
    rows = -(-len(x) // width)
    maps = np.zeros((2, rows * width), np.float32)
    maps[0, : len(x)], maps[1, : len(x)] = x, y
    maps -= 0.5
    texels = cv2.remap(level, maps[0].reshape(rows, width), maps[1].reshape(rows, width), cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return texels.reshape(rows * width, -1)[: len(x)]


def render(quads: list[Quad], world_from_cam: Floats, rays: Rays, gray: bool) -> tuple[Image, Image]:
    """Render an image, (H, W, 3) BGR or (H, W) if `gray`, float32 0..255, and its depth, (H, W) float32 meters.

    Depth is measured along the optical axis at pixel centers; it is 0 in the sky and in pixels that cross an edge.
    """
    height, width = rays.x.shape
    R, center = world_from_cam[:3, :3].T, world_from_cam[:3, 3]
    nearest = np.zeros((height, width), np.float32)  # inverse depth
    owner = np.full((height, width), -1, np.int16)
    visible: dict[int, tuple[tuple[slice, slice], NDArray[np.float32], float]] = {}
    corners = np.stack([quad.corners for quad in quads])
    normals = np.stack([quad.normal for quad in quads])
    distances = np.einsum("qi,qi->q", normals, center - corners[:, 0])
    corners = (corners - center) @ R.T
    corner_outside: Any = corners @ rays.planes[:, :3].T + rays.planes[:, 3] < 0
    outside = corner_outside.all(axis=1).any(axis=1)
    for k in np.flatnonzero((distances > 1e-6) & ~outside).tolist():
        quad, distance = quads[k], float(distances[k])
        area = _visible_area(corners[k], rays)
        if area is None:
            continue
        # For the ray r = (x, y, 1), 1 / z = n.r / n.p. Texture coordinates divided by z are linear in r as well.
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
            visible[k] = area, linear, distance
    image = np.zeros((height * width, 1 if gray else 3), np.uint8)
    samples = np.arange(height * width).reshape(height, width)
    offsets = np.tile(OFFSETS, (height // SAMPLES, width // SAMPLES)).ravel()
    focal = SAMPLES * (rays.camera.focal_length_x * rays.camera.focal_length_y) ** 0.5
    for k, (area, linear, distance) in visible.items():
        quad, index = quads[k], samples[area][owner[area] == k]
        if not len(index):
            continue
        x, y, z = rays.x.ravel()[index], rays.y.ravel()[index], 1 / nearest.ravel()[index]
        s, t = ((a * x + (b * y + c)) * z for a, b, c in linear[1:])
        pyramid = quad.gray if gray else quad.color
        th, tw = pyramid[0].shape[:2]
        # The footprint of a sample on the surface has the area z^3 / (f^2 * distance). The four samples of a pixel
        # round the mip level with four offsets, which blends levels. The term with 0.25 blurs slanted surfaces, which
        # would flicker otherwise.
        scale = tw / quad.width / focal / math.sqrt(distance)
        log_z = np.log2(z)
        level = 1.5 * log_z + math.log2(scale) + 0.25 * np.maximum(log_z - math.log2(distance), 0)
        level = np.clip((level + offsets[index]).astype(np.int8), 0, LEVELS - 1)
        for i in range(LEVELS):
            rows = np.flatnonzero(level == i)
            if not len(rows):
                continue
            lx, ly = tw / quad.width / 2.0**i, th / quad.height / 2.0**i
            image[index[rows]] = _texture(pyramid[i], s[rows] * np.float32(lx), t[rows] * np.float32(ly))
    size = (width // SAMPLES, height // SAMPLES)
    image = image.reshape(height, width, -1).astype(np.float32)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), _depth(quads, owner, nearest)


def _depth(quads: list[Quad], owner: Image, nearest: Image) -> Image:
    """Return depth at pixel centers (H, W), from the mean inverse depth of the samples, which is exact on a plane."""
    low = high = total = nearest[::SAMPLES, ::SAMPLES]
    for i in range(1, SAMPLES**2):
        sample = nearest[i // SAMPLES :: SAMPLES, i % SAMPLES :: SAMPLES]
        low, high, total = np.minimum(low, sample), np.maximum(high, sample), total + sample
    mean = total / SAMPLES**2
    depth = np.where(low > 0.97 * high, 1 / np.maximum(mean, 1e-6), 0).astype(np.float32)
    sky = np.array([quad.material is tex.clouds for quad in quads] + [True])
    depth[sky[owner[::SAMPLES, ::SAMPLES]]] = 0
    return depth
