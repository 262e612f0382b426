"""Photographs arranged as captures: the pictures show what their poses and cameras say."""

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.capture import Session
from toolkit.capture.check import check_capture
from toolkit.errors import CaptureError
from toolkit.geometry import Floats, invert, make_pose
from toolkit.synthetic.photographs import arrange

SIZE, FOCAL = (768, 512), 690.0
MATRIX = np.array([[FOCAL, 0, 380.2], [0, FOCAL, 251.7], [0, 0, 1.0]])


def marks() -> Floats:
    """Return points (N, 3) of a wall at z = 8, x right, y down."""
    grid = np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-5, 6)), axis=-1).reshape(-1, 2)
    return np.column_stack([0.8 * grid, np.full(len(grid), 8.0)])


def write_scene(folder: Path, count: int) -> None:
    """Write photographs of a wall with a white disk at each of its marks, by cameras in a row."""
    for number in range(count):
        turn, _ = cv2.Rodrigues(np.array([0.02, 0.03 * number - 0.08, 0.01]))
        world_from_cam = make_pose(turn, (0.4 * number - 0.8, 0.1, 0.0))
        image = np.full((*SIZE[::-1], 3), 60, np.uint8)
        seen = (marks() - world_from_cam[:3, 3]) @ world_from_cam[:3, :3] @ MATRIX.T
        for x, y in seen[:, :2] / seen[:, 2:] - 0.5:
            cv2.circle(image, (round(16 * x), round(16 * y)), 16 * 5, (255, 255, 255), -1, cv2.LINE_AA, 4)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "images" / f"{number:04}.jpg"), image)
        rows = [*MATRIX, np.zeros(3), *world_from_cam[:3, :3], world_from_cam[:3, 3], np.array(SIZE)]
        text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows)
        (folder / "gt_dense_cameras").mkdir(exist_ok=True)
        (folder / "gt_dense_cameras" / f"{number:04}.jpg.camera").write_text(text + "\n")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    write_scene(root / "wall", 5)
    return root


@pytest.fixture(scope="module")
def arranged(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """The wall as captures, by whether queries are hard."""
    folder = tmp_path_factory.mktemp("arranged")
    return {hard: arrange(scene, folder / f"hard-{hard}", ("wall",), hard) for hard in (False, True)}


@pytest.mark.parametrize("hard", [False, True])
def test_pictures_are_where_poses_and_cameras_say(arranged: dict[bool, Path], hard: bool) -> None:
    capture = arranged[hard]
    assert [row for row in check_capture(capture, deep=True).problems if row.severity == "error"] == []
    for name, cameras in (("ios", 1), ("hl", 2), ("spot", 3)):
        frames = {"map": 2, "query": 3} if hard else {"map": 3, "query": 2}
        for split, count in frames.items():
            session = Session.open(capture / "sessions" / f"{name}_{split}")
            assert len(session) == cameras * count
            worst = []
            for row, pose in enumerate(session.world_from_cam(ground_truth=split == "query")):
                camera, image = session.cameras([row])[0], cv2.imread(str(session.image_path(row)), 0)
                assert image.shape == (camera.height, camera.width)
                inside = invert(pose) @ np.column_stack([marks(), np.ones(len(marks()))]).T
                xy = camera.img_from_cam(inside[:3].T)
                margin = 0.04 * camera.width
                size = np.array([camera.width, camera.height])
                here = xy[((xy > margin) & (xy < size - margin)).all(axis=1)]
                assert len(here) >= 3
                for x, y in here:  # the disk's center of light is the mark
                    half = int(margin) - 1
                    left, top = round(x - 0.5) - half, round(y - 0.5) - half
                    patch = image[top : top + 2 * half + 1, left : left + 2 * half + 1].astype(float)
                    light = np.clip(patch - (np.median(patch) + patch.max()) / 2, 0, None)
                    steps = np.arange(len(light))
                    at = np.stack([light.sum(axis=0) @ steps, light.sum(axis=1) @ steps]) / light.sum()
                    worst.append(np.abs(at + np.array([left + 0.5 - x, top + 0.5 - y])).max())
            assert np.median(worst) < (0.6 if hard and split == "query" else 0.15)


def test_the_same_seed_gives_the_same_bytes(scene: Path, arranged: dict[bool, Path], tmp_path: Path) -> None:
    first = arranged[True]
    subprocess.run(["diff", "-r", first, arrange(scene, tmp_path / "same", ("wall",), hard=True)], check=True)
    other = arrange(scene, tmp_path / "other", ("wall",), hard=True, seed=1)
    files = [sorted(folder.rglob("*.jpg")) for folder in (first, other)]
    assert [path.read_bytes() for path in files[0]] != [path.read_bytes() for path in files[1]]


@pytest.mark.parametrize(("asked", "broken", "out", "named"), [
    ("wal", "", "WALL", "wal.*Did you mean 'wall'"),
    ("wall", "gt_dense_cameras/0000.jpg.camera", "WALL", r"0000\.jpg\.camera"),
    ("wall", "images/0000.jpg", "WALL", r"0000\.jpg: no such image"),
    ("wall", "", "full", "full"),
])  # fmt: skip
def test_what_is_no_scene_is_refused(asked: str, broken: str, out: str, named: str, tmp_path: Path) -> None:
    write_scene(tmp_path / "scenes" / "wall", 1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    if broken.endswith(".camera"):
        (tmp_path / "scenes" / "wall" / broken).write_text("1 2 3\n")
    elif broken:
        (tmp_path / "scenes" / "wall" / broken).unlink()
    with pytest.raises(CaptureError, match=named):
        arrange(tmp_path / "scenes", tmp_path / out, (asked,))
    assert not (tmp_path / "WALL").exists()
