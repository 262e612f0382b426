"""The manifest: what to run, on which captures, with which settings."""

import re
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from toolkit.capture.devices import TABLE
from toolkit.manifest.messages import nearest
from toolkit.manifest.settings import (
    Direction,
    EmbedSettings,
    EvaluateSettings,
    ExploreSettings,
    LocalizeSettings,
    Natural,
    Positive,
    RerankSettings,
    RetrieveSettings,
    SequenceSettings,
    Settings,
    Share,
    Unit,
    VisualizeSettings,
)

STAGES = ("explore", "embed", "retrieve", "rerank", "localize", "sequence", "evaluate", "visualize")
OPTIONAL = ("rerank", "sequence")
"""Stages that run only where the manifest has their section."""

DevicePair = Annotated[list[str], Field(min_length=2, max_length=2)]


class DemoData(Settings):
    """A rendered capture instead of a recorded one."""

    rooms: Positive = 2
    """Rooms to render."""
    frames: Annotated[int, Field(ge=2)] = 12
    """Frames a room and map session; queries have half."""
    seed: Natural = 0
    """Another seed, another place."""
    alike: bool = False
    """Whether the last room looks exactly as the first."""
    seconds: Natural = 0
    """Length of a query recording, with odometry also between pictures; 0: as long as its pictures take."""
    losses: Natural = 0
    """Losses of tracking in each query recording; need `seconds`."""
    gaps: Natural = 0
    """Times of 4 s without odometry in each query recording; need `seconds`."""
    radio: bool = False
    """Whether sessions have scans of WiFi and Bluetooth."""


class Tolerance(Settings):
    """What share may fail before a run that came to its end has the exit code 2."""

    images: Share = 0.0
    """Images that cannot be read."""
    queries: Share = 0.5
    """Queries without a pose: a hard query is a result; a majority of them, the sign of something wrong."""
    pairs: Share = 0.0
    """Pairs of devices that had to be left out."""


class ExtraDevice(Settings):
    """A further kind of device, or what is different about a known one."""

    key: Annotated[str, Field(pattern=r"^[a-z0-9-]+$")]
    """Its sessions are `<key>_map` and `<key>_query`."""
    label: str | None = None
    """For people."""
    color: Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")] | None = None
    """In figures, as #rrggbb."""
    sessions: dict[Literal["map", "query"], str] | None = None
    """Or: what the folders of its sessions are called, e.g. {query: query_drone}."""


class Source(Settings):
    """Where the data of one capture are: a dataset on the Hugging Face hub, or archives anywhere."""

    hub: Annotated[str, Field(pattern=r"^[\w.-]+/[\w.-]+$")] | None = None
    """Dataset on the hub, `owner/name`."""
    revision: str = "main"
    """Branch, tag or commit of it."""
    urls: list[Annotated[str, Field(pattern=r"^https?://[^/]+/.+")]] = []
    """Or: addresses of zip archives."""
    sha256: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = {}
    """Checksums of archives by file name; the hub knows those of its files."""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.hub is None) == (not self.urls):
            raise ValueError("a source has either `hub` (owner/name) or `urls` (a list), and not both")
        return self


class DatasetSettings(Settings):
    """Where the captures of this manifest can be had; `python -m toolkit download` reads it."""

    page: str
    """Where to read about the data, ask for access and accept terms."""
    license: str
    """License of the data."""
    citation: str = ""
    """What to cite."""
    into: Literal["", "sessions"] = ""
    """Folder of the capture that the root of a hub dataset is."""
    sessions: list[str] | dict[str, str]
    """Sessions to fetch; or, where an archive names them otherwise, {name here: name there}."""
    include: list[str] = []
    """Further files to fetch: patterns such as `registration/*` of paths in the capture; * also matches /."""
    sources: dict[str, Source]
    """For each capture's folder name, where its data are."""

    @property
    def session_names(self) -> dict[str, str]:
        """The name in the source of each session to fetch."""
        return self.sessions if isinstance(self.sessions, dict) else {name: name for name in self.sessions}

    @model_validator(mode="after")
    def _renames_archives_only(self) -> Self:
        if not self.sessions:
            raise ValueError("sessions is empty; expected names such as ios_map")
        keys = [kind.key for kind in TABLE]
        for name in self.session_names:
            if not re.fullmatch(f"({'|'.join(keys)})_(map|query)", name):
                raise ValueError(f"sessions: found {name!r}, expected <{', '.join(keys)}>_<map or query>")
        if isinstance(self.sessions, dict) and any(source.hub for source in self.sources.values()):
            raise ValueError("sessions gives new names, which works with archives (`urls`) only")
        return self


class Manifest(Settings):
    """What to run. Paths are relative to the manifest's folder; `~` and `$VARIABLES` are expanded."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the run folder; the manifest's file name when not given."""
    description: str = ""
    """A sentence for the report."""
    captures: list[str] = []
    """Capture folders, each with `sessions/` in it. The folder's name is the scene's name."""
    demo_data: DemoData | None = None
    """Or: a capture to render."""
    dataset: DatasetSettings | None = None
    """Where to get the captures from, if they can be downloaded."""
    allow_outside: bool = False
    """Take images that `..`, absolute paths or links put outside of their capture: for captures of your own."""
    output_root: str = "../runs"
    """Results go to <output_root>/<name>."""
    extra_devices: list[ExtraDevice] = []
    """Kinds of devices besides ios, hl and spot."""
    devices: Literal["auto"] | list[str] = "auto"
    """Devices to take part; auto: all that a capture has."""
    pairs: Literal["all"] | list[DevicePair] = "all"
    """[map device, query device] pairs; all: every map with every query session."""
    queries: str = "keyframes_pruned_subsampled"
    """List of keyframes to localize, from the query sessions' proc/; `all`: every device pose known."""
    seed: Natural = 0
    """The same seed gives the same poses."""
    world_up: Direction | None = None
    """Direction that is up in the captures' world; null: estimated from the map's cameras where it is needed."""
    tolerate_failed: Tolerance = Tolerance()
    """What may fail: the rest is done all the same, and the exit code tells."""
    unit: Unit = "m"
    """Unit of the captures' poses; null: not known. Limits are then relative to the depth of what a map shows."""
    explore: ExploreSettings = ExploreSettings()
    """What notebook 01 shows."""
    embed: EmbedSettings = EmbedSettings()
    """How images become global descriptors."""
    retrieve: RetrieveSettings = RetrieveSettings()
    """How references are found."""
    rerank: RerankSettings | None = None
    """Optional: the stage runs if the section is there, also without a key in it, or is `true`."""
    localize: LocalizeSettings = LocalizeSettings()
    """How poses are found."""
    sequence: SequenceSettings | None = None
    """Optional, as `rerank`: poses of whole recordings, for queries with odometry."""
    evaluate: EvaluateSettings = EvaluateSettings()
    """What is counted."""
    visualize: VisualizeSettings = VisualizeSettings()
    """What is drawn and recorded."""

    @field_validator(*OPTIONAL, mode="before")
    @classmethod
    def _a_switch(cls, section: Any) -> Any:
        """Take `rerank:` and `rerank: true` as a section without keys, and `false` as none."""
        return {} if section is None or section is True else None if section is False else section

    @model_validator(mode="after")
    def _enough_references(self) -> Self:
        given = "topk" in self.retrieve.model_fields_set
        if self.rerank is not None and given and self.rerank.topn > self.retrieve.topk:
            raise ValueError(
                f"rerank.topn is {self.rerank.topn}, but retrieve.topk finds only {self.retrieve.topk}: raise it, or "
                "leave it out"
            )
        return self

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if bool(self.captures) == (self.demo_data is not None):
            raise ValueError("give either `captures` (a list of folders) or `demo_data`, and not both")
        return self

    @model_validator(mode="after")
    def _known_devices(self) -> Self:
        known = [kind.key for kind in TABLE] + [device.key for device in self.extra_devices]
        devices = [] if self.devices == "auto" else self.devices
        pairs = [] if self.pairs == "all" else [key for pair in self.pairs for key in pair]
        for name, keys in (("devices", devices), ("pairs", pairs)):
            for key in keys:
                if key not in known:
                    raise ValueError(f"{name}: found {key!r}. {nearest(key, known)} `extra_devices` adds others")
        return self

    def stage(self, stage: str) -> Settings:
        """Return the settings of one stage, also of one that is off, with what the manifest says for all stages."""
        section: Settings = getattr(self, stage) or self.defaults(stage)
        known, update = type(section).model_fields, dict[str, Any]()
        for key in {"seed", "world_up", "unit"} & known.keys() & self.model_fields_set - section.model_fields_set:
            update[key] = getattr(self, key)
        if stage == "retrieve" and self.rerank is not None and "topk" not in section.model_fields_set:
            update["topk"] = self.rerank.topn
        return section.model_copy(update=update)

    @classmethod
    def defaults(cls, stage: str) -> Settings:
        """Return the settings of a stage of which nothing is said."""
        off: dict[str, Settings] = {"rerank": RerankSettings(), "sequence": SequenceSettings()}
        given: Settings = off.get(stage) or cls.model_fields[stage].default
        return given

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that run, in order."""
        return tuple(stage for stage in STAGES if getattr(self, stage) is not None)
