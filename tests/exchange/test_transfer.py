"""One file over HTTP: what a part that is already here is worth, and what a server says of itself."""

import random
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.fake_hub import FakeHub, serving
from toolkit.errors import DownloadError
from toolkit.exchange import transfer as module
from toolkit.exchange.transfer import RemoteFile, Transfer

BODY = random.Random(0).randbytes(600_000)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    monkeypatch.setattr(module, "_WAITS_S", (0.0,))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving(FakeHub()) as hub:
        hub.plain["/a.zip"] = BODY
        yield hub


@pytest.fixture
def transfer() -> Transfer:
    return Transfer({}, "Ask the publishers.", lambda count: None)


@pytest.mark.parametrize("size", [len(BODY), None])
@pytest.mark.parametrize("partial", [BODY[:-1], BODY, BODY + b"more"])
def test_a_part_that_is_here_becomes_the_whole_file(
    server: FakeHub, transfer: Transfer, tmp_path: Path, partial: bytes, size: int | None
) -> None:
    (tmp_path / "part").write_bytes(partial)
    file = RemoteFile("a.zip", f"{server.url}/a.zip", size, "etag:x")
    transfer.fetch(file, tmp_path / "part", tmp_path / "a.zip")
    assert (tmp_path / "a.zip").read_bytes() == BODY
    assert not (tmp_path / "part").exists()
    if len(partial) < len(BODY):
        assert server.requests == [("GET", f"bytes={len(partial)}-")]


def test_a_download_that_is_stopped_keeps_its_part(server: FakeHub, tmp_path: Path) -> None:
    counts: list[int] = []
    transfer = Transfer({}, "", lambda count: (counts.append(count), transfer.stop.set() if count else None))
    file = RemoteFile("a.zip", f"{server.url}/a.zip", len(BODY), "etag:x")
    with pytest.raises(DownloadError):
        transfer.fetch(file, tmp_path / "part", tmp_path / "a.zip")
    assert (tmp_path / "part").read_bytes() == BODY[: sum(counts)] != b""
    assert not (tmp_path / "a.zip").exists()


def test_a_connection_may_break_any_number_of_times_if_each_brings_data(
    server: FakeHub, transfer: Transfer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_CHUNK_BYTES", 1000)
    server.cuts = list(range(10_000, len(BODY), 10_000))
    transfer.fetch(RemoteFile("a.zip", f"{server.url}/a.zip", len(BODY), "etag:x"), tmp_path / "part", tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == BODY
    assert len(server.requests) == 60


def test_a_server_without_ranges_that_always_breaks_is_not_asked_forever(
    server: FakeHub, transfer: Transfer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each attempt brings data, but never more than the first."""
    monkeypatch.setattr(module, "_CHUNK_BYTES", 1000)
    server.ranges, server.cuts = False, [20_000, 10_000] * 100
    with pytest.raises(DownloadError, match="2 times in a row"):
        transfer.fetch(RemoteFile("a.zip", f"{server.url}/a.zip", len(BODY), "etag:x"), tmp_path / "p", tmp_path / "a")
    assert len(server.requests) == 3


def test_size_and_version_of_a_file(server: FakeHub, transfer: Transfer) -> None:
    size, version = transfer.describe(f"{server.url}/a.zip")
    assert size == len(BODY)
    assert version.startswith("etag:")
    server.statuses["a.zip"] = [405]  # this server answers no HEAD
    assert transfer.describe(f"{server.url}/a.zip") == (None, "size:None")
    with pytest.raises(DownloadError, match=r"127\.0\.0\.1:9/a\.zip: .*\n.*HTTPS_PROXY"):
        transfer.describe("http://127.0.0.1:9/a.zip")  # the port for discarding: nobody listens


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        ({"Retry-After": "17"}, 17),
        ({"RateLimit": '"resolvers";r=0;t=123'}, 123),
        ({"Retry-After": "99999"}, 330),
        ({"Retry-After": "Wed, 21 Oct 2026 07:28:00 GMT"}, 0),
        ({}, 0),
    ],
)
def test_a_server_says_how_long_to_wait(headers: dict[str, str], seconds: int) -> None:
    assert module._requested_wait_s(SimpleNamespace(headers=headers)) == seconds  # type: ignore[arg-type]
