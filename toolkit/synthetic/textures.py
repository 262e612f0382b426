"""Procedural textures of the rendered capture: walls, floors, furniture, pictures.

A material is a function (random generator, height, width, pixels per meter) -> (height, width, 3) BGR uint8. All have
many corners at several scales. The same state of the generator gives the same bytes.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[Any]
Rng = np.random.Generator
Material = Callable[[Rng, int, int, float], Image]


def _f(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32)


def _i(value: ArrayLike) -> NDArray[np.int32]:
    return np.asarray(value).astype(np.int32)


def random_color(
    rng: Rng, saturation: tuple[float, float] = (0.15, 0.75), value: tuple[float, float] = (0.25, 0.95)
) -> Any:
    """Return a random BGR color; half are warm and a quarter are blue, as in furnished rooms."""
    hues = rng.normal(28, 20), rng.normal(28, 20), rng.normal(212, 18), rng.uniform(0, 360)
    hsv = _f([[[hues[rng.integers(4)] % 360, rng.uniform(*saturation), rng.uniform(*value)]]])
    return tuple(float(c) for c in cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0] * 255)


def _noise(rng: Rng, h: int, w: int, cells: tuple[int, ...], stretch: int = 1) -> Image:
    """Return smooth noise (h, w) with a standard deviation of about 1, summed over cell sizes in pixels."""
    total = np.zeros((h, w), np.float32)
    for cell in cells:
        rows, columns = h // cell + 3, w // (cell * stretch) + 3
        coarse = rng.standard_normal((rows, columns), dtype=np.float32)
        total += cv2.resize(coarse, (columns * cell * stretch, rows * cell))[cell : cell + h, cell : cell + w]
    return total / len(cells) ** 0.5


def in_color(gray: Image) -> Image:
    """Return an image with three equal channels; numpy is slow if it repeats a value along an axis of three."""
    return cv2.merge([gray] * 3)


def _painted(color: Any, shade: Image) -> Image:
    return np.clip(_f(color) * (1 + shade[..., None]), 0, 255).astype(np.uint8)


def _write(rng: Rng, image: Image, x: float, y: float, height: float, color: Any, words: int = 2) -> None:
    """Write words whose capitals are about `height` pixels high, baseline at (x, y)."""
    font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
    thick = max(1, round(height / 9))
    syllables = ["ka", "lo", "mi", "ra", "tu", "ze", "bor", "den", "fal", "gri", "hus", "win", "OX", "42", "7", "No."]
    text = " ".join("".join(rng.choice(syllables, rng.integers(1, 4))) for _ in range(words))
    cv2.putText(image, text, (int(x), int(y)), font, height / 22, color, thick, cv2.LINE_AA)


def _spot(rng: Rng, image: Image) -> list[int]:
    """Return a random pixel, x and y."""
    h, w = image.shape[:2]
    spot: list[int] = (rng.uniform(0, 1, 2) * [w, h]).astype(int).tolist()
    return spot


def _blob(rng: Rng, image: Image, center: list[int], axes: list[float], color: Any) -> None:
    """Fill an ellipse with the given axes (pixels) and a random rotation."""
    cv2.ellipse(image, (center, axes, rng.uniform(0, 180)), color, -1, cv2.LINE_AA)


def _wander(rng: Rng, image: Image, steps: int, step: float) -> Image:
    """Return the corners (steps, 2) of a random walk from a random pixel, in pixels."""
    h, w = image.shape[:2]
    return _i(np.cumsum(rng.normal(0, step, (steps, 2)), 0) + rng.uniform(0, 1, 2) * [w, h])


def _shapes(rng: Rng, image: Image, count: int, low: float, high: float) -> None:
    """Scatter discs, boxes, triangles, rings and strokes of size low..high pixels."""
    h, w = image.shape[:2]
    for _ in range(count):
        size = np.exp(rng.uniform(np.log(low), np.log(high)))
        x, y = rng.uniform(0, w), rng.uniform(0, h)
        color, kind = random_color(rng, (0.1, 1.0), (0.05, 1.0)), rng.integers(5)
        center, thick = (int(x), int(y)), max(1, int(size / 8))
        if kind < 2:
            cv2.circle(image, center, max(1, int(size / 2)), color, thick if kind else -1, cv2.LINE_AA)
        elif kind == 4:
            end = _i(np.array([x, y]) + rng.uniform(-size, size, 2))
            cv2.line(image, center, end.tolist(), color, thick, cv2.LINE_AA)
        else:
            angle = np.arange(kind + 1) * 2 * np.pi / (kind + 1) + rng.uniform(0, 6)
            polygon = [x + size * 0.6 * np.cos(angle), y + size * rng.uniform(0.3, 0.7) * np.sin(angle)]
            cv2.fillConvexPoly(image, _i(np.stack(polygon, -1)), color, cv2.LINE_AA)


def plaster(rng: Rng, h: int, w: int, ppm: float, color: Any = (190, 205, 210), band: Any = None) -> Image:
    """A painted wall with stains, cracks and grain; `band` paints its lower meter with a rail on top."""
    image = _painted(color, 0.035 * _noise(rng, h, w, (int(ppm / 3), int(ppm / 12))))
    if band is not None:
        rail = h - int(1.0 * ppm)
        image[rail:] = _painted(band, 0.05 * _noise(rng, h - rail, w, (int(ppm / 6), int(ppm / 20))))
        image[rail : rail + int(0.05 * ppm)] = np.clip(_f(band) * 0.6, 0, 255)
        for x in range(0, w, int(0.62 * ppm)):
            box = (x + int(0.06 * ppm), rail + int(0.14 * ppm)), (x + int(0.54 * ppm), h - int(0.2 * ppm))
            cv2.rectangle(image, *box, (_f(band) * 0.72).tolist(), max(1, int(0.012 * ppm)), cv2.LINE_AA)
    for _ in range(int(h * w / ppm**2 * 2)):
        walk = _wander(rng, image, int(rng.integers(3, 9)), 0.03 * ppm)
        dark = (_f(color) * rng.uniform(0.55, 0.9)).tolist()
        cv2.polylines(image, [walk], False, dark, int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(int(h * w / ppm**2 * 10)):
        spot = _spot(rng, image)
        tone = (_f(color) * rng.uniform(0.5, 1.15)).clip(0, 255).tolist()
        axes = rng.uniform(2, 0.06 * ppm), rng.uniform(2, 0.04 * ppm)
        cv2.ellipse(image, (spot, axes, rng.uniform(0, 180)), tone, -1)
    return _grain(rng, image, 0.03)


def _grain(rng: Rng, image: Image, strength: float) -> Image:
    h, w = image.shape[:2]
    noisy = image + in_color(_noise(rng, h, w, (2, 5)) * strength * 255)
    return noisy.clip(0, 255, out=noisy).astype(np.uint8)


def cells(
    rng: Rng, h: int, w: int, ppm: float, size: tuple[float, float], colors: Any, stagger: str = "half",
    jitter: float = 0.12, joint: Any = (150, 155, 160), motifs: bool = False,
) -> Image:  # fmt: skip
    """Bricks, tiles or planks: cells of `size` (height, width) meters with joints, each with its own tone."""
    ch, cw = max(4, int(size[0] * ppm)), max(4, int(size[1] * ppm))
    y, rows, columns = np.arange(h), h // ch + 1, w // cw + 2
    row = y // ch
    shift = {"none": 0 * row, "half": row % 2 * cw // 2, "random": rng.integers(0, cw, rows)[row]}[stagger]
    x = np.arange(w)[None] + shift[:, None]
    column = x // cw
    tone = _f(colors)[rng.integers(0, len(colors), (rows, columns))]
    tone = tone * (1 + jitter * rng.standard_normal((rows, columns, 1), dtype=np.float32))
    streaks = 6 if stagger == "random" else 1
    image = np.take(tone.reshape(-1, 3), row[:, None] * columns + column, axis=0)
    image *= in_color(1 + 0.07 * _noise(rng, h, w, (3, 9), streaks))
    gap = max(1, round(0.008 * ppm))
    image[((y % ch) < gap)[:, None] | ((x % cw) < gap)] = joint
    image = image.clip(0, 255, out=image).astype(np.uint8)
    if motifs:
        for r in range(rows):
            for c in range(columns):
                if rng.random() < 0.35:
                    cell = image[r * ch + gap : (r + 1) * ch, c * cw + gap : (c + 1) * cw]
                    if cell.size:
                        _shapes(rng, cell, 3, ch / 6, ch / 2)
    _chip(rng, image, ppm)
    return _grain(rng, image, 0.02)


def _chip(rng: Rng, image: Image, ppm: float) -> None:
    """Scatter small chips, drips and scratches, as on a used surface."""
    h, w = image.shape[:2]
    for _ in range(int(h * w / ppm**2 * 14)):
        x, y = _spot(rng, image)
        tone = (_f(image[y, x]) * rng.uniform(0.4, 1.5)).clip(0, 255).tolist()
        axes = rng.uniform(0.008, 0.05, 2) * ppm
        _blob(rng, image, [x, y], axes.tolist(), tone)


def poster(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A printed sheet: title, picture, paragraphs, border."""
    image = np.full((h, w, 3), random_color(rng, (0.05, 0.7), (0.5, 1.0)), np.uint8)
    ink = random_color(rng, (0.2, 1.0), (0.05, 0.35))
    top, bottom = int(h * rng.uniform(0.14, 0.25)), int(h * rng.uniform(0.6, 0.8))
    picture = image[top:bottom, int(w * 0.06) : int(w * 0.94)]
    color, sizes = random_color(rng), (max(4, w // 4), max(4, w // 10))
    picture[:] = _painted(color, 0.25 * _noise(rng, bottom - top, picture.shape[1], sizes))
    _shapes(rng, picture, int(rng.integers(10, 26)), w * 0.04, w * 0.45)
    _write(rng, image, w * 0.06, top * 0.75, min(top * 0.5, w * 0.13), ink, 1)
    line = 0.022 * ppm
    for y in np.arange(bottom + 2.0 * line, h - line, 1.7 * line):
        _write(rng, image, w * 0.07, y, line, ink, int(w / line / 3))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), ink, max(2, int(0.012 * ppm)))
    return _grain(rng, image, 0.012)


def painting(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """Hills and brush strokes in a dark or gilded frame."""
    sky, ground = (_f(random_color(rng, *ranges)) for ranges in (((0.1, 0.5), (0.6, 1.0)), ((0.2, 0.7), (0.2, 0.6))))
    horizon = h * (0.5 + 0.12 * _noise(rng, 1, w, (max(8, w // 4), max(4, w // 12)))[0])
    below = np.clip((np.arange(h)[:, None] - horizon) / 4, 0, 1)[..., None]
    strokes = 1 + 0.12 * _noise(rng, h, w, (max(4, h // 8), 6), 3)[..., None]
    image = ((sky * (1 - below) + ground * below) * strokes).clip(0, 255).astype(np.uint8)
    for _ in range(int(rng.integers(60, 140))):
        center = _spot(rng, image)
        axes = (rng.uniform(0.015, 0.09, 2) * w).tolist()
        tone = (_f(image[center[1], center[0]]) * 0.4 + 0.6 * _f(random_color(rng))).tolist()
        _blob(rng, image, center, axes, tone)
    frame = max(3, int(0.045 * ppm))
    wood = (40, 90, 130) if rng.random() < 0.5 else (35, 35, 45)
    cv2.rectangle(image, (0, 0), (w, h), wood, 2 * frame)
    cv2.rectangle(image, (frame, frame), (w - frame, h - frame), (_f(wood) * 1.8).clip(0, 255).tolist(), 2)
    return _grain(rng, image, 0.02)


def wood(rng: Rng, h: int, w: int, ppm: float, color: Any = (60, 100, 145)) -> Image:
    """Boards with grain along the image's x."""
    image = _painted(color, 0.16 * _noise(rng, h, w, (2, 6), 14) + 0.08 * _noise(rng, h, w, (12,), 8))
    for y in range(0, h, max(8, int(0.16 * ppm))):
        image[y : y + 2] = _f(color) * 0.45
    _chip(rng, image, ppm)
    return image


def books(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """The front of a shelf: boards, uprights, and rows of books with titles on their spines."""
    board = _f((45, 75, 110)) * rng.uniform(0.6, 1.4)
    image = np.full((h, w, 3), board * 0.25, np.uint8)
    thick, rows = max(2, int(0.03 * ppm)), max(1, round(h / ppm / 0.34))
    for r in range(rows):
        bottom, room = int((r + 1) * h / rows) - thick, h / rows - thick
        x = float(thick)
        while x < w - thick:
            width = ppm * rng.uniform(0.018, 0.06)
            if rng.random() < 0.06:  # a gap
                x += ppm * rng.uniform(0.04, 0.14)
                continue
            top = int(bottom - room * rng.uniform(0.55, 0.95))
            right = int(min(x + width, w - thick))
            color = _f(random_color(rng, (0.1, 0.8), (0.15, 0.9)))
            cv2.rectangle(image, (int(x), top), (right - 1, bottom), color.tolist(), -1)
            for _ in range(int(rng.integers(1, 4))):
                y, tall = int(rng.uniform(top, bottom - 4)), int(rng.uniform(0.01, 0.06) * ppm)
                end = right - 2, min(y + tall, bottom)
                cv2.rectangle(image, (int(x) + 1, y), end, random_color(rng, (0, 0.6)), -1)
            image[top:bottom, right - 1 : right] = color * 0.45
            x += width
        image[bottom : bottom + thick] = board
    image[:, :thick] = image[:, -thick:] = board
    image[:thick] = board
    return _grain(rng, image, 0.02)


def drawers(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A cabinet's front: doors and drawers with handles and labels."""
    color = _f(random_color(rng, (0.15, 0.6), (0.35, 0.8)))
    image = wood(rng, h, w, ppm, color)
    across, down = max(1, round(w / ppm / 0.45)), int(rng.integers(1, 4))
    for i in range(across):
        for j in range(down):
            x0, x1 = int(i * w / across), int((i + 1) * w / across)
            y0, y1 = int(j * h / down), int((j + 1) * h / down)
            cv2.rectangle(image, (x0 + 3, y0 + 3), (x1 - 4, y1 - 4), (color * 0.4).tolist(), 2)
            mid = ((x0 + x1) // 2, (y0 + y1) // 2)
            cv2.ellipse(image, (mid, (0.13 * ppm, 0.03 * ppm), 0), (180, 190, 200), -1, cv2.LINE_AA)
            if rng.random() < 0.6:
                _sticker(rng, image, x0 + 8, y0 + 8, 0.12 * ppm, ppm)
    return image


def _sticker(rng: Rng, image: Image, x: float, y: float, side: float, ppm: float) -> None:
    label = image[int(y) : int(y + side * rng.uniform(0.5, 1.0)), int(x) : int(x + side)]
    if min(label.shape[:2]) > 6:
        label[:] = random_color(rng, (0, 0.5), (0.7, 1.0))
        _shapes(rng, label, 3, 3, side / 2)
        _write(rng, label, 2, label.shape[0] * 0.8, max(4, label.shape[0] * 0.3), (20, 20, 30), 1)


def notes(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A cork board with overlapping papers and photographs."""
    image = _painted((95, 140, 185), 0.18 * _noise(rng, h, w, (2, 4)))
    for _ in range(int(h * w / ppm**2 * 26)):
        side = rng.uniform(0.08, 0.28) * ppm
        x, y = rng.uniform(0.02, 0.9) * w, rng.uniform(0.02, 0.85) * h
        if rng.random() < 0.4:
            _sticker(rng, image, x, y, side, ppm)
            continue
        paper = image[int(y) : int(y + side), int(x) : int(x + side * 0.75)]
        if min(paper.shape[:2]) > 12:
            paper[:] = random_color(rng, (0, 0.15), (0.8, 1.0))
            for line in np.arange(0.12, 0.95, 0.1):
                _write(rng, paper, 3, line * side + 3, 0.045 * side + 2, (50, 40, 40), 3)
    cv2.rectangle(image, (0, 0), (w, h), (50, 75, 100), max(4, int(0.06 * ppm)))
    return image


def chalk(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A blackboard with writing, sketches and wiped patches."""
    image = _painted((58, 68, 52), 0.22 * _noise(rng, h, w, (int(ppm / 5), int(ppm / 12)), 3))
    for _ in range(int(w * h / ppm**2 * 5)):
        x, y = rng.uniform(0, 0.8) * w, rng.uniform(0.1, 0.95) * h
        _write(rng, image, x, y, rng.uniform(0.03, 0.08) * ppm, (215, 225, 220), int(rng.integers(1, 4)))
    for _ in range(int(w * h / ppm**2 * 6)):
        walk = _wander(rng, image, 6, 0.06 * ppm)
        closed, color = bool(rng.integers(2)), random_color(rng, (0, 0.5), (0.7, 1))
        cv2.polylines(image, [walk], closed, color, 2, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w, h), (60, 95, 130), max(4, int(0.07 * ppm)))
    return _grain(rng, image, 0.03)


def door(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A panelled door with a plate and a handle."""
    color = _f(random_color(rng, (0.2, 0.7), (0.3, 0.7)))
    image = wood(rng, h, w, ppm, color)
    for top, bottom in ((0.06, 0.3), (0.36, 0.6), (0.66, 0.94)):
        for left, right in ((0.1, 0.46), (0.54, 0.9)):
            box = (int(left * w), int(top * h)), (int(right * w), int(bottom * h))
            cv2.rectangle(image, *box, (color * 0.45).tolist(), max(2, int(0.02 * ppm)))
    _sticker(rng, image, 0.25 * w, 0.12 * h, 0.5 * w, ppm)
    cv2.circle(image, (int(0.92 * w), int(0.52 * h)), int(0.035 * ppm), (90, 190, 220), -1, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w, h), (color * 1.3).clip(0, 255).tolist(), int(0.09 * ppm))
    return image


def window(rng: Rng, h: int, w: int, ppm: float, frame: Any = (225, 230, 235)) -> Image:
    """Panes with a view of sky and trees, or a curtain, behind bars."""
    image = _painted((225, 190, 150), 0.1 * _noise(rng, h, w, (max(8, h // 3), max(8, h // 6)), 2))
    for _ in range(45):
        center = (rng.uniform([0, 0.5], [1, 1.1]) * [w, h]).astype(int).tolist()
        green = _f((40, 90, 60)) * rng.uniform(0.4, 1.5)
        cv2.circle(image, center, int(rng.uniform(0.03, 0.12) * h), green.tolist(), -1, cv2.LINE_AA)
    if rng.random() < 0.6:
        folds, side = random_color(rng, (0.2, 0.6), (0.4, 0.9)), int(w * rng.uniform(0.2, 0.4))
        image[:, :side] = _painted(folds, 0.25 * np.sin(np.arange(side) / ppm * 90)[None] * np.ones((h, 1)))
    bar = max(3, int(0.04 * ppm))
    for x in np.linspace(0, w, int(rng.integers(3, 5))):
        cv2.line(image, (int(x), 0), (int(x), h), frame, bar)
    for y in np.linspace(0, h, int(rng.integers(3, 5))):
        cv2.line(image, (0, int(y)), (w, int(y)), frame, bar)
    cv2.rectangle(image, (0, 0), (w, h), frame, 3 * bar)
    return _grain(rng, image, 0.015)


def crate(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """Nailed boards with a brace and a stencil."""
    image = wood(rng, h, w, ppm, _f((95, 145, 190)) * rng.uniform(0.6, 1.1))
    edge = max(3, int(0.06 * ppm))
    cv2.line(image, (0, h), (w, 0), (70, 110, 150), edge, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w, h), (60, 100, 140), 2 * edge)
    for x in np.linspace(edge / 2, w - edge / 2, 5):
        for y in (edge / 2, h - edge / 2):
            cv2.circle(image, (int(x), int(y)), max(1, edge // 6), (30, 40, 50), -1, cv2.LINE_AA)
    _write(rng, image, 0.16 * w, 0.5 * h, 0.16 * h, (30, 30, 40), 1)
    _write(rng, image, 0.3 * w, 0.78 * h, 0.09 * h, (30, 30, 120), 1)
    return image


def cloth(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A rug or a cover: borders, a field of motifs, weave."""
    image = np.empty((h, w, 3), np.uint8)
    base = [random_color(rng, (0.3, 0.8), (0.25, 0.7)) for _ in range(4)]
    for i, inset in enumerate((0, 0.07, 0.1, 0.16)):
        d = int(inset * min(h, w))
        image[d : h - d, d : w - d] = base[i]
    d, motif = int(0.16 * min(h, w)), max(6, int(0.16 * ppm))
    inner = image[d : h - d, d : w - d]
    for y in range(motif // 2, inner.shape[0], motif):
        for x in range(motif // 2 + y // motif % 2 * motif // 2, inner.shape[1], motif):
            angle = np.arange(4) * np.pi / 2 + rng.choice([0, np.pi / 4])
            radius = motif * rng.uniform(0.25, 0.55)
            shape = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], -1)
            cv2.fillConvexPoly(inner, _i(shape), base[int(rng.integers(4))], cv2.LINE_AA)
            cv2.circle(inner, (x, y), max(1, int(radius / 3)), base[int(rng.integers(4))], -1, cv2.LINE_AA)
    return _grain(rng, image, 0.06)


def leaves(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """Foliage and flowers."""
    image = _painted((30, 60, 35), 0.3 * _noise(rng, h, w, (8, 20)))
    for _ in range(int(h * w / ppm**2 * 500)):
        center = _spot(rng, image)
        tone = _f((50, 130, 70)) * rng.uniform(0.4, 1.5)
        if rng.random() < 0.07:
            tone = _f(random_color(rng, (0.5, 1), (0.7, 1)))
        axes = (rng.uniform(0.015, 0.06, 2) * ppm).tolist()
        _blob(rng, image, center, axes, tone.clip(0, 255).tolist())
    return image


def plain(rng: Rng, h: int, w: int, ppm: float, color: Any = (60, 70, 80)) -> Image:
    """One color."""
    return np.full((h, w, 3), color, np.uint8)


def lamp(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A bright panel."""
    image = np.full((h, w, 3), 250, np.uint8)
    cv2.rectangle(image, (0, 0), (w, h), (150, 160, 170), max(3, int(0.06 * ppm)))
    return image


def clouds(rng: Rng, h: int, w: int, ppm: float) -> Image:
    """A summer sky."""
    cover = np.clip(_noise(rng, h, w, (w // 6, w // 14, w // 40)) * 0.6 + 0.2, 0, 1)[..., None]
    return (_f((225, 180, 130)) * (1 - cover) + 245 * cover).astype(np.uint8)
