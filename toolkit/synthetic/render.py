"""Paint textured rectangles with the light of their room's lamps, and render them to an image with exact depth.

Each pixel has four samples. The ray of each sample, from the camera model with its distortion, is intersected with the
rectangles; the nearest one gives the color, read from its texture at the mip level of the sample's footprint.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import Floats
from toolkit.synthetic.scene import Quad, Scene, named_rng
from toolkit.synthetic.textures import Image, in_color

if TYPE_CHECKING:
    import pycolmap

LEVELS = 6  # mip levels; texture sides are multiples of 2 ** (LEVELS - 1)
NEAR_M = 0.05
SAMPLES = 2  # per pixel and axis
OFFSETS = np.array([[-0.125, 0.125], [0.375, 0.625]], np.float32)  # added to the mip level of each sample of a pixel


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


def paint(scene: Scene, seed: int, index: int, number: int) -> None:
    """Make the texture of rectangle `number` of room `index`, with light baked in, and its mip levels."""
    quad = scene.quads[number]
    multiple = 2 ** (LEVELS - 1)
    h, w = (max(multiple, round(side * quad.ppm / multiple) * multiple) for side in (quad.height, quad.width))
    image = quad.material(named_rng(seed, index, "quad", number), h, w, quad.ppm)
    if quad.lit:
        light = cv2.resize(_light(scene, quad), (w, h), interpolation=cv2.INTER_LINEAR)
        image = cv2.multiply(image, in_color(light), dtype=cv2.CV_8U)
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
    picture = np.zeros((height * width, 1 if gray else 3), np.uint8)
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
            picture[index[rows]] = _texture(pyramid[i], s[rows] * np.float32(lx), t[rows] * np.float32(ly))
    size = (width // SAMPLES, height // SAMPLES)
    picture = picture.reshape(height, width, -1).astype(np.float32)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA), _depth(quads, owner, nearest)


def _depth(quads: list[Quad], owner: Image, nearest: Image) -> Image:
    """Return depth at pixel centers (H, W), from the mean inverse depth of the samples, which is exact on a plane."""
    low = high = total = nearest[::SAMPLES, ::SAMPLES]
    for i in range(1, SAMPLES**2):
        sample = nearest[i // SAMPLES :: SAMPLES, i % SAMPLES :: SAMPLES]
        low, high, total = np.minimum(low, sample), np.maximum(high, sample), total + sample
    mean = total / SAMPLES**2
    depth = np.where(low > 0.97 * high, 1 / np.maximum(mean, 1e-6), 0).astype(np.float32)
    sky = np.array([not quad.lit and quad.ppm < 10 for quad in quads] + [True])
    depth[sky[owner[::SAMPLES, ::SAMPLES]]] = 0
    return depth
