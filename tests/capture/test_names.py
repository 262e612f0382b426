"""Captures that try to write or to read outside, in as many ways as came to mind."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from toolkit import pipeline
from toolkit.capture import Capture, Session
from toolkit.capture.check import check_capture
from toolkit.capture.names import (
    ALLOW_OUTSIDE,
    LINKED_HERE,
    allow_outside,
    is_linked_here,
    outside_allowed,
    require_name,
)
from toolkit.datasets.download import arrange
from toolkit.embed import embed_sessions
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.interchange import import_images
from toolkit.features.stores import extract_session
from toolkit.manifest import load_manifest
from toolkit.prediction.depths import DepthMaps

CAMERA = "camera, PINHOLE, 64, 48, 50, 50, 32, 24"
QT = "1, 0, 0, 0, 0, 0, 0"
BAD = [
    *("..", ".", "../x", "../../../../x/evil", "a/../../x", "a/..", "a/../b", "..a/x", ".a/x", "a/.b", "./a", "a/./b"),
    *("/etc/passwd", "//a", "a//b", "a/", "/", "a\x00b", "a\tb", "a\x07b", "a\x1b[2Jb", "a\x7fb", "a\x85b"),
    *("a\u202eb", "a\u2028b", "a\u2029b", "a\u2066b", "a\u200fb"),
]
GOOD = [
    *("a", "a/b", "CON", "a.", "a b", "ä?", "a...", "a..b/c", "~", "$HOME", "-rf", "a\\..\\b", "日本/1.jpg"),
    "%2e%2e/x",
]


def session_of(root: Path, **files: str) -> Path:
    """Write `PLACE/sessions/ios_map` with one image, whose file is there; `files` replaces texts (`_` stands for /)."""
    folder = root / "PLACE" / "sessions" / "ios_map"
    texts = {"sensors": f"s/cam, , {CAMERA}\n", "images": "1, s/cam, s/1.png\n", "trajectories": f"1, s/cam, {QT}\n"}
    for name, text in (texts | files).items():
        path = folder / f"{name.replace('_', '/', 1)}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    picture(folder / "raw_data" / "s" / "1.png")
    return folder


def picture(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)).save(path)
    return path


def read_all(folder: Path) -> None:
    """Open a session, and name its files and its recordings as the stages do."""
    session = Session.open(folder)
    DepthMaps(session).of(0)
    _ = session.subsessions, session.subsession_of(), session.image_path(0)
    _ = [session.keyframes(name) for name in session.keyframe_files]


def errors_of(folder: Path) -> list[str]:
    return [str(problem) for problem in check_capture(folder.parents[1]).errors]


# ------------------------------------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("images", "1, s/cam, s/1.png\n2, s/cam, {}\n"),
        ("images", "1, s/cam, s/1.png\n2, {}, s/2.png\n"),
        ("depths", "1, s/cam, s/1.png\n2, s/cam, {}\n"),
        ("sensors", f"s/cam, , {CAMERA}\n{{}}, , {CAMERA}\n"),
        ("rigs", f"r, s/cam, {QT}\n{{}}, s/cam, {QT}\n"),
        ("trajectories", f"1, s/cam, {QT}\n2, {{}}, {QT}\n"),
        ("proc_subsessions", "s\n{}\n"),
        ("proc_keyframes_pruned", "1, s/cam\n2, {}\n"),
    ],
)
def test_a_name_that_could_leave_its_folder_is_refused_at_its_line(tmp_path: Path, file: str, text: str) -> None:
    path = f"{file.replace('_', '/', 1)}.txt"
    for name in BAD:
        folder = session_of(tmp_path, **{file: text.format(name)})
        found = ""
        try:
            read_all(folder)
        except CaptureError as error:
            found = str(error)
        assert f"{path}, line 2: found " in found, name
    first, line = text.splitlines(keepends=True)
    listed = errors_of(session_of(tmp_path, **{file: first + "".join(line.format(name) for name in BAD)}))
    for number, name in enumerate(BAD, 2):
        assert any(f"{path}:{number}: error: found " in problem for problem in listed), name


@pytest.mark.parametrize("name", GOOD)
def test_unusual_names_are_names(tmp_path: Path, name: str) -> None:
    folder = session_of(tmp_path, images=f"1, s/cam, {name}\n", proc_subsessions=f"{name}\n")
    read_all(folder)
    assert Session.open(folder).subsessions == [name]


parts = st.sampled_from(["..", ".", "", "a", "~", " ", "\u202e", "..a"]) | st.text(max_size=4)


@settings(derandomize=True, deadline=None, database=None)
@given(st.lists(parts, min_size=1, max_size=4).map("/".join))
def test_an_accepted_name_stays_below_its_folder(name: str) -> None:
    try:
        require_name(name, "subsession", "here")
    except CaptureError:
        return
    out = "/run/SCENE/embeddings/ios_map"
    path = os.path.normpath(f"{out}/{name}/{Path(name).name}.npy")
    assert path.startswith(f"{out}/")


def test_nothing_is_written_outside_of_the_run(tmp_path: Path) -> None:
    """A recording called `../../../../../x/evil`, with sensors to match."""
    evil = "../../../../../x/evil"
    folder = session_of(
        tmp_path / "captures", sensors=f"{evil}/cam, , {CAMERA}\n", images=f"1, {evil}/cam, s/1.png\n",
        trajectories=f"1, {evil}/cam, {QT}\n", proc_subsessions=f"{evil}\n",
    )  # fmt: skip
    out = tmp_path / "runs" / "a" / "b" / "c" / "embeddings"
    with pytest.raises(CaptureError, match=r"sensors\.txt, line 1"):
        embed_sessions(folder.parent, out)
    assert not (tmp_path / "runs").exists()


def test_names_too_long_for_files_are_refused(tmp_path: Path) -> None:
    name = "ä" * 101  # 202 bytes, of which outputs need 240
    for file, folder in (
        ("subsessions", session_of(tmp_path / "1", proc_subsessions=f"{name}\n")),
        ("images", session_of(tmp_path / "2", images=f"1, s/cam, {name}/1.png\n")),
    ):
        with pytest.raises(CaptureError, match=rf"{file}\.txt: the subsession .* more than 200 bytes"):
            read_all(folder)
    assert any("too long for files" in line for line in errors_of(tmp_path / "1" / "PLACE" / "sessions" / "ios_map"))
    folder = session_of(tmp_path / "3", images=f"1, s/cam, s/{'x' * 300}.png\n")
    store = extract_session(Session.open(folder), tmp_path / "features", progress=False)
    assert "File name too long" in next(iter(store.failed.values()))


@pytest.mark.parametrize(("kind", "name"), [
    *(("capture", name) for name in (".hidden", "line\nbreak", "\u202egnp", "x" * 101, "\udcff")),
    *(("session", name) for name in (".ios_map", "a\tb_map", "x" * 41 + "_map")),
])  # fmt: skip
def test_the_folder_of_a_capture_and_of_a_session_has_a_name(tmp_path: Path, kind: str, name: str) -> None:
    folder = session_of(tmp_path)
    if kind == "session":
        shutil.copytree(folder, folder.with_name(name))
    else:
        shutil.move(folder.parents[1], tmp_path / name)
    with pytest.raises(CaptureError, match=rf"(found )?the {kind} '"):
        Capture.open(tmp_path / ("PLACE" if kind == "session" else name))


def test_dots_are_no_name_of_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = session_of(tmp_path)
    monkeypatch.chdir(folder)
    assert Capture.open("../..").name == "PLACE"
    assert Capture.from_sessions_root(folder / ".." / ".." / "sessions").name == "PLACE"


def test_a_scene_does_not_take_the_place_of_a_run_s_own_files(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("captures: [data/notebooks]\n")
    with pytest.raises(ManifestError, match=r"captures: found a folder called 'notebooks'"):
        load_manifest(tmp_path / "m.yaml")


def test_a_downloaded_session_moves_no_folder_of_others(tmp_path: Path) -> None:
    folder = session_of(tmp_path, proc_subsessions="ios_a\nios_a/../../../../../mine\n")
    (folder / "raw_data" / "ios_a").mkdir()
    (tmp_path / "mine").mkdir()
    with pytest.raises(CaptureError, match="subsessions"):
        arrange(folder.parent, {"ios_query": "ios_map", "hl_query": "ios_map"})
    assert (tmp_path / "mine").is_dir()


# ------------------------------------------------------------------------------------------------ links


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A picture outside of the capture, and a session of one image, `s/1.png`, that is not there yet."""
    folder = session_of(tmp_path)
    (folder / "raw_data" / "s" / "1.png").unlink()
    return picture(tmp_path / "home" / "s" / "1.png")


def link(path: Path, target: Path | str) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


LINKS = {
    "a file": lambda raw, home: link(raw / "s" / "1.png", home / "s" / "1.png"),
    "a relative link": lambda raw, _: link(raw / "s" / "1.png", "../../../../../home/s/1.png"),
    "a link of a link": lambda raw, home: (link(raw / "x", home / "s" / "1.png"), link(raw / "s" / "1.png", "../x")),
    "a folder": lambda raw, home: link(raw / "s", home / "s"),
    "raw_data": lambda raw, home: link(raw, home),
    "a folder by links": lambda raw, home: (link(raw / "t", home), link(raw / "s", "t/s")),
    "by a link to the root": lambda raw, home: (link(raw / "r", "/"), link(raw / "s", f"r{home}/s")),
}


@pytest.mark.parametrize("way", LINKS)
def test_a_link_out_of_the_capture_is_refused_with_its_line(tmp_path: Path, secret: Path, way: str) -> None:
    folder = tmp_path / "PLACE" / "sessions" / "ios_map"
    LINKS[way](folder / "raw_data", secret.parents[1])
    assert folder.joinpath("raw_data/s/1.png").read_bytes() == secret.read_bytes()
    session = Session.open(folder)
    told = r"images\.txt, line 1: raw_data/s/1\.png is a link to .*/home/s/1\.png.*allow_outside: true"
    for read in (lambda: session.image_path(0), lambda: extract_session(session, tmp_path / "features")):
        with pytest.raises(CaptureError, match=told):
            read()
    assert any("images.txt:1: error: raw_data/s/1.png is a link to" in line for line in errors_of(folder))
    with allow_outside():
        assert errors_of(folder) == []
        assert len(extract_session(Session.open(folder), tmp_path / "features", progress=False).failed) == 0


def test_depth_maps_and_texts_are_not_read_outside_either(tmp_path: Path) -> None:
    folder = session_of(tmp_path, depths="1, s/cam, s/d.png\n")
    link(folder / "raw_data" / "s" / "d.png", picture(tmp_path / "home" / "d.png"))
    (tmp_path / "passwd").write_text("root:x:0:0\n")
    for named in (r"depths\.txt, line 1: raw_data/s/d\.png is a link to", r"rigs\.txt: is a link to "):
        with pytest.raises(CaptureError, match=named) as caught:
            DepthMaps(Session.open(folder)).of(0)
        assert "root:x" not in str(caught.value)
        if "depths" in named:
            (folder / "rigs.txt").symlink_to(tmp_path / "passwd")
    assert any("rigs.txt: is a link to" in line for line in errors_of(folder))


def test_links_within_the_capture_and_to_its_disk_are_followed(tmp_path: Path) -> None:
    folder = session_of(tmp_path)
    shutil.copytree(folder, folder.with_name("ios_query"))
    link(folder.with_name("ios_query") / "raw_data", "../ios_map/raw_data")  # another session's images
    for disk in ("disk", "disk2"):  # first the session, then all sessions lie on another disk
        (tmp_path / disk).mkdir()
    shutil.move(folder, tmp_path / "disk" / "ios_map")
    link(folder, tmp_path / "disk" / "ios_map")
    Session.open(folder).image_path(0).read_bytes()
    folder.unlink()
    shutil.move(tmp_path / "disk" / "ios_map", folder)
    shutil.move(folder.parent, tmp_path / "disk2" / "sessions")
    link(folder.parent, tmp_path / "disk2" / "sessions")
    capture = Capture.open(tmp_path / "PLACE")
    for name in capture:
        capture[name].image_path(0).read_bytes()
    assert check_capture(tmp_path / "PLACE").errors == []


@pytest.mark.parametrize("path", ["../../../../home/s/1.png", "{home}/s/1.png", "s/../../../../../home/s/1.png"])
def test_paths_that_lead_out_are_allowed_only_on_request(tmp_path: Path, secret: Path, path: str) -> None:
    path = path.format(home=secret.parents[1])
    folder = session_of(tmp_path, images=f"1, s/cam, {path}\n")
    with pytest.raises(CaptureError, match=r"images\.txt, line 1: .*allow_outside: true"):
        Session.open(folder)
    out = tmp_path / "runs" / "m" / "embeddings"
    with allow_outside():
        table = embed_sessions(folder.parent, out)
    assert table[["subsession", "embedded"]].to_numpy().tolist() == [["ios_map", 1]]
    assert sorted(path.name for path in (out / "ios_map" / "ios_map").iterdir()) == [
        "ios_map.npy", "ios_map.npy.meta.json", "manifest.csv",
    ]  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {"PLACE", "home", "runs"}


def test_a_manifest_allows_it_for_its_run_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(pipeline, "_run", lambda *_: seen.append(outside_allowed()))
    for text in ("", "allow_outside: true\n"):
        (tmp_path / "m.yaml").write_text(f"captures: [a]\n{text}")
        pipeline.run(tmp_path / "m.yaml")
    assert seen == [False, True]
    assert not outside_allowed()
    monkeypatch.setenv(ALLOW_OUTSIDE, "1")
    pipeline.run(tmp_path / "m.yaml")
    assert outside_allowed(), "what the user has set stays set"


def test_links_that_import_made_are_the_user_s_own(tmp_path: Path) -> None:
    picture(tmp_path / "photos" / "1.png")
    folder = import_images(tmp_path / "photos", tmp_path / "PLACE", camera="PINHOLE, 64, 48, 50, 50, 32, 24").session
    assert Session.open(folder).image_path(0).is_symlink()
    assert errors_of(folder) == []
    (tmp_path / "PLACE").rename(tmp_path / "MOVED")
    moved = tmp_path / "MOVED" / "sessions" / folder.name
    assert Session.open(moved).image_path(0).is_symlink()
    shutil.copytree(moved, folder, symlinks=True)  # as an archive from elsewhere is, with all that it says
    assert (folder / LINKED_HERE).is_file()
    with pytest.raises(CaptureError, match=r"images\.txt, line 2: .* is a link to .*photos/1\.png"):
        Session.open(folder).image_path(0)


@pytest.mark.parametrize("what", ["pipe", "device", "link", "folder", "no inode"])
def test_a_note_of_links_is_neither_waited_for_nor_read_without_end(tmp_path: Path, what: str) -> None:
    folder = session_of(tmp_path)
    note = folder / LINKED_HERE
    note.parent.mkdir(exist_ok=True)
    if what == "pipe":
        os.mkfifo(note)
    elif what == "folder":
        note.mkdir()
    elif what == "no inode":
        note.write_text("9" * 5000)
    else:
        (tmp_path / "number").write_text(str(folder.stat().st_ino))
        note.symlink_to("/dev/zero" if what == "device" else tmp_path / "number")
    assert not is_linked_here(folder)
    assert len(Session.open(folder)) == 1
