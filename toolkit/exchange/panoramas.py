"""Import panoramas of the whole sphere: each becomes the images of a rig of perspective cameras, all in one place."""

import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture.images import default_workers, find_mask, prefetch, read_image
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import CaptureError, ImageError
from toolkit.exchange.drafts import AXES, SUBSESSION, DraftImage, list_images, start
from toolkit.exchange.import_report import ImportReport
from toolkit.exchange.interchange import read_poses
from toolkit.geometry import Floats, make_pose

YAWS_DEG = (0, 60, 120, 180, 240, 300)  # of the views, of 90 degrees each: neighbors share a third
_LARGEST = 2**15 - 1  # side of an image that cv2.remap can read, pixels


def import_panoramas(
    images: str | Path, capture: str | Path, device: str = "ios", split: str = "query", table: str | Path | None = None,
    poses_are: str = "world_from_cam", **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session of equirectangular panoramas: a map with poses, or queries, whose poses become ground truth.

    The frame of a panorama is that of COLMAP's EQUIRECTANGULAR: z points to the center of the picture, x to the right,
    y down. It is the frame of the rig, so the pose of a query is that of its panorama. The ground and the sky more than
    45 degrees from the horizon are left out. A mask of a panorama is cut as well, see `images.find_mask`. Raise
    CaptureError for a malformed table, a map without poses, two panoramas of one name, the session exists already, or
    no panorama is left; ManifestError as for `interchange.import_images`.

    Args:
        images: folder of JPEG and PNG files.
        capture, device, split: as for `interchange.import_colmap`.
        table, poses_are: as for `interchange.import_images`, with a row for each panorama.
        options: see `drafts.Options`; `unit_m` is 1 by default.
    """
    folder = Path(images)
    options["placing"], masks = "copy", options.pop("masks", None)  # masks are cut here
    options.setdefault("unit_m", 1.0)
    draft = start(capture, device, split, folder, **options)
    listed, poses = (list_images(folder, draft=draft), {}) if table is None else read_poses(Path(table), poses_are)
    if split == "map" and not poses:
        raise CaptureError(f"A map needs poses: give a table with the columns image, {', '.join(POSE_NAMES)}.")
    stems = Counter(str(Path(name).with_suffix("")) for name in listed)
    if twice := [name for name, count in stems.items() if count > 1]:
        raise CaptureError(f"{folder}: two panoramas have the name {twice[0]}. Rename one.")
    sizes: dict[int, int] = {}
    parent = next(one for one in (Path(capture).absolute(), *Path(capture).absolute().parents) if one.is_dir())
    with tempfile.TemporaryDirectory(dir=parent) as temporary:
        out = Path(temporary)

        def cut(name: str) -> int | str:
            try:
                return _cut(folder / name, out / Path(name).with_suffix(""), None if masks is None else Path(masks))
            except ImageError as error:
                return str(error)

        results = prefetch(cut, tqdm(listed, "cut", unit="panorama"), default_workers(), ahead=0)
        for name, side in zip(listed, results, strict=True):
            if isinstance(side, str):
                draft.rows.append({"image": name, "status": side})
                continue
            size = sizes.setdefault(side, len(sizes) + 1)
            params = [side / 2, side / 2, side / 2, side / 2]
            camera = pycolmap.Camera(model="PINHOLE", width=side, height=side, params=params)
            rig = f"{SUBSESSION}/panorama_{size}"
            for yaw in YAWS_DEG:
                view = (Path(name).with_suffix("") / f"{yaw:03d}.jpg").as_posix()
                draft.images.append(DraftImage(view, camera, f"{rig}_{yaw:03d}", name, rig, "a view of 90 degrees"))
                draft.sources[view] = out / view
            if name in poses:
                draft.poses[name] = poses[name]
        for side, size in sizes.items():
            draft.notes.append(f"panoramas are cut into {len(YAWS_DEG)} views of 90 degrees, {side} x {side} pixels")
            rig = f"{SUBSESSION}/panorama_{size}"
            turn = AXES[draft.axes]  # views have the same place in the panorama, whatever axes the poses have
            draft.rigs += [(rig, f"{rig}_{yaw:03d}", turn @ make_pose(rotation, np.zeros(3)) @ turn)
                           for yaw, rotation in _rig_from_views()]  # fmt: skip
        draft.convention = poses_are
        return draft.finish()


def _rig_from_views() -> Iterator[tuple[int, Floats]]:
    """Yield the yaw of each view, to the right, and its rotation rig_from_view (3, 3)."""
    for yaw in YAWS_DEG:
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        yield yaw, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _cut(path: Path, out: Path, masks: Path | None) -> int:
    """Write the views of a panorama, and of its mask, to a folder; return their side in pixels.

    Raise ImageError if the picture or its mask cannot be read, or does not show the whole sphere.
    """
    pixels = read_image(path)
    height, width = pixels.shape[:2]
    if width != 2 * height or width > _LARGEST:
        found = f"{width} x {height} pixels, expected twice as wide as high, the whole sphere, up to {_LARGEST} pixels"
        raise ImageError(f"no equirectangular panorama: {found}")
    mask_path = find_mask(path, masks)
    mask = None if mask_path is None else read_image(mask_path, gray=True)
    if mask is not None and mask.shape != (height, width):
        found = f"{mask.shape[1]} x {mask.shape[0]} pixels, expected {width} x {height}"
        raise ImageError(f"its mask has {found}: {mask_path}")
    side = 2 * round(width / np.pi / 2)  # in the center of a view, as many pixels per degree as in the panorama
    out.mkdir(parents=True)
    if mask is not None:
        (out / "masks").mkdir()
    for yaw, rig_from_view in _rig_from_views():
        columns, rows = pixels_in_panorama(side, rig_from_view, width)
        view = cv2.remap(pixels, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
        cv2.imwrite(str(out / f"{yaw:03d}.jpg"), view[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
        if mask is not None:
            hidden = cv2.remap(mask, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
            cv2.imwrite(str(out / "masks" / f"{yaw:03d}.jpg.png"), hidden)
    return side


def pixels_in_panorama(side: int, rig_from_view: Floats, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for each pixel of a view of 90 degrees, (side, side), its column and row in a panorama, as cv2.remap does:
    the center of the top-left pixel is (0, 0)."""
    across = (np.arange(side) + 0.5) / (side / 2) - 1
    x, y = np.meshgrid(across, across)
    x, y, z = np.moveaxis(np.stack([x, y, np.ones_like(x)], axis=-1) @ rig_from_view.T, -1, 0)
    columns = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
    rows = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * width / 2 - 0.5
    return columns.astype(np.float32), rows.astype(np.float32)
