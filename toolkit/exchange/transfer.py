"""Fetch files over HTTP, and resume a file in the middle after a lost connection or a kill.

Archives of captures have tens of gigabytes, so a kill at 90 % must not restart the file. The available libraries do
restart it: huggingface_hub 2.4 fetches to a random file name that no later process finds
(`file_download._download_to_tmp_and_move`), and so does pooch 1.9 (`core.stream_download`). Therefore `Transfer.fetch`
fetches files from the hub and from plain servers by HTTP ranges. huggingface_hub lists the files of a dataset and knows
the token.
"""

import hashlib
import os
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.errors import DownloadError, first_line
from toolkit.exchange.archives import FileError

if TYPE_CHECKING:
    import requests

NETWORK = (
    "Check the network and, if they are set, HTTPS_PROXY, HF_ENDPOINT and HF_HUB_OFFLINE; then run the same command: "
    "it resumes the download."
)
_TIMEOUT_S = (20, 60)  # to connect; between two chunks
_WAITS_S = (1, 2, 4, 8, 16)  # between attempts that bring no more data; an attempt that brings some resets the sequence
_MAX_WAIT_S = 330  # the hub's rate limits count requests over five minutes
_CHUNK_BYTES = 1 << 18
_RANGE_BYTES = 32 << 30  # largest range per request: the hub's content network does not answer requests for 50 GB


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch."""

    path: str
    """Target path relative to the capture's folder, with `/`. An archive is unpacked into its parent folder."""
    url: str
    size: int | None
    """Bytes; None if the server does not say."""
    version: str
    """Identifies the version of the file: its checksum, `sha256:...` or `git:...`, else `etag:...` or `size:...` as
    the server reports it."""

    @property
    def is_archive(self) -> bool:
        return self.path.lower().endswith(".zip")

    def matches(self, local: Path) -> bool:
        """Return whether a local file has the checksum of this file; True if no checksum is known."""
        kind, _, expected = self.version.partition(":")
        if kind not in ("sha256", "git"):
            return True
        # git: SHA-1 of a header and the content, https://git-scm.com/book/en/v2/Git-Internals-Git-Objects
        header = b"blob %d\0" % local.stat().st_size
        with open(local, "rb") as stream:
            digest = hashlib.file_digest(stream, lambda: hashlib.sha1(header) if kind == "git" else hashlib.sha256())
        return digest.hexdigest() == expected


class _TryAgainError(Exception):
    """An attempt failed and may be repeated. Args: the reason; the seconds that the server asks to wait."""


class Transfer:
    """Fetch the files of one source. Threads may share it."""

    def __init__(self, headers: Mapping[str, str], access: str, advance: Callable[[int], object]) -> None:
        """
        Args:
            headers: sent with each request, such as the hub's token.
            access: for error messages: what the user can do if the server refuses access.
            advance: called with the number of bytes received; negative when a file restarts.
        """
        import requests

        self.stop = threading.Event()
        self._access, self._advance = access, advance
        self._session = requests.Session()
        # A compressed response could not be resumed in the middle.
        self._session.headers.update({**headers, "Accept-Encoding": "identity"})
        self._session.auth = lambda request: request  # otherwise ~/.netrc would replace the hub's token

    def describe(self, url: str) -> tuple[int | None, str]:
        """Return the size of a file in bytes (None if the server does not say) and its `RemoteFile.version`.

        Raises:
            DownloadError: the server does not answer or refuses.
        """
        import requests

        try:
            response = self._session.head(url, allow_redirects=True, timeout=_TIMEOUT_S)
        except requests.RequestException as error:
            raise DownloadError(f"{url}: no answer, {first_line(error)}.\n{NETWORK}") from error
        if response.status_code in (405, 501):  # the server does not support HEAD
            return None, "size:None"
        if not response.ok:
            raise DownloadError(f"{url}: HTTP {response.status_code}. {self._access}")
        size, tag = _full_size(response), response.headers.get("ETag") or response.headers.get("Last-Modified")
        return size, f"etag:{tag}" if tag else f"size:{size}"

    def fetch(self, file: RemoteFile, partial: Path, target: Path) -> None:
        """Fetch the missing bytes of a file to `partial`, verify the complete file, and move it to `target`.

        Raises:
            FileError: this file cannot be fetched or has a wrong size or checksum. Other files can still be fetched.
            DownloadError: the server refuses, the connection breaks repeatedly, or `stop` was set by the user or by an
                error that affects all files. `partial` stays.
        """
        partial.parent.mkdir(parents=True, exist_ok=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
        failures = most = 0  # attempts in a row that brought no more data than those before; largest size so far
        complete = False
        while not complete:
            most = max(most, partial.stat().st_size)
            try:
                complete = self._fetch_more(file, partial)
                failures = 0
            except _TryAgainError as again:
                reason, wait_s = again.args
                failures = 0 if partial.stat().st_size > most else failures + 1
                if failures > len(_WAITS_S):
                    raise DownloadError(
                        f"{file.path}: {file.url}: {reason}, {failures} times in a row.\n{NETWORK}"
                    ) from again
                if self.stop.wait(wait_s or _WAITS_S[max(failures, 1) - 1]):
                    raise DownloadError("The download was stopped.") from None
        if not file.matches(partial):
            partial.unlink()
            raise FileError(
                f"{file.path}: wrong checksum, expected {file.version}; the fetched data were deleted. Run the same "
                f"command again; if the error persists, the published file is damaged ({file.url})."
            )
        partial.replace(target)

    def _fetch_more(self, file: RemoteFile, partial: Path) -> bool:
        """Send one request for the missing bytes, at most `_RANGE_BYTES`; return whether the file is complete."""
        import requests

        have, size, headers = partial.stat().st_size, file.size, {}
        if have == size:
            return True
        if size is not None and have > size:
            os.truncate(partial, have := 0)
        if have or (size or 0) > _RANGE_BYTES:
            end = have + _RANGE_BYTES
            headers["Range"] = f"bytes={have}-{end - 1 if end < (size or 0) else ''}"
        try:
            with self._session.get(file.url, headers=headers, stream=True, timeout=_TIMEOUT_S) as response:
                self._require_usable(response, file, partial, have)
                size = size or _full_size(response)
                continues = response.status_code == 206
                self._advance(0 if continues else -have)  # some servers only send whole files
                with open(partial, "ab" if continues else "wb") as out:
                    for chunk in response.iter_content(_CHUNK_BYTES):
                        if self.stop.is_set():
                            raise DownloadError("The download was stopped.")
                        out.write(chunk)
                        self._advance(len(chunk))
        except requests.RequestException as error:  # an OSError too, but not one of the disk
            raise _TryAgainError(f"the connection broke ({first_line(error)})", 0) from error
        now = partial.stat().st_size
        if size is not None and now < size and now <= have:  # without this, a server that sends nothing loops forever
            raise _TryAgainError(f"the server sent {now} of {size} bytes", 0)
        return size is None or now == size

    def _require_usable(self, response: "requests.Response", file: RemoteFile, partial: Path, have: int) -> None:
        """Raise unless the response is the whole file or the range that starts at byte `have`."""
        status, size = response.status_code, _full_size(response)
        if status in (401, 403):
            raise DownloadError(f"{file.path}: access is refused (HTTP {status}). {self._access}")
        if status in (408, 429) or status >= 500:
            raise _TryAgainError(f"HTTP {status}", _requested_wait_s(response))
        begin = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("-")[0]
        if status == 416 or (status == 206 and begin != str(have)):
            os.truncate(partial, 0)
            raise _TryAgainError(f"the server does not send the missing range (HTTP {status})", 0)
        if not response.ok:
            raise FileError(f"{file.path}: HTTP {status} from {file.url}. {self._access}")
        if None not in (size, file.size) and size != file.size:
            raise FileError(
                f"{file.path}: the server has {size} bytes, expected {file.size} ({file.url}). Run the same command "
                "again; if the error persists, the published file is damaged."
            )


def _requested_wait_s(response: "requests.Response") -> float:
    """Return the wait in seconds from the header `Retry-After` or the hub's `RateLimit`; 0 if there is none."""
    seconds = re.fullmatch(r"(\d+)", response.headers.get("Retry-After", "").strip())
    seconds = seconds or re.search(r"\bt=(\d+)", response.headers.get("RateLimit", ""))
    return min(int(seconds[1]), _MAX_WAIT_S) if seconds else 0


def _full_size(response: "requests.Response") -> int | None:
    """Return the size in bytes of the whole file, also for a response with a range of it; None if not stated."""
    name = "Content-Range" if response.status_code == 206 else "Content-Length"
    text = response.headers.get(name, "").rpartition("/")[2]
    return int(text) if text.isdigit() and "Content-Encoding" not in response.headers else None
