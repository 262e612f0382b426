"""The folder of a capture and its sessions."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from itertools import product
from pathlib import Path

from toolkit.capture.devices import SPLITS, in_order, session_id, session_of
from toolkit.capture.names import require_name
from toolkit.capture.session import Session
from toolkit.errors import COMMAND, CaptureError
from toolkit.files import read_json

log = logging.getLogger(__name__)

IMPORT_RECORD = "proc/import.json"
"""What an import has noted in a session: the unit of its poses, `m` or null if unknown, and its inputs."""


class Capture:
    """A capture folder. A session is read at its first use."""

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        self.path = path.resolve() if path.name == ".." else path  # the folder's name is the scene's name
        if not self.path.is_dir():
            raise CaptureError(f"No such capture folder: {self.path}. Expected a folder that contains `sessions/`.")
        self._root = self.path / "sessions"
        if not self._root.is_dir():
            expected = f"{self.path.name}/sessions/<device>_<map|query>/images.txt"
            raise CaptureError(f"{self.path} is not a capture: it has no folder `sessions`. Expected {expected}.")
        require_name(self.name, "capture", self.path.parent)
        self._folders: dict[str, Path] = {}
        self.unreadable: dict[str, str] = {}
        """Why folders in `sessions` cannot be entered, by name."""
        for folder in sorted(self._root.iterdir()):
            name = session_id(folder.name)
            try:
                is_session = any((folder / file).exists() for file in ("sensors.txt", "images.txt"))
            except OSError as error:  # others go on
                log.warning("%s: left out: %s.", folder, error.strerror)
                self.unreadable[folder.name] = f"{folder}: {error.strerror}. Give yourself access to it, or move it."
                continue
            if is_session:
                require_name(folder.name, "session", self._root)
            if is_session and (name not in self._folders or folder.name == name):
                self._folders[name] = folder
        self.session_ids = sorted(self._folders)
        if not self.session_ids:
            found = "no folder in it has a sensors.txt or images.txt"
            raise CaptureError(f"{self._root} contains no session: {found}. Expected e.g. ios_map and hl_query.")
        self._sessions: dict[str, Session] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Capture":
        """Open a capture folder.

        Raises:
            CaptureError: the folder is missing, has no `sessions/`, or contains no session.
        """
        return cls(path)

    @classmethod
    def from_sessions_root(cls, sessions_root: str | Path) -> "Capture":
        """Open the capture of a given `sessions` folder."""
        root = Path(sessions_root).absolute()
        if root.name != "sessions":
            raise CaptureError(f"{root} is not the `sessions` folder of a capture; expected <capture>/sessions.")
        return cls(root.parent)

    @property
    def name(self) -> str:
        """Name of the folder, which is the name of the scene in all outputs."""
        return self.path.absolute().name

    @property
    def unit(self) -> str | None:
        """Unit of the map's poses: `m`, or None if the import of a map session has noted that it is unknown."""
        maps = [folder for folder in self._folders.values() if session_of(folder.name)[1] == "map"]
        units = [read_json(folder / IMPORT_RECORD).get("unit", "m") for folder in maps or self._folders.values()]
        return None if None in units else "m"

    def unit_of(self, setting: str | None) -> str | None:
        """Return the unit that a setting `unit` means: `m`, None if it is unknown, or for `auto` that of the import."""
        return self.unit if setting == "auto" else setting

    @property
    def devices(self) -> list[str]:
        """Keys of the devices that have a session."""
        sessions = (session_of(folder.name) for folder in self._folders.values())
        return in_order(device for device, split in sessions if split in SPLITS)

    def devices_with(self, split: str, device: str = "all") -> list[str]:
        """Return the devices that have a session of a split: all of them, or only the given one.

        Args:
            split: `map` or `query`.
            device: a device key, or `all` (also `auto`).

        Raises:
            CaptureError: no device has such a session, or the given one has none.
        """
        present = [key for key in self.devices if f"{key}_{split}" in self]
        if device in ("all", "auto") and present:
            return present
        if not present:
            expected = f"sessions/<device>_{split}, as made by `{COMMAND} import ... --split {split}`"
            alone = " Without queries, build the map: run MANIFEST --only map." if split == "query" else ""
            raise CaptureError(f"{self.path}: no {split} session. Expected {expected}.{alone}")
        if device not in present:
            known = f"Devices with one: {', '.join(present)} (or `all`)"
            raise CaptureError(f"No {split} session of device {device!r} in {self.path}. {known}.")
        return [device]

    def pairs(
        self, map_device: str = "all", query_device: str = "all", pairs: Iterable[Sequence[str]] | None = None
    ) -> list[tuple[str, str]]:
        """Return (map device, query device) of all pairs of devices as in `devices_with`, or else the given `pairs`."""
        if pairs is not None:
            return [(map_, query) for map_, query in pairs]
        return list(product(self.devices_with("map", map_device), self.devices_with("query", query_device)))

    def folder(self, session_id: str) -> Path:
        """Return the folder of a session."""
        return self._folders[session_id]

    def image_path(self, name: str) -> Path:
        """Return the file of an image by its name, as from `Session.image_name`.

        Raises:
            CaptureError: no session lists the image.
        """
        session = self[session_id(name.partition("/")[0])]
        row = session.row_of_name.get(name)
        if row is None:
            raise CaptureError(f"{session.path / 'images.txt'}: has no image {name!r}. Run its stages again.")
        return session.image_path(row)

    def __getitem__(self, session_id: str) -> Session:
        if session_id not in self.session_ids:
            known = ", ".join(self.session_ids)
            raise CaptureError(f"Capture {self.path} has no session {session_id!r}; known: {known}.")
        if session_id not in self._sessions:
            try:
                self._sessions[session_id] = Session.open(self._folders[session_id])
            except OSError as error:
                fault = f"{error.filename or 'a file'} cannot be read ({error.strerror})"
                raise CaptureError(f"{self._folders[session_id]}: {fault}.") from None
        return self._sessions[session_id]

    def usable(self, split: str) -> list[Session]:
        """Return the readable sessions of a split; log the others with the reason."""
        sessions = []
        for name in (name for name in self.session_ids if session_of(self._folders[name].name)[1] == split):
            try:
                sessions.append(self[name])
            except CaptureError as error:
                log.warning("%s is not used: %s", name, error)
        return sessions

    def _repr_html_(self) -> str:
        rows = "".join(f"<li>{escape(repr(session))}</li>" for split in SPLITS for session in self.usable(split))
        return f"<p><b>{escape(self.name)}</b>: {escape(str(self.path))}</p><ul>{rows}</ul>"

    def __contains__(self, session_id: object) -> bool:
        return session_id in self.session_ids

    def __iter__(self) -> Iterator[str]:
        return iter(self.session_ids)
