"""What all imports share: the report, importing again into a session, a kill while it is replaced."""

import ctypes
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from typer.testing import CliRunner

from toolkit import files
from toolkit.__main__ import app
from toolkit.capture import Capture
from toolkit.capture.check import check_capture
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.import_report import grouped, imports_text
from toolkit.exchange.interchange import import_images
from toolkit.geometry import make_pose, qt_from_pose

CAMERA, OTHER_CAMERA = "PINHOLE, 64, 48, 50, 51, 32, 24", "PINHOLE, 64, 48, 60, 61, 32, 24"


def photos(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (64, 48)).save(folder / name)
    return folder


def table(path: Path, *names: str) -> Path:
    poses = [make_pose(np.eye(3), [number, 0.1, 0.2]) for number in range(len(names))]
    values = [",".join(map(repr, qt_from_pose(pose).tolist())) for pose in poses]
    rows = map(",".join, zip(names, values, strict=True))
    path.write_text("\n".join(["image,qw,qx,qy,qz,tx,ty,tz", *rows]))
    return path


def texts(session: Path) -> dict[str, str]:
    return {path.relative_to(session).as_posix(): path.read_text() for path in session.rglob("*.txt")}


def test_up_of_images_that_look_straight_down_is_called_a_guess(tmp_path: Path) -> None:
    names = [f"{number}.jpg" for number in range(4)]
    poses = [f"{name},0,1,0,0,{number},0,80" for number, name in enumerate(names)]  # half a turn about x: along -z
    (tmp_path / "t.csv").write_text("\n".join(["image,qw,qx,qy,qz,tx,ty,tz", *poses]))
    command = ["import", "images", str(photos(tmp_path / "photos", *names)), str(tmp_path / "PLACE"), "--split", "map"]
    done = CliRunner().invoke(app, [*command, "--table", str(tmp_path / "t.csv"), "--camera", CAMERA, "--json"])
    assert json.loads(done.stdout)["ios_map"]["up"] == "(0.00, 0.00, 1.00), a guess: all look along -z"


def test_a_report_says_what_was_used_left_out_and_assumed(tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", "a.jpg", "b.jpg", "c.jpg", "d.jpg", "not_listed.jpg")
    PIL.Image.new("RGB", (32, 24)).save(folder / "b.jpg")
    listed = table(tmp_path / "t.csv", "a.jpg", "b.jpg", "c.jpg", "d.jpg", "gone.jpg")
    command = ["import", "images", str(folder), str(tmp_path / "PLACE"), "--split", "map", "--table", str(listed)]
    command += ["--camera", CAMERA, "--axes", "opengl", "--unit", "0.5", "--hold-out", "4"]
    done = CliRunner().invoke(app, [*command, "--json"])
    assert done.exit_code == 0, done.output
    records = json.loads(done.stdout)
    assert list(records) == ["ios_map", "ios_query"]
    for name, record in records.items():
        assert record == json.loads((tmp_path / "PLACE" / "sessions" / name / "proc" / "import.json").read_text())
    first, queries = records.values()
    assert (first["seen"], first["used"], queries["used"]) == (5, 2, 1)
    assert [(one["count"], one["first"]) for one in first["left out"]] == [
        (1, "b.jpg"), (1, "gone.jpg"), (1, "not_listed.jpg"),
    ]  # fmt: skip
    (camera,) = first["cameras"]
    assert (camera["images"], camera["focal_px"], camera["from"]) == (2, [50.5], "given by --camera")
    assert first["unit"] == "m"
    assert first["unit from"] == "--unit 0.5"
    assert "y up, z backward" in first["convention"]
    assert first["up"].startswith("(-0.00, 1.00" if first["up"].startswith("(-") else "(0.00, 1.00")
    assert first["seconds"] > 0
    text = CliRunner().invoke(app, [*command, "--replace"]).stdout
    shown = imports_text(Capture.open(tmp_path / "PLACE"))
    assert shown.replace(str(tmp_path), "") == text.strip().replace(str(tmp_path), "")
    assert "1  no such file (gone.jpg)" in text


def test_reasons_that_differ_in_numbers_are_one() -> None:
    rows = [(f"{k}.jpg", f"t.csv, line {k}: {k}.jpg has {k}.5e-3 meters") for k in range(3)]
    rows.append(("x.jpg", "no such file"))
    assert [(one["count"], one["first"]) for one in grouped(rows)] == [(3, "0.jpg"), (1, "x.jpg")]


@pytest.mark.parametrize(
    ("before", "placing", "linked"),
    [("link", "link", [True, True]), ("copy", "link", [False, False]), ("link", "copy", [True, False])],
)
def test_images_are_added_and_the_others_stay(before: str, placing: str, linked: list[bool], tmp_path: Path) -> None:
    first, more = photos(tmp_path / "first", "a.jpg", "b.jpg"), photos(tmp_path / "more", "b.jpg", "c.jpg", "d.jpg")
    listed = table(tmp_path / "1.csv", "a.jpg", "b.jpg")
    options: dict[str, Any] = {"split": "map", "placing": before}
    session = import_images(first, tmp_path / "PLACE", table=listed, camera=CAMERA, **options).session
    options["placing"] = placing
    (session / "proc" / "features").mkdir()
    (session / "proc" / "features" / "of_a.shard").write_bytes(b"made by a run")
    old = texts(session)
    listed = table(tmp_path / "2.csv", "b.jpg", "c.jpg", "d.jpg")
    report = import_images(more, tmp_path / "PLACE", table=listed, camera=OTHER_CAMERA, add=True, **options)
    assert (report.record["before"], report.record["used"]) == (2, 2)
    assert [(one["reason"], one["first"]) for one in report.record["left out"]] == [("in the session already", "b.jpg")]
    after = texts(session)
    assert all(after[name].startswith(old[name]) for name in old if name != "proc/links.txt")
    opened = Capture.open(tmp_path / "PLACE")["ios_map"]
    assert [Path(path).name for path in opened.images["path"]] == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert [opened.camera(sensor).params[0] for sensor in opened.images["sensor_id"]] == [50, 50, 60, 60]
    assert opened.world_from_cam()[:, 0, 3].tolist() == [0, 1, 1, 2]
    assert [opened.image_path(row).is_symlink() for row in (0, 3)] == linked
    assert (session / "proc" / "features" / "of_a.shard").read_bytes() == b"made by a run"
    assert check_capture(tmp_path / "PLACE").ok
    with pytest.raises(CaptureError, match="has all 3 images already"):
        import_images(more, tmp_path / "PLACE", table=listed, camera=CAMERA, add=True, **options)
    photos(more, "e.jpg")
    listed = table(tmp_path / "3.csv", "e.jpg")
    with pytest.raises(CaptureError, match="unit of its poses is m, that of the new ones unknown"):
        import_images(more, tmp_path / "PLACE", table=listed, camera=CAMERA, add=True, unit_m=None, **options)
    with pytest.raises(ManifestError, match="add: found together with"):
        import_images(more, tmp_path / "PLACE", camera=CAMERA, add=True, replace=True)
    assert texts(session) == after


def test_queries_are_added_to_a_session_that_is_missing_or_has_times(tmp_path: Path) -> None:
    for number, day in enumerate((1, 2)):
        exif = PIL.Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"2026:01:0{day} 10:00:00"
        (tmp_path / str(number)).mkdir()
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / str(number) / f"{number}.jpg", exif=exif)
        import_images(tmp_path / str(number), tmp_path / "PLACE", camera=CAMERA, add=True)
    session = Capture.open(tmp_path / "PLACE")["ios_query"]
    assert np.diff(session.images["timestamp"]).tolist() == [24 * 3600 * 10**6]
    assert len(session.keyframes()) == 2
    (tmp_path / "3").mkdir()
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "3" / "3.jpg")
    with pytest.raises(CaptureError, match=r"none of 1 images can be imported.*no focal length"):  # not "has all 0"
        import_images(tmp_path / "3", tmp_path / "PLACE", add=True)
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "1" / "same.jpg", exif=exif)
    import_images(tmp_path / "1", tmp_path / "PLACE", camera=CAMERA, add=True)  # at a time that is taken
    assert Capture.open(tmp_path / "PLACE")["ios_query"].images["timestamp"].is_unique


def test_a_session_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, other = photos(tmp_path / "1", "a.jpg"), photos(tmp_path / "2", "b.jpg", "c.jpg")
    session = import_images(first, tmp_path / "PLACE", camera=CAMERA).session
    before = texts(session)
    with pytest.raises(CaptureError, match=r"exists already. Give --replace"):
        import_images(other, tmp_path / "PLACE", camera=CAMERA)
    with pytest.raises(CaptureError, match="none of 2 images can be imported"):
        import_images(other, tmp_path / "PLACE", camera="PINHOLE, 60, 48, 50, 51, 32, 24", replace=True)
    monkeypatch.setattr(ctypes, "CDLL", lambda _: None)  # a system without renameat2
    move = Path.replace

    def stop(self: Path, target: Path) -> Path:
        if self.name == "ios_query" and self.parent.name.startswith("."):
            raise KeyboardInterrupt
        return move(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            import_images(other, tmp_path / "PLACE", camera=CAMERA, replace=True)
    assert texts(session) == before
    import_images(other, tmp_path / "PLACE", camera=CAMERA, replace=True)
    assert len(Capture.open(tmp_path / "PLACE")["ios_query"]) == 2
    # A kill between the two moves, on such a system: the next import finds the old folder.
    hidden = session.with_name(f".ios_query.999999999-{files._machine()}-abc.partial")
    hidden.mkdir()
    session.replace(hidden / "old")
    with pytest.raises(CaptureError, match="exists already"):
        import_images(first, tmp_path / "PLACE", camera=CAMERA)
    assert len(Capture.open(tmp_path / "PLACE")["ios_query"]) == 2
    assert [path.name for path in session.parent.iterdir()] == ["ios_query"]


@pytest.mark.slow
def test_a_kill_while_replacing_leaves_the_old_or_the_new(tmp_path: Path) -> None:
    photos(tmp_path / "0", "a.jpg")
    photos(tmp_path / "1", "b.jpg", "c.jpg")
    code = (
        "from toolkit.exchange.interchange import import_images\nimport itertools\n"
        f"for k in itertools.cycle('01'):\n import_images(k, 'PLACE', camera={CAMERA!r}, replace=True)\n"
    )
    session, seen = tmp_path / "PLACE" / "sessions" / "ios_query", set[int]()
    for wait_s in (0.05, 0.173, 0.311):
        process = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
        before = session.stat().st_ino if session.exists() else 0
        while not session.exists() or session.stat().st_ino == before:
            time.sleep(0.01)
        time.sleep(wait_s)
        process.send_signal(signal.SIGKILL)
        process.wait()
        seen.add(len(Capture.open(tmp_path / "PLACE")["ios_query"]))
        assert check_capture(tmp_path / "PLACE").problems == []
    assert seen <= {1, 2}
