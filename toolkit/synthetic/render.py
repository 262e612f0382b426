"""Render textured rectangles to an image with exact depth.

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
from toolkit.synthetic.light import LEVELS
from toolkit.synthetic.scene import Quad
from toolkit.synthetic.textures import Image

if TYPE_CHECKING:
    import pycolmap

NEAR_M = 0.05
SAMPLES = 2  # per pixel and axis
OFFSETS = np.array([[-0.125, 0.125], [0.375, 0.625]], np.float32)  # added to the mip level of each sample of a pixel


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
