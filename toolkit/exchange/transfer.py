"""Fetch files from the hub and from plain servers, and resume a file in the middle after a kill.

`hf_hub_download` of huggingface_hub 2.4 and `retrieve` of pooch 1.9 would restart an archive of tens of gigabytes: they
fetch to a random name that no later process finds. `http_get`, which `hf_hub_download` is made of, appends to the file
that it is given, resumes when a connection breaks, and waits as long as a busy server asks.
"""

import hashlib
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.models.hub import status_of

WHOLE = {"Accept-Encoding": "identity"}  # for each request: a compressed response could not be resumed in the middle
_ATTEMPTS = 6  # in a row that bring no data, besides those of http_get
_RANGE_BYTES = 32 << 30  # largest range per request: the hub's content network does not answer requests for 50 GB


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch."""

    path: str
    """Target path relative to the capture's folder, with `/`. An archive is unpacked into its parent folder."""
    url: str
    size: int
    version: str
    """Identifies the version of the file: its checksum, `sha256:...` or `git:...`, else `etag:...` of the server."""

    @property
    def is_archive(self) -> bool:
        return self.path.lower().endswith(".zip")

    def matches(self, local: Path) -> bool:
        """Return whether a local file has the size of this file, and its checksum if that is known."""
        if not local.is_file() or local.stat().st_size != self.size:
            return False
        kind, _, expected = self.version.partition(":")
        # git: SHA-1 of a header and the content, https://git-scm.com/book/en/v2/Git-Internals-Git-Objects
        digests = {"sha256": hashlib.sha256, "git": lambda: hashlib.sha1(b"blob %d\0" % self.size)}
        with open(local, "rb") as stream:
            return kind not in digests or hashlib.file_digest(stream, digests[kind]).hexdigest() == expected


def fetch(file: RemoteFile, partial: Path, headers: Mapping[str, str], bar: Any) -> None:
    """Fetch the missing bytes of a file to `partial`, which may hold the first ones already, and advance a tqdm bar.

    Raises:
        Exception: an error of the disk, of huggingface_hub, or of its HTTP client; `partial` stays.
    """
    from huggingface_hub.file_download import http_get

    partial.touch()
    failures = 0
    while True:
        before = partial.stat().st_size
        try:
            with open(partial, "ab") as out:
                if before > file.size:
                    out.truncate(0)
                while (have := out.seek(0, os.SEEK_END)) < file.size:
                    end = min(have + _RANGE_BYTES, file.size)
                    asked = {**headers, **WHOLE, "Range": f"bytes=0-{end - 1}"}  # http_get adds `have`
                    http_get(file.url, out, resume_size=have, headers=asked, expected_size=end, _tqdm_bar=bar)
            return
        except Exception as error:  # the type for a connection that broke depends on the HTTP client's version
            failures = 1 if partial.stat().st_size > before else failures + 1
            is_of_the_machine = isinstance(error, ConnectionError) or getattr(error, "errno", None) is not None
            if failures == _ATTEMPTS or is_of_the_machine or (status_of(error) or 500) < 500:
                raise
            time.sleep(2**failures)
