"""Fetch files over HTTP; a file whose download was cut off or killed goes on where it stopped.

Archives of captures are tens of gigabytes, so a kill at 90 % must not begin such a file anew. No library at hand keeps
that promise: huggingface_hub 2.4 fetches a file under a random name that no later process looks for
(`file_download._download_to_tmp_and_move`), and so does pooch 1.9 (`core.stream_download`). Therefore one function,
`Transfer.fetch`, fetches the files of the hub and of plain servers by HTTP ranges. huggingface_hub lists the files of a
dataset, and knows the token.
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
    "Check the network, and HTTPS_PROXY, HF_ENDPOINT and HF_HUB_OFFLINE where they are set, then run the same command: "
    "it goes on where it was."
)
_TIMEOUT_S = (20, 60)  # to connect, between two pieces
_WAITS_S = (1, 2, 4, 8, 16)  # between attempts that bring nothing; an attempt that brings something starts anew
_LONGEST_WAIT_S = 330  # the hub counts requests over five minutes
_MOST_WAITS = 50
_PIECE_BYTES = 1 << 18
_RANGE_BYTES = 32 << 30  # the most to ask for at once: networks in front of the hub answer no request for 50 GB


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch."""

    path: str
    """Where it belongs, relative to the capture's folder, with `/`; an archive unpacks in the folder of its path."""
    url: str
    size: int | None
    """Bytes; None where the server does not say."""
    version: str
    """Tells one version of the file from another: its checksum, `sha256:...` or `git:...`, or else what the server
    says of it: `etag:...`, `size:...`."""

    @property
    def is_archive(self) -> bool:
        return self.path.lower().endswith(".zip")

    def matches(self, local: Path) -> bool:
        """Tell whether a local file has the checksum of this file; True where no checksum is known."""
        kind, _, expected = self.version.partition(":")
        if kind not in ("sha256", "git"):
            return True
        # git: SHA-1 of a header and the content, https://git-scm.com/book/en/v2/Git-Internals-Git-Objects
        header = b"blob %d\0" % local.stat().st_size
        with open(local, "rb") as stream:
            digest = hashlib.file_digest(stream, lambda: hashlib.sha1(header) if kind == "git" else hashlib.sha256())
        return digest.hexdigest() == expected


class _TryAgainError(Exception):
    """An attempt failed, another may not: the reason, and the seconds that the server asks to wait."""


class Transfer:
    """Fetches the files of one source, from several threads at a time."""

    def __init__(self, headers: Mapping[str, str], access: str, advance: Callable[[int], object]) -> None:
        """
        Args:
            headers: to send with each request: the hub's token.
            access: what to do where the server refuses, for messages.
            advance: called with the number of bytes that have come; negative where a file starts again.
        """
        import requests

        self.stop = threading.Event()
        self._access, self._advance = access, advance
        self._session = requests.Session()
        # What is compressed on the way cannot be taken up in the middle.
        self._session.headers.update({**headers, "Accept-Encoding": "identity"})
        self._session.auth = lambda request: request  # else ~/.netrc would replace the hub's token

    def describe(self, url: str) -> tuple[int | None, str]:
        """Return the size of a file, None if the server does not say, and a text that tells its version.

        Raises:
            DownloadError: there is no answer, or the server refuses.
        """
        import requests

        try:
            response = self._session.head(url, allow_redirects=True, timeout=_TIMEOUT_S)
        except requests.RequestException as error:
            raise DownloadError(f"{url}: no answer, {first_line(error)}.\n{NETWORK}") from error
        if response.status_code in (405, 501):  # the server can only be asked for the whole file
            return None, "size:None"
        if not response.ok:
            raise DownloadError(f"{url}: HTTP {response.status_code}. {self._access}")
        size, tag = _full_size(response), response.headers.get("ETag") or response.headers.get("Last-Modified")
        return size, f"etag:{tag}" if tag else f"size:{size}"

    def fetch(self, file: RemoteFile, partial: Path, target: Path) -> None:
        """Fetch what is missing of a file to `partial`, verify the whole, and move it to `target`.

        Raises:
            FileError: this file cannot be had, or is not what was promised; others may be.
            DownloadError: the server refuses, the connection breaks again and again, or `stop` was set: because another
                file failed for all, or by the user. `partial` stays.
        """
        partial.parent.mkdir(parents=True, exist_ok=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
        in_vain = waits = 0
        whole = False
        while not whole:
            before = partial.stat().st_size
            try:
                whole = self._fetch_more(file, partial)
                in_vain = 0
            except _TryAgainError as again:
                reason, wait_s = again.args
                in_vain = 0 if partial.stat().st_size > before else in_vain + 1
                waits += 1
                if in_vain > len(_WAITS_S) or waits > _MOST_WAITS:
                    raise DownloadError(
                        f"{file.path}: {file.url}: {reason}, {in_vain} times in a row.\n{NETWORK}"
                    ) from again
                if self.stop.wait(wait_s or _WAITS_S[max(in_vain, 1) - 1]):
                    raise DownloadError("The download was stopped.") from None
        if not file.matches(partial):
            partial.unlink()
            raise FileError(
                f"{file.path}: wrong checksum, expected {file.version}; what was fetched has been "
                "deleted. Run the same command again; if this comes back, the file is damaged where it is published "
                f"({file.url})."
            )
        partial.replace(target)

    def _fetch_more(self, file: RemoteFile, partial: Path) -> bool:
        """Ask once for what is missing of a file, at most `_RANGE_BYTES`; return whether the file is whole."""
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
                    for piece in response.iter_content(_PIECE_BYTES):
                        if self.stop.is_set():
                            raise DownloadError("The download was stopped.")
                        out.write(piece)
                        self._advance(len(piece))
        except requests.RequestException as error:  # before OSError, of which it is one
            raise _TryAgainError(f"the connection broke ({first_line(error)})", 0) from error
        now = partial.stat().st_size
        if size is not None and now < size and now <= have:  # else a server that sends too little is asked for ever
            raise _TryAgainError(f"the server sent {now} of {size} bytes", 0)
        return size is None or now == size

    def _require_usable(self, response: "requests.Response", file: RemoteFile, partial: Path, have: int) -> None:
        """Raise unless the answer is the file, or the range of it that begins at `have` bytes."""
        status, size = response.status_code, _full_size(response)
        if status in (401, 403):
            raise DownloadError(f"{file.path}: access is refused (HTTP {status}). {self._access}")
        if status in (408, 429) or status >= 500:
            raise _TryAgainError(f"HTTP {status}", _requested_wait_s(response))
        begin = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("-")[0]
        if status == 416 or (status == 206 and begin != str(have)):
            os.truncate(partial, 0)
            raise _TryAgainError(f"the server does not send the range that is missing (HTTP {status})", 0)
        if not response.ok:
            raise FileError(f"{file.path}: HTTP {status} from {file.url}. {self._access}")
        if None not in (size, file.size) and size != file.size:
            raise FileError(
                f"{file.path}: the server has {size} bytes, expected {file.size} ({file.url}). Run the same command "
                "again; if this comes back, the file is damaged where it is published."
            )


def _requested_wait_s(response: "requests.Response") -> float:
    """Return the seconds that a server asks to wait, in `Retry-After` or the hub's `RateLimit`; 0 if it does not."""
    after = re.fullmatch(r"(\d+)", response.headers.get("Retry-After", "").strip())
    after = after or re.search(r"\bt=(\d+)", response.headers.get("RateLimit", ""))
    return min(int(after[1]), _LONGEST_WAIT_S) if after else 0


def _full_size(response: "requests.Response") -> int | None:
    """Return the size of the whole file that a response is of, or is a range of; None where it is not said."""
    name = "Content-Range" if response.status_code == 206 else "Content-Length"
    text = response.headers.get(name, "").rpartition("/")[2]
    return int(text) if text.isdigit() and "Content-Encoding" not in response.headers else None
