"""A hub on this machine: serves files as the Hugging Face hub and plain web servers do, or fails as told."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from time import sleep as _sleep  # which a test may switch off for the library
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

import pytest

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class FakeHub(ThreadingHTTPServer):
    """Serves one file of weights, datasets and plain files.

    What fails is told by its attributes; those of one file go by its path in the address.
    """

    daemon_threads = True

    def __init__(self, weights: str = "", body: bytes = b"") -> None:
        """Serve `body` under the address `weights`, besides what is put into `datasets` and `plain`."""
        super().__init__(("127.0.0.1", 0), _Handler)
        self.weights, self.whole_body = weights, body
        self.datasets: dict[str, dict[str, bytes]] = {}  # by repository, then by path
        self.plain: dict[str, bytes] = {}  # by path in the address: /lamar/CAB.zip
        self.healthy()

    def healthy(self) -> None:
        self.requests: list[tuple[str, str | None]] = []  # method, Range
        self.paths: list[str] = []  # that whole or parts of files were fetched from
        self.status = 200
        self.error_code = ""
        self.body = self.whole_body
        self.etag = hashlib.sha256(self.whole_body).hexdigest()
        self.cuts: list[int] = []  # bytes at which the next connections break off
        self.commit = COMMIT
        self.page_size = 1000  # files a page of a listing
        self.ranges = True  # whether parts of files can be had
        self.statuses: dict[str, list[int]] = {}  # answers to the next requests for a file, by the end of its path
        self.instead: dict[str, bytes] = {}  # other bytes than those that were promised, by the end of the path
        self.tokens: list[str | None] = []  # that came with the requests for files
        self.seconds_a_piece = 0.0  # of 64 kB

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def find(self, path: str) -> tuple[bytes, bool] | None:
        """Return the file at an address, and whether it is the hub's."""
        if path == self.weights:
            return self.body, True
        if path in self.plain:
            return self.plain[path], False
        for repository, files in self.datasets.items():
            for revision in ("main", self.commit):
                prefix = f"/datasets/{repository}/resolve/{revision}/"
                if path.startswith(prefix) and path.removeprefix(prefix) in files:
                    return files[path.removeprefix(prefix)], True
        return None


def is_large(path: str) -> bool:
    """Tell whether the hub keeps a file aside, known by its SHA-256, and not as text under version control."""
    return not path.endswith((".txt", ".md", ".gitattributes"))


def describe(path: str, content: bytes) -> dict[str, Any]:
    """Return a file's entry in the hub's listing."""
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    entry: dict[str, Any] = {"type": "file", "oid": blob, "size": len(content), "path": path}
    if is_large(path):
        entry["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
    return entry


class _Handler(BaseHTTPRequestHandler):
    server: FakeHub
    protocol_version = "HTTP/1.0"

    def do_HEAD(self) -> None:
        self._answer(head=True)

    def do_GET(self) -> None:
        self._answer(head=False)

    def _answer(self, head: bool) -> None:
        hub = self.server
        address = urlsplit(self.path)
        path = unquote(address.path)
        asked = self.headers.get("Range")
        # The hub's library asks it once a process for something else, too.
        if "/resolve/" in path or path in hub.plain or path.startswith("/api/datasets/"):
            hub.requests.append((self.command, asked))
        status = next((left.pop(0) for end, left in hub.statuses.items() if path.endswith(end) and left), hub.status)
        if status != 200:
            return self._fail(status)
        if path.startswith("/api/datasets/"):
            return self._api(path.removeprefix("/api/datasets/"), dict(parse_qsl(address.query)))
        found = hub.find(path)
        if found is None:
            return self._fail(404)
        content, is_hub = found
        body = next((other for end, other in hub.instead.items() if path.endswith(end)), content)
        etag = hub.etag if path == hub.weights else hashlib.sha256(content).hexdigest()
        if not head:
            hub.paths.append(path)
            hub.tokens.append(self.headers.get("Authorization"))
        asked = asked if hub.ranges else None
        first, _, last = asked.removeprefix("bytes=").partition("-") if asked else ("0", "", "")
        start, end = int(first), min(int(last) + 1, len(body)) if last else len(body)
        if asked and start >= len(body):
            return self._fail(416)
        self.send_response(206 if asked else 200)
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(body)}")
        self.send_header("Content-Length", str(end - start))
        if is_hub and hub.commit:
            self.send_header("X-Repo-Commit", hub.commit)
        if is_hub:
            self.send_header("X-Linked-Etag", f'"{etag}"')
            self.send_header("X-Linked-Size", str(len(body)))
        self.send_header("ETag", f'"{etag}"')
        self.send_header("Accept-Ranges", "bytes")
        self.end_headers()
        if not head:
            self._send(body[start : hub.cuts.pop(0) if hub.cuts else end])
        self.close_connection = True
        return None

    def _send(self, body: bytes) -> None:
        for begin in range(0, len(body), 1 << 16):
            self.wfile.write(body[begin : begin + (1 << 16)])
            if self.server.seconds_a_piece:
                self.wfile.flush()
                _sleep(self.server.seconds_a_piece)

    def _fail(self, status: int) -> None:
        self.send_response(status)
        self.send_header("Content-Length", "0")
        if self.server.error_code:
            self.send_header("X-Error-Code", self.server.error_code)
        self.end_headers()

    def _api(self, path: str, query: dict[str, str]) -> None:
        """Answer `<owner>/<name>/revision/<revision>` and `<owner>/<name>/tree/<revision>`, the latter in pages."""
        hub = self.server
        owner, name, kind, revision = path.split("/")
        repository = f"{owner}/{name}"
        if repository not in hub.datasets or revision not in ("main", hub.commit):
            return self._fail(404)
        headers = {}
        if kind == "revision":
            content: Any = {"id": repository, "sha": hub.commit, "private": False, "tags": []}
        else:
            entries = [describe(file, body) for file, body in sorted(hub.datasets[repository].items())]
            begin = int(query.get("cursor", "0"))
            content = entries[begin : begin + hub.page_size]
            if begin + hub.page_size < len(entries):
                following = f"{hub.url}/api/datasets/{path}?recursive=True&cursor={begin + hub.page_size}"
                headers["Link"] = f'<{following}>; rel="next"'
        body = json.dumps(content).encode()
        self.send_response(200)
        for header, value in {"Content-Type": "application/json", "Content-Length": str(len(body)), **headers}.items():
            self.send_header(header, value)
        self.end_headers()
        self.wfile.write(body)
        return None

    def log_message(self, *args: Any) -> None:
        pass


@contextmanager
def serving(hub: FakeHub) -> Iterator[FakeHub]:
    """Serve until the block ends."""
    with hub:
        thread = Thread(target=hub.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield hub
        hub.shutdown()
        thread.join()


def use_hub(monkeypatch: pytest.MonkeyPatch, url: str, tmp_path: Path) -> None:
    """Let the hub's library ask this address, with an empty cache and no token."""
    import huggingface_hub
    from huggingface_hub import constants

    # The library reads its environment when it is imported, so its constants are set here.
    monkeypatch.setattr(constants, "ENDPOINT", url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.setattr("time.sleep", lambda seconds: None)  # between the library's attempts
    huggingface_hub.close_session()
