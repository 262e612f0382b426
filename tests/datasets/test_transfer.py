"""One file over HTTP: what a part that is already here is worth."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from tqdm import tqdm

from tests.fake_hub import FakeHub, serving, use_hub
from toolkit.datasets import download
from toolkit.datasets.download import RemoteFile

BODY = random.Random(0).randbytes(600_000)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeHub]:
    monkeypatch.setattr(download, "MAX_ATTEMPTS", 2)
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1000)
    with serving(FakeHub()) as hub:
        use_hub(monkeypatch, hub.url, tmp_path)
        hub.plain["/a.zip"] = BODY
        yield hub


def fetch_to(partial: Path, server: FakeHub) -> None:
    with tqdm(disable=True) as bar:
        RemoteFile("a.zip", f"{server.url}/a.zip", len(BODY), "etag:x").fetch(partial, {}, bar)


@pytest.mark.parametrize("partial", [b"", BODY[:-1], BODY, BODY + b"more"])
def test_a_part_that_is_here_becomes_the_whole_file(server: FakeHub, tmp_path: Path, partial: bytes) -> None:
    (tmp_path / "part").write_bytes(partial)
    fetch_to(tmp_path / "part", server)
    assert (tmp_path / "part").read_bytes() == BODY
    begin = len(partial) % len(BODY) if len(partial) < len(BODY) else 0
    expected = [] if partial == BODY else [("GET", f"bytes={begin}-{len(BODY) - 1}")]
    assert server.requests == expected


def test_a_connection_may_break_any_number_of_times_if_each_brings_data(server: FakeHub, tmp_path: Path) -> None:
    server.cuts = list(range(10_000, len(BODY), 10_000))
    fetch_to(tmp_path / "part", server)
    assert (tmp_path / "part").read_bytes() == BODY
    assert len(server.requests) == 60


def test_a_connection_that_brings_nothing_is_not_taken_up_forever(server: FakeHub, tmp_path: Path) -> None:
    server.cuts = [20_000, *[0] * 100]
    with pytest.raises(Exception, match="peer closed connection"):
        fetch_to(tmp_path / "part", server)
    assert (tmp_path / "part").read_bytes() == BODY[:20_000]


def test_a_connection_that_is_reset_is_taken_up_while_it_brings_data(
    server: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reset(url: str, out: BinaryIO, resume_size: int, **options: Any) -> None:
        out.write(BODY[resume_size : resume_size + 100_000])
        raise RuntimeError("reset by peer")  # in place of the HTTP client's error, which http_get does not catch

    monkeypatch.setattr("huggingface_hub.file_download.http_get", reset)
    fetch_to(tmp_path / "part", server)
    assert (tmp_path / "part").read_bytes() == BODY
