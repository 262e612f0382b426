"""The manifest: what to run, on which captures, with which settings."""

import re
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from toolkit.capture.devices import TABLE
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
    Seed,
    SequenceSettings,
    Settings,
    Share,
    Unit,
    VisualizeSettings,
    nearest,
)

STAGES = ("explore", "embed", "retrieve", "rerank", "localize", "sequence", "evaluate", "visualize")
OPTIONAL = ("rerank", "sequence")
"""Stages that run only if the manifest has their section."""

DevicePair = Annotated[list[str], Field(min_length=2, max_length=2)]


class DemoData(Settings):
    """A rendered capture instead of a recorded one."""

    rooms: Positive = 2
    """Number of rooms to render."""
    frames: Annotated[int, Field(ge=2)] = 12
    """Frames per room of each map session; query sessions have half as many."""
    seed: Seed = 0
    """Random seed; each seed renders a different place."""
    alike: bool = False
    """Make the last room look exactly like the first."""
    hard: bool = False
    """Add a query recording of the phone with hard images: by night, blurred, with a wrong focal length, of two
    places, of a room that is in no map, and torn."""
    seconds: Natural = 0
    """Length of each query recording in seconds, with odometry also between images; 0: as long as its images take."""
    losses: Natural = 0
    """Losses of tracking in each query recording; needs `seconds`."""
    gaps: Natural = 0
    """Gaps of 4 s without odometry in each query recording; needs `seconds`."""
    radio: bool = False
    """Add scans of WiFi and Bluetooth to the sessions."""


class Tolerance(Settings):
    """Shares that may fail. A completed run with more failures ends with exit code 2."""

    images: Share = 0.0
    """Share of images that cannot be read."""
    queries: Share = 0.5
    """Share of queries without a pose. Some hard queries are normal; if most fail, something is wrong."""
    pairs: Share = 0.0
    """Share of device pairs that had to be skipped."""


class ExtraDevice(Settings):
    """A further kind of device, or changes to a known one."""

    key: Annotated[str, Field(pattern=r"^[a-z0-9-]+$")]
    """Name of the device in sessions and tables; its sessions are `<key>_map` and `<key>_query`."""
    label: str | None = None
    """Name of the device in figures and the report."""
    color: Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")] | None = None
    """Color of the device in figures, #rrggbb."""
    sessions: dict[Literal["map", "query"], str] | None = None
    """Names of its session folders, if they are not `<key>_map` and `<key>_query`; e.g. {query: query_drone}."""


class Source(Settings):
    """Download source of one capture: a dataset on the Hugging Face Hub, or zip archives."""

    hub: Annotated[str, Field(pattern=r"^[\w.-]+/[\w.-]+$")] | None = None
    """Dataset on the Hugging Face Hub, `owner/name`."""
    revision: str = "main"
    """Branch, tag or commit of the dataset."""
    urls: list[Annotated[str, Field(pattern=r"^https?://[^/]+/.+")]] = []
    """URLs of zip archives, instead of `hub`."""
    sha256: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = {}
    """SHA-256 checksums of the archives by file name; not needed for `hub`, which has its own."""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.hub is None) == (not self.urls):
            raise ValueError("a source needs either `hub` (owner/name) or `urls` (a list), not both")
        return self


class DatasetSettings(Settings):
    """Download sources of the captures, for `visloc download`."""

    page: str
    """Web page of the dataset, with its description, access requests and terms."""
    license: str
    """License of the data."""
    citation: str = ""
    """Publication to cite."""
    into: Literal["", "sessions"] = ""
    """Folder of the capture that corresponds to the root of a hub dataset: the capture itself, or `sessions`."""
    sessions: list[str] | dict[str, str]
    """Sessions to download: a list of names, or {name here: name in the archive} if the archive's names differ."""
    include: list[str] = []
    """Further files to download: patterns of paths in the capture, such as `registration/*`; * also matches /."""
    sources: dict[str, Source]
    """Download source of each capture, by the name of its folder."""

    @property
    def session_names(self) -> dict[str, str]:
        """Name of each downloaded session in the source, by its name here."""
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
    """The captures to run on and the settings. Paths are relative to the manifest's folder; `~` and `$VARIABLES` are
    expanded."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the run folder; by default the file name of the manifest without its ending."""
    description: str = ""
    """A sentence about the run, shown in the report."""
    captures: list[str] = []
    """Capture folders; each contains `sessions/`. The name of the folder is the name of the scene."""
    demo_data: DemoData | None = None
    """A capture to render, instead of `captures`."""
    dataset: DatasetSettings | None = None
    """Download sources of the captures, if there are any."""
    allow_outside: bool = False
    """Accept images outside of the capture folder (through `..`, absolute paths or links); only for captures that you
    trust."""
    output_root: str = "../runs"
    """Results are written to <output_root>/<name>."""
    extra_devices: list[ExtraDevice] = []
    """Kinds of devices besides ios, hl and spot."""
    devices: Literal["auto"] | list[str] = "auto"
    """Devices to use; auto: all devices of a capture."""
    pairs: Literal["all"] | list[DevicePair] = "all"
    """List of [map device, query device] pairs to run; all: every map session with every query session."""
    queries: str = "keyframes_pruned_subsampled"
    """Keyframes to localize: the name of a list in proc/ of the query sessions; `all`: every device pose known."""
    seed: Seed = 0
    """Random seed of all stages. The same seed gives the same poses."""
    world_up: Direction | None = None
    """Up direction of the captures' world, three numbers; null: estimate it from the map's camera poses if needed."""
    tolerate_failed: Tolerance = Tolerance()
    """Shares of failures that a run tolerates. Failures never stop the run; too many change its exit code."""
    unit: Unit = "auto"
    """Unit of the captures' poses: m, or null if unknown, and limits are relative to the depth of the scene in the map.
    auto: as the sessions' import has noted, else m."""
    explore: ExploreSettings = ExploreSettings()
    """Contents of notebook 01, which shows the capture."""
    embed: EmbedSettings = EmbedSettings()
    """Global descriptors of the images."""
    retrieve: RetrieveSettings = RetrieveSettings()
    """Retrieval of references for each query image."""
    rerank: RerankSettings | None = None
    """Reranking of the references. Optional: runs if the section is present, even if empty, or `true`."""
    localize: LocalizeSettings = LocalizeSettings()
    """Poses of single queries."""
    sequence: SequenceSettings | None = None
    """Poses of whole recordings, for queries with odometry. Optional like `rerank`."""
    evaluate: EvaluateSettings = EvaluateSettings()
    """Evaluation against ground truth."""
    visualize: VisualizeSettings = VisualizeSettings()
    """Figures and recordings."""

    @field_validator(*OPTIONAL, mode="before")
    @classmethod
    def _section_from_switch(cls, section: Any) -> Any:
        """Read `rerank:` and `rerank: true` as an empty section, and `rerank: false` as no section."""
        return {} if section is None or section is True else None if section is False else section

    @model_validator(mode="after")
    def _enough_references(self) -> Self:
        explicit = "topk" in self.retrieve.model_fields_set
        if self.rerank is not None and explicit and self.rerank.topn > self.retrieve.topk:
            found = f"rerank.topn is {self.rerank.topn}, but retrieve.topk is only {self.retrieve.topk}"
            raise ValueError(f"{found}: raise or remove retrieve.topk")
        return self

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if bool(self.captures) == (self.demo_data is not None):
            raise ValueError("give either `captures` (a list of folders) or `demo_data`, not both")
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
        """Return the settings of a stage, even if it is off, with the manifest's settings for all stages applied."""
        section: Settings = getattr(self, stage) or self.defaults(stage)
        known, update = type(section).model_fields, dict[str, Any]()
        for key in {"seed", "world_up", "unit"} & known.keys() & self.model_fields_set - section.model_fields_set:
            update[key] = getattr(self, key)
        if stage == "retrieve" and self.rerank is not None and "topk" not in section.model_fields_set:
            update["topk"] = self.rerank.topn
        return section.model_copy(update=update)

    @classmethod
    def defaults(cls, stage: str) -> Settings:
        """Return the default settings of a stage, also of an optional one."""
        optional: dict[str, Settings] = {"rerank": RerankSettings(), "sequence": SequenceSettings()}
        section: Settings = optional.get(stage) or cls.model_fields[stage].default
        return section

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that run, in order."""
        return tuple(stage for stage in STAGES if getattr(self, stage) is not None)
