"""Downloads from a hub on this machine, with every failure that a network, a disk, a server or an archive may have."""

import errno
import io
import json
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from tests.fake_hub import FakeHub, serving, use_hub
from toolkit import pipeline
from toolkit.capture import Capture
from toolkit.datasets import download as archives
from toolkit.datasets import download as module
from toolkit.datasets.download import arrange, download, is_unfinished, unpack
from toolkit.errors import COMMAND, CaptureError, DownloadError, ManifestError, sentence

REPOSITORY = Path(__file__).resolve().parents[2]
REPO = "Someone/PLACE-challenge-test"
IMAGE = random.Random(0).randbytes(700_000)
Files = dict[str, bytes]

MANIFEST = f"""
captures: [captures/PLACE]
dataset:
  page: https://example.org/place
  license: to be looked at only
  citation: A. Uthor, A Place
  into: sessions
  sessions: [ios_map, ios_query]
  sources:
    PLACE: {{hub: {REPO}}}
"""


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeHub]:
    """A hub on this machine in place of the real one."""
    monkeypatch.setattr(module, "MAX_ATTEMPTS", 3)
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1 << 18)  # only whole chunks are kept
    with serving(FakeHub()) as server:
        use_hub(monkeypatch, server.url, tmp_path)
        server.datasets[REPO] = published()
        yield server


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    path = tmp_path / "place.yaml"
    path.write_text(MANIFEST)
    return path


def session(name: str, device: str = "ios") -> Files:
    """Return the files of a session of one image."""
    sensor, image = f"{device}_1/cam", f"{device}_1/images/1.jpg"
    camera = "camera, PINHOLE, 9, 9, 9, 9, 4, 4"
    return {
        f"{name}/sensors.txt": f"# sensor_id, name, sensor_type\n{sensor}, c, {camera}\n".encode(),
        f"{name}/images.txt": f"# timestamp, sensor_id, image_path\n1, {sensor}, {image}\n".encode(),
        f"{name}/trajectories.txt": f"# timestamp, device_id\n1, {sensor}, 1, 0, 0, 0, 0, 0, 0\n".encode(),
        f"{name}/proc/subsessions.txt": f"{device}_1\n".encode(),
        f"{name}/raw_data/{image}": IMAGE,
    }


def capture_files() -> Files:
    """Return what a whole download is: paths below sessions/."""
    return session("ios_map") | session("ios_query")


def zipped(files: Files) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for path, content in files.items():
            archive.writestr(path, content)
    return stream.getvalue()


def published() -> Files:
    """Return the same as a hub dataset: one session as text and an archive of its images, one as an archive."""
    files = capture_files()
    inside = {path.removeprefix("ios_map/"): body for path, body in files.items() if path.startswith("ios_map/raw")}
    loose = {path: body for path, body in files.items() if path.startswith("ios_map/") and path.endswith(".txt")}
    query = {path: body for path, body in files.items() if path.startswith("ios_query/")}
    others = {"README.md": b"hello", ".gitattributes": b"*.zip", "navvis/images.txt": b"", "navvis/mesh.ply": IMAGE}
    return loose | others | {"ios_map/raw_data.zip": zipped(inside), "ios_query.zip": zipped(query)}


def found(folder: Path) -> Files:
    """Return all files of a capture but the record of its download, by their path below sessions/."""
    sessions = folder / "captures" / "PLACE" / "sessions"
    return {
        path.relative_to(sessions).as_posix(): path.read_bytes() for path in sessions.rglob("*") if path.is_file()
    }


def failure(manifest: Path, **options: Any) -> str:
    with pytest.raises(DownloadError) as caught:
        download(manifest, **options)
    return str(caught.value)


def assert_recovers(hub: FakeHub, manifest: Path) -> None:
    hub.healthy()
    download(manifest)
    assert found(manifest.parent) == capture_files()
    assert not is_unfinished(manifest.parent / "captures" / "PLACE")


# As it should be


def test_a_capture_is_fetched_unpacked_and_checked(
    hub: FakeHub, manifest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hub.page_size = 3  # so that the listing has several pages
    (report,) = download(manifest)
    assert found(manifest.parent) == capture_files()
    assert report.tables.keys() == {"ios_map", "ios_query"}
    text, bar = capsys.readouterr()
    for part in (REPO, "commit 0123456", "to be looked at only", "A. Uthor, A Place", "6 files", "errors"):
        assert part in text
    assert "100%" in bar
    assert not any(path.suffix == ".zip" for path in (manifest.parent / "captures").rglob("*"))
    hub.paths.clear()
    download(manifest)
    assert hub.paths == [], "what is there is not fetched again"


def test_some_sessions_now_the_others_later(hub: FakeHub, manifest: Path) -> None:
    download(manifest, ["ios_query"])
    assert found(manifest.parent) == session("ios_query")
    assert [path.rpartition("/")[2] for path in hub.paths] == ["ios_query.zip"]
    hub.paths.clear()
    download(manifest)
    assert found(manifest.parent) == capture_files()
    assert not any("ios_query" in path for path in hub.paths)


def test_a_session_that_was_deleted_is_fetched_again(hub: FakeHub, manifest: Path) -> None:
    download(manifest)
    shutil.rmtree(manifest.parent / "captures/PLACE/sessions/ios_query")
    (manifest.parent / "captures/PLACE/sessions/ios_map/images.txt").unlink()
    hub.paths.clear()
    assert_recovers(hub, manifest)
    assert sorted(path.rpartition("/")[2] for path in hub.paths) == ["images.txt", "ios_query.zip"]


def test_files_that_are_published_anew_are_fetched_anew(hub: FakeHub, manifest: Path) -> None:
    download(manifest)
    hub.datasets[REPO]["ios_map/sensors.txt"] += b"# more\n"
    hub.paths.clear()
    download(manifest)
    assert found(manifest.parent)["ios_map/sensors.txt"].endswith(b"# more\n")
    assert len(hub.paths) == 1


def test_files_that_came_by_other_means_are_looked_at_and_kept(hub: FakeHub, manifest: Path) -> None:
    folder = manifest.parent / "captures/PLACE/sessions/ios_map"
    folder.mkdir(parents=True)
    right, wrong = folder / "images.txt", folder / "sensors.txt"
    right.write_bytes(capture_files()["ios_map/images.txt"])
    wrong.write_bytes(bytes(len(capture_files()["ios_map/sensors.txt"])))
    download(manifest)
    assert found(manifest.parent) == capture_files()
    assert not any(path.endswith("/ios_map/images.txt") for path in hub.paths)


def test_a_dry_run_lists_and_writes_nothing(
    hub: FakeHub, manifest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert download(manifest, dry_run=True) == []
    lines = capsys.readouterr().out.splitlines()
    size = len(hub.datasets[REPO]["ios_query.zip"])
    assert f"     {size / 1000:.1f} KB  sessions/ios_query.zip" in lines
    assert hub.paths == []
    assert not (manifest.parent / "captures").exists()


def test_further_files_by_pattern(hub: FakeHub, manifest: Path) -> None:
    download(manifest, overrides=["dataset.include=[sessions/navvis/*.ply]"])
    assert found(manifest.parent) == capture_files() | {"navvis/mesh.ply": IMAGE}


def test_a_full_release_is_a_capture_folder(hub: FakeHub, manifest: Path) -> None:
    files = {f"sessions/{path}": body for path, body in hub.datasets[REPO].items()}
    hub.datasets[REPO] = files | {"registration/x.h5": IMAGE, "PLACE_phone.txt": b"1"}
    download(manifest, overrides=["dataset.into=''"])
    assert found(manifest.parent) == capture_files()


def test_the_token_goes_to_the_hub_alone(hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_made_up")
    (manifest.parent / "netrc").write_text("machine 127.0.0.1 login me password secret\n")
    monkeypatch.setenv("NETRC", str(manifest.parent / "netrc"))
    download(manifest)
    assert set(hub.tokens) == {"Bearer hf_made_up"}
    hub.healthy()
    hub.plain["/place/PLACE.zip"] = zipped({f"PLACE/sessions/{path}": body for path, body in capture_files().items()})
    elsewhere = f"dataset.sources.PLACE={{hub: null, urls: ['{hub.url}/place/PLACE.zip']}}"
    shutil.rmtree(manifest.parent / "captures")
    download(manifest, overrides=[elsewhere])
    assert found(manifest.parent) == capture_files()
    assert set(hub.tokens) == {None}


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("sessions/ios_map/images.txt", True),
        ("sessions/ios_map/raw_data.zip", True),
        ("sessions/ios_map.zip", True),
        ("sessions/ios_map_raw_data.ZIP", True),
        ("sessions/ios_map.images.zip", True),
        ("sessions/ios_maps.zip", False),
        ("sessions/ios_map.md", False),
        ("PLACE_phone.txt", False),
        ("registration/ios_map/x.h5", False),
    ],
)
def test_the_files_of_a_session(path: str, expected: bool) -> None:
    assert module._is_of(path, "ios_map") == expected


# The server says no


@pytest.mark.parametrize(
    ("status", "code", "says"),
    [
        (404, "RepoNotFound", "404 Client Error. Repository Not Found"),
        (401, "RepoNotFound", "401 Client Error. Repository Not Found"),
        (403, "GatedRepo", "403 Client Error. Cannot access gated repo"),
        (401, "GatedRepo", "401 Client Error. Cannot access gated repo"),
        (404, "RevisionNotFound", "404 Client Error. Revision Not Found"),
    ],
)
def test_the_hub_refuses(hub: FakeHub, manifest: Path, status: int, code: str, says: str) -> None:
    hub.status, hub.error_code = status, code
    message = failure(manifest)
    page = f"https://huggingface.co/datasets/{REPO}"
    for part in (says, REPO, page, "accept its license", "hf auth login", "example.org/place"):
        assert part in message
    assert not (manifest.parent / "captures").exists()
    assert_recovers(hub, manifest)


def test_a_gated_dataset_can_be_listed_but_not_fetched(hub: FakeHub, manifest: Path) -> None:
    hub.statuses["images.txt"] = [403]
    message = failure(manifest)
    assert "403 Forbidden" in message
    assert f"https://huggingface.co/datasets/{REPO}" in message
    assert_recovers(hub, manifest)


def test_no_network(hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with monkeypatch.context() as patch:
        use_hub(patch, "http://127.0.0.1:9", tmp_path)  # the port for discarding: nobody listens
        message = failure(manifest)
        assert "Check the network" in message
        assert "http://127.0.0.1:9" in message
    from huggingface_hub import close_session, constants

    close_session()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert "unset the `HF_HUB_OFFLINE`" in failure(manifest)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    assert_recovers(hub, manifest)


def test_one_file_that_is_missing_ends_nothing(hub: FakeHub, manifest: Path) -> None:
    hub.statuses["ios_map/images.txt"] = [404]
    hub.statuses["ios_query.zip"] = [404]
    message = failure(manifest)
    assert "2 of 6 files failed; the others are there" in message
    place = manifest.parent / "captures/PLACE/sessions/ios_map/images.txt"
    assert f"put it at {place}" in message
    assert "404 Not Found" in message
    assert "ios_map/sensors.txt" in found(manifest.parent)
    assert "ios_map/raw_data/ios_1/images/1.jpg" in found(manifest.parent)
    assert_recovers(hub, manifest)


def test_a_server_that_is_busy_is_asked_again(hub: FakeHub, manifest: Path) -> None:
    hub.statuses["ios_query.zip"] = [503, 429, 408, 500]
    download(manifest)
    assert found(manifest.parent) == capture_files()
    shutil.rmtree(manifest.parent / "captures")
    hub.statuses["ios_query.zip"] = [503] * 100
    assert "503 Service Unavailable" in failure(manifest)
    assert_recovers(hub, manifest)


@pytest.mark.parametrize("status", [401, 404])
def test_archives_elsewhere_that_are_not_open_to_all(hub: FakeHub, manifest: Path, status: int) -> None:
    hub.plain["/place/PLACE.zip"] = b""
    hub.statuses["PLACE.zip"] = [status]
    message = failure(manifest, overrides=[f"dataset.sources.PLACE={{hub: null, urls: ['{hub.url}/place/PLACE.zip']}}"])
    assert f"'{status} " in message
    assert "https://example.org/place" in message
    assert "`dataset.sources.PLACE`" in message


def test_nothing_there_for_these_sessions(hub: FakeHub, manifest: Path) -> None:
    message = failure(manifest, overrides=["dataset.sessions=[spot_map]"])
    assert "has no file for spot_map" in message
    assert "sessions/ios_map, sessions/ios_query.zip" in message
    message = failure(manifest, overrides=["dataset.sessions=[spot_map, ios_query]"])
    assert "there is no session spot_map in it; found ios_query" in message


def test_what_fails_of_one_capture_does_not_end_the_others(hub: FakeHub, manifest: Path) -> None:
    manifest.write_text(
        MANIFEST.replace("[captures/PLACE]", "[captures/OTHER, captures/PLACE]") + "    OTHER: {hub: Someone/OTHER}\n"
    )
    hub.datasets["Someone/OTHER"] = {name: body for name, body in published().items() if "ios_map" in name}
    message = failure(manifest)
    assert "dataset Someone/OTHER" in message
    assert "there is no session ios_query in it; found ios_map." in message
    assert found(manifest.parent) == capture_files()


# The transfer fails


def asked(hub: FakeHub) -> list[str]:
    """Return the beginnings of the ranges that were asked for."""
    return [range_.partition("-")[0] + "-" for _, range_ in hub.requests if range_]


def test_a_connection_that_always_breaks_is_taken_up_by_the_next_run(hub: FakeHub, manifest: Path) -> None:
    hub.cuts = [400_000, *[0] * 100]
    message = failure(manifest, sessions=["ios_query"])
    assert "run the same command" in message
    assert is_unfinished(manifest.parent / "captures/PLACE")
    hub.healthy()
    download(manifest, ["ios_query"])
    assert found(manifest.parent) == session("ios_query")
    assert asked(hub) == ["bytes=262144-"], "whole pieces are kept"
    assert len(hub.paths) == 1


def test_what_another_run_has_begun_stays_unfinished(hub: FakeHub, manifest: Path) -> None:
    hub.cuts = [400_000, *[0] * 100]
    failure(manifest, sessions=["ios_query"])
    hub.healthy()
    download(manifest, ["ios_map"])
    assert is_unfinished(manifest.parent / "captures/PLACE")
    hub.healthy()
    download(manifest, ["ios_query"])
    assert not is_unfinished(manifest.parent / "captures/PLACE")
    assert asked(hub) == ["bytes=262144-"]


def test_parts_of_another_version_are_not_put_together(hub: FakeHub, manifest: Path) -> None:
    hub.cuts = [400_000, *[0] * 100]
    failure(manifest, sessions=["ios_query"])
    hub.healthy()
    files = {path: body[::-1] if path.endswith(".jpg") else body for path, body in session("ios_query").items()}
    hub.datasets[REPO]["ios_query.zip"] = zipped(files)
    download(manifest, ["ios_query"])
    assert found(manifest.parent) == files
    assert asked(hub) == ["bytes=0-"]


def test_a_large_file_is_asked_for_in_parts(
    hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_RANGE_BYTES", 300_000)
    download(manifest, ["ios_query"])
    assert found(manifest.parent) == session("ios_query")
    assert asked(hub) == ["bytes=0-", "bytes=300000-", "bytes=600000-"]


@pytest.mark.parametrize("name", ["ios_map/images.txt", "ios_query.zip"])  # by SHA-1 as git has it, by SHA-256
def test_wrong_bytes_are_not_kept(hub: FakeHub, manifest: Path, name: str) -> None:
    right = hub.datasets[REPO][name]
    hub.instead[name] = right[:-1] + b"?"
    assert f"sessions/{name}: wrong checksum, expected " in failure(manifest)
    assert not any(path.startswith(name.removesuffix(".zip")) for path in found(manifest.parent))
    assert_recovers(hub, manifest)


def test_a_file_that_is_shorter_than_listed(hub: FakeHub, manifest: Path) -> None:
    hub.instead["ios_query.zip"] = hub.datasets[REPO]["ios_query.zip"][:700_000]
    assert "sessions/ios_query.zip" in failure(manifest)
    assert_recovers(hub, manifest)


def test_another_download_into_the_same_folder(hub: FakeHub, manifest: Path) -> None:
    state = manifest.parent / "captures/PLACE/.download"
    state.mkdir(parents=True)
    with FileLock(state / "lock"):
        assert "another download into this folder is running" in failure(manifest)
    assert_recovers(hub, manifest)


# A kill


@pytest.mark.slow
def test_a_download_that_is_killed_goes_on(hub: FakeHub, manifest: Path, tmp_path: Path) -> None:
    big = {path: IMAGE * 40 if path.endswith(".jpg") else body for path, body in session("ios_query").items()}
    hub.datasets[REPO]["ios_query.zip"] = zipped(big)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("HF_", "HUGGINGFACE_"))}
    environment |= {"HF_HOME": str(tmp_path / "home"), "HF_ENDPOINT": hub.url, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "toolkit", "download", str(manifest)]
    state = manifest.parent / "captures/PLACE/.download"

    def fetched() -> int:
        sizes = [0]
        for path in state.glob("partial/*"):
            with suppress(FileNotFoundError):  # it was complete, and has its place now
                sizes.append(path.stat().st_size)
        return max(sizes)

    hub.seconds_a_piece = 0.01
    with open(tmp_path / "log", "wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            end = time.monotonic() + 100
            # The archive of the map comes first, and is smaller than what is waited for.
            while fetched() < 1_000_000 and process.poll() is None and time.monotonic() < end:
                pass
            assert process.poll() is None, (tmp_path / "log").read_text()
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
    before = fetched()
    assert 1_000_000 <= before < 28_000_000
    assert is_unfinished(manifest.parent / "captures/PLACE")
    with pytest.raises(ManifestError, match=rf"{COMMAND} download .*place\.yaml"):
        pipeline.run(manifest)
    hub.healthy()
    download(manifest)
    assert found(manifest.parent) == session("ios_map") | big
    assert asked(hub) == [f"bytes={before}-"]
    assert len(hub.paths) == 1


def test_an_archive_is_put_in_place_again_after_a_kill(
    hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(aside: Path, folder: Path, **options: Any) -> None:
        (folder / "sessions/ios_query").mkdir(parents=True)
        (aside / "sessions/ios_query/images.txt").rename(folder / "sessions/ios_query/images.txt")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copytree", dies)
        with pytest.raises(KeyboardInterrupt):
            download(manifest, ["ios_query"])
    hub.paths.clear()
    download(manifest, ["ios_query"])
    assert found(manifest.parent) == session("ios_query")
    assert hub.paths == []


def test_a_torn_record_costs_nothing(hub: FakeHub, manifest: Path) -> None:
    download(manifest, ["ios_map"])
    record = manifest.parent / "captures/PLACE/.download/done.jsonl"
    record.write_bytes(record.read_bytes()[:-7])
    hub.healthy()
    download(manifest)
    assert found(manifest.parent) == capture_files()
    hub.healthy()
    download(manifest)
    assert hub.paths == []


# The disk


def test_a_disk_that_is_too_small_is_seen_before(
    hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_200_000))
        message = failure(manifest)  # two archives, and one of them unpacked
        assert "about 2.1 MB are needed" in message
        assert "1.2 MB are free" in message
        assert hub.paths == []
        assert not (manifest.parent / "captures").exists()
    assert_recovers(hub, manifest)


def test_a_disk_that_fills_up(hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere")

    with monkeypatch.context() as patch:
        patch.setattr("huggingface_hub.file_download.http_get", full)
        with pytest.raises(OSError, match="somewhere") as caught:
            download(manifest)
    assert sentence(caught.value).startswith("The disk is full: somewhere cannot be written")
    assert_recovers(hub, manifest)


def test_a_folder_that_cannot_be_made(hub: FakeHub, manifest: Path) -> None:
    (manifest.parent / "captures").write_text("in the way")
    with pytest.raises(OSError, match="captures") as caught:
        download(manifest)
    assert "choose another folder" in sentence(caught.value)


# Archives


def keep_all(path: str) -> str:
    return path


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    "name",
    ["../evil", "a/../../evil", "/evil", "\\evil", "..\\evil", "C:\\evil", "c:evil", "a/..", "//evil"],
)
def test_paths_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.zip").write_bytes(zipped({"good": b"1", name: b"2"}))
    for place in (keep_all, lambda path: None):
        with pytest.raises(DownloadError, match=r"x\.zip: "):
            unpack(tmp_path / "a.zip", tmp_path / "out", place, "x.zip")
    assert [path.name for path in tmp_path.rglob("*")] == ["a.zip"]


def test_links_are_refused_unless_left_out(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(link("door"), "/etc")
        archive.writestr("door/passwd", b"2")
    with pytest.raises(DownloadError, match="'door'"):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")
    assert not (tmp_path / "out").exists()
    unpack(tmp_path / "a.zip", tmp_path / "out", lambda path: "x" if path == "door/passwd" else None, "x.zip")
    assert (tmp_path / "out/x").read_bytes() == b"2"


def test_two_members_of_one_path_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(zipped({"a//b": b"1", "a/b": b"2"}))
    with pytest.raises(DownloadError, match="a/b"):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")
    (tmp_path / "b.zip").write_bytes(zipped({"a": b"1", "a/b": b"2"}))
    with pytest.raises(DownloadError, match=r"x\.zip: .*/new/a"):
        unpack(tmp_path / "b.zip", tmp_path / "new", keep_all, "x.zip")


def test_encrypted_archives_are_refused(tmp_path: Path) -> None:
    content = bytearray(zipped({"a": b"1"}))
    content[content.index(b"PK\x01\x02") + 8] |= 1  # general purpose bit 0, in the directory
    content[6] |= 1
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(DownloadError, match="'a'"):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")


@pytest.mark.parametrize("harm", ["torn", "bit", "other"])
def test_damaged_archives_are_refused(tmp_path: Path, harm: str) -> None:
    content = bytearray(zipped({"a": IMAGE, "b": IMAGE}))
    content[900_000] ^= 1
    bodies = {"torn": content[:-30], "bit": content, "other": b"<html>Please sign in</html>"}
    (tmp_path / "a.zip").write_bytes(bodies[harm])
    with pytest.raises(DownloadError, match=r"x\.zip: cannot be unpacked: BadZipFile"):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(50_000_000))
    assert (tmp_path / "a.zip").stat().st_size < 100_000
    monkeypatch.setattr(archives.shutil, "disk_usage", lambda path: SimpleNamespace(free=20_000_000))
    with pytest.raises(DownloadError, match=r"51\.0 MB.* 20\.0 MB"):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")
    assert not (tmp_path / "out/zeros").exists()


def test_a_member_that_is_longer_than_it_says_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(50_000_000))
    content = bytearray((tmp_path / "a.zip").read_bytes())
    at = content.index(b"PK\x01\x02") + 24  # the size in the directory
    content[at : at + 4] = (1000).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(DownloadError, match=r"x\.zip: "):
        unpack(tmp_path / "a.zip", tmp_path / "out", keep_all, "x.zip")
    assert (tmp_path / "out/zeros").stat().st_size <= 1000


def test_an_archive_of_the_hub_that_leads_out(hub: FakeHub, manifest: Path) -> None:
    hub.datasets[REPO]["ios_query.zip"] = zipped(session("ios_query") | {"../../../evil": b"1"})
    message = failure(manifest)
    assert "1 of 6 files failed" in message
    assert "outside the target folder" in message
    assert not any("ios_query" in path or "evil" in path for path in found(manifest.parent))
    assert not list(manifest.parent.rglob("evil"))


def test_a_listing_that_leads_out(hub: FakeHub, manifest: Path) -> None:
    hub.datasets[REPO]["ios_map/../../../../evil.txt"] = b"1"
    assert "outside the target folder" in failure(manifest)
    assert hub.paths == []


def test_a_damaged_archive_elsewhere_is_fetched_again(hub: FakeHub, manifest: Path) -> None:
    right = zipped({f"sessions/{path}": body for path, body in capture_files().items()})
    hub.plain["/PLACE.zip"] = right[:-30] + bytes(30)
    options = [f"dataset.sources.PLACE={{hub: null, urls: ['{hub.url}/PLACE.zip']}}"]
    assert "PLACE.zip: cannot be unpacked: BadZipFile" in failure(manifest, overrides=options)
    hub.plain["/PLACE.zip"] = right
    download(manifest, overrides=options)
    assert found(manifest.parent) == capture_files()
    shutil.rmtree(manifest.parent / "captures")
    options += [f"dataset.sources.PLACE.sha256={{PLACE.zip: '{'0' * 64}'}}"]
    assert "wrong checksum, expected sha256:0000" in failure(manifest, overrides=options)


# LaMAR


def lamar(device: str, session_name: str) -> Files:
    return {f"CAB/sessions/{path}": body for path, body in session(session_name, device).items()}


def lamar_archive() -> Files:
    """Return LaMAR's layout: a map of both devices, and queries of each, in `queries.txt`."""
    phone, headset = lamar("ios", "map"), lamar("hl", "map")
    both = {path: phone[path] + headset[path].rpartition(b"#")[2] for path in phone.keys() & headset.keys()}
    for path in both:
        rows = headset[path].decode().splitlines()
        both[path] = phone[path] + "".join(f"{row}\n" for row in rows if not row.startswith("#")).encode()
    both["CAB/sessions/map/proc/subsessions.txt"] += b"navvis_1\n"
    queries = {
        f"CAB/sessions/query_val_{name}/queries.txt": f"1, {device}_1/cam\n".encode()
        for name, device in (("phone", "ios"), ("hololens", "hl"))
    }
    return (
        phone
        | headset
        | both
        | lamar("ios", "query_val_phone")
        | lamar("hl", "query_val_hololens")
        | lamar("ios", "query_phone")
        | queries
    )


def test_lamar_is_brought_into_the_capture_format(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CAPTURES", str(tmp_path / "captures"))
    hub.plain["/lamar/benchmark/CAB.zip"] = zipped(lamar_archive())
    address = f"dataset.sources.CAB.urls=['{hub.url}/lamar/benchmark/CAB.zip']"
    path = REPOSITORY / "data_manifests" / "lamar-cab.yaml"
    download(path, overrides=[address])
    lines = capsys.readouterr().out.splitlines()
    assert any("left out of map: 1 subsessions of other devices, such as navvis_1" in line for line in lines)
    capture = Capture.open(tmp_path / "captures" / "CAB")
    assert capture.session_ids == ["hl_map", "hl_query", "ios_map", "ios_query"]
    for name in capture:
        device = name.partition("_")[0]
        assert list(capture[name].images["sensor_id"]) == [f"{device}_1/cam"]
        assert list(capture[name].sensors["sensor_id"]) == [f"{device}_1/cam"]
        assert list(capture[name].trajectory.device_ids) == [f"{device}_1/cam"]
        assert capture[name].subsessions == [f"{device}_1"]
        assert capture[name].image_path(0).read_bytes() == IMAGE
    assert list(capture["hl_query"].keyframes("keyframes_original")["device_id"]) == ["hl_1/cam"]
    assert "ios_1" not in (tmp_path / "captures/CAB/sessions/hl_map/images.txt").read_text()
    hub.paths.clear()
    download(path, overrides=[address])
    assert hub.paths == []


def test_one_device_of_lamar_after_the_other(hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAPTURES", str(tmp_path / "captures"))
    hub.plain["/CAB.zip"] = zipped(lamar_archive())
    address = f"dataset.sources.CAB.urls=['{hub.url}/CAB.zip']"
    path = REPOSITORY / "data_manifests" / "lamar-cab.yaml"
    download(path, ["hl_map"], overrides=[address])
    assert Capture.open(tmp_path / "captures" / "CAB").session_ids == ["hl_map"]
    download(path, ["hl_query", "ios_map", "ios_query"], overrides=[address])
    hub.paths.clear()
    download(path, overrides=[address])
    assert hub.paths == [], "what is there is not fetched again"
    shutil.rmtree(tmp_path / "captures/CAB/sessions/hl_map")
    download(path, ["ios_map"], overrides=[address])
    assert hub.paths == [], "nor because of what was deleted and is not asked for"
    download(path, overrides=[address])
    assert hub.paths == ["/CAB.zip"]


def test_a_device_that_is_not_in_the_map(tmp_path: Path) -> None:
    for path, body in session("map").items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(body)
    with pytest.raises(CaptureError, match=r"map: found ios_1, expected subsessions named hl_"):
        arrange(tmp_path, {"ios_map": "map", "hl_map": "map"})


# Manifests and runs


def test_a_manifest_without_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("captures: [here]")
    with pytest.raises(ManifestError, match=r"mine\.yaml: .*`dataset`"):
        download(tmp_path / "mine.yaml")


def test_sessions_and_captures_have_to_be_known(manifest: Path) -> None:
    with pytest.raises(ManifestError, match=r"--sessions: .*'ios_mop'.*'ios_map'"):
        download(manifest, ["ios_mop"])
    with pytest.raises(ManifestError, match=r"dataset\.sources"):
        download(manifest, overrides=["captures=[PLAZA]"])


def test_a_run_says_what_to_download(manifest: Path) -> None:
    with pytest.raises(ManifestError, match=r"visloc download .*place"):
        pipeline.run(manifest)


def test_the_command_line(
    hub: FakeHub, manifest: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from typer.testing import CliRunner

    from toolkit.__main__ import app, main

    result = CliRunner().invoke(app, ["download", str(manifest), "--sessions", "ios_map, ios_query", "--dry-run"])
    assert result.exit_code == 0, result.output
    assert "sessions/ios_query.zip" in result.output
    hub.datasets[REPO]["ios_map/images.txt"] = b"1, ios_1/cam, ios_1/images/nowhere.jpg\n"
    result = CliRunner().invoke(app, ["download", str(manifest)])
    assert found(manifest.parent).keys() == capture_files().keys()
    assert result.exit_code == 1, "the check has found an error"
    assert "ios_map/images.txt" in result.output

    def interrupted(*args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "download", interrupted)
    monkeypatch.setattr("sys.argv", ["toolkit", "download", str(manifest)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert "goes on from here" in capsys.readouterr().err


def hub_of(capture: Path) -> Files:
    """Return a capture as the hub may have it: text files as they are, the images of each session in an archive."""
    sessions = capture / "sessions"
    files = {path.relative_to(sessions).as_posix(): path for path in sessions.rglob("*") if path.is_file()}
    names = {name.partition("/")[0] for name in files}
    published = {name: path.read_bytes() for name, path in files.items() if "/raw_data/" not in name}
    for session_name in names:
        prefix = f"{session_name}/"
        raw = {name.removeprefix(prefix): path.read_bytes() for name, path in files.items() if "/raw_data/" in name}
        published[f"{prefix}raw_data.zip"] = zipped(
            {name: body for name, body in raw.items() if f"{prefix}{name}" in files and name.startswith("raw_data/")}
        )
    return published


@pytest.mark.slow
def test_the_challenge_is_downloaded_and_opens(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_capture: Path
) -> None:
    monkeypatch.setenv("CAPTURES", str(tmp_path / "captures"))
    for scene in ("HYDRO", "SUCCULENT"):
        hub.datasets[f"CroCoDL/{scene}-challenge-test"] = hub_of(small_capture)
    reports = download(REPOSITORY / "data_manifests" / "crocodl-challenge.yaml")
    assert [report.problems for report in reports] == [[], []]
    for scene in ("HYDRO", "SUCCULENT"):
        capture = Capture.open(tmp_path / "captures" / scene)
        assert capture.session_ids == Capture.open(small_capture).session_ids
        for path in (small_capture / "sessions").rglob("*"):
            if path.is_file():
                same = capture.path / "sessions" / path.relative_to(small_capture / "sessions")
                assert same.read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_downloaded_capture_runs(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_capture: Path
) -> None:
    monkeypatch.setenv("CAPTURES", str(tmp_path / "captures"))
    hub.datasets["CroCoDL/ARCHE_D2"] = {f"sessions/{path}": body for path, body in hub_of(small_capture).items()}
    path = REPOSITORY / "data_manifests" / "crocodl-arche-d2.yaml"
    download(path)
    run_dir = pipeline.run(path, only="embed", overrides=[f"output_root={tmp_path / 'runs'}"])
    assert json.loads((run_dir / "run.json").read_text())["status"] == "done"
    vectors = [np.load(file) for file in (run_dir / "ARCHE_D2" / "embeddings").rglob("*.npy")]
    capture = Capture.open(small_capture)
    assert sum(map(len, vectors)) == sum(len(capture[name].camera_rows) for name in capture)
    assert {array.dtype for array in vectors} == {np.dtype("float16")}
