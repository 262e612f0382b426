"""The manifest: what to run, on which captures, with which settings. Reading it resolves inheritance, paths,
environment variables and `--set`.
"""

import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import Field, ValidationError, field_validator, model_validator

from toolkit.capture.names import TABLE
from toolkit.errors import ManifestError
from toolkit.files import RUN_FILES, shipped, write_text
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
    expand,
    explain,
    merge,
    nearest,
)

STAGES = ("explore", "embed", "retrieve", "rerank", "localize", "sequence", "evaluate", "visualize")
OPTIONAL = ("rerank", "sequence")
"""Stages that run only if the manifest has their section."""
DevicePair = Annotated[list[str], Field(min_length=2, max_length=2)]
PATHS = ("captures", "output_root", "retrieve.mask.poses")
"""Keys whose values are paths; the keys of checkpoints are paths too."""
MAX_VALUES = 100_000
"""Largest number of values in a manifest: nested YAML aliases can expand to so many that they fill the memory."""
Chain = list[tuple[Path, dict[str, Any]]]
"""The files of a manifest and their own contents, inherited files first; a later file wins."""


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
    urls: list[Annotated[str, Field(pattern=r"^https?://[^/]+/.*\.(?i:zip)([?#].*)?$")]] = []
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


# Reading


def load_manifest(path: str | Path, overrides: Iterable[str] = ()) -> Manifest:
    """Read and check a manifest and make its paths absolute.

    `inherits: FILE` (or a list of files, relative to the manifest) merges the manifest over those files: sections key
    by key, while lists and values are replaced. A path is relative to the folder of the file that contains it.

    Args:
        overrides: `key=value` or `section.key=value` at any depth, the value in YAML; merged over the file. Their paths
            are relative to the working directory, where the user types them.

    Raises:
        ManifestError: names the file (also the inherited one), the key, what was found, and the nearest known key.
    """
    path, overrides = Path(path), list(overrides)
    source = " ".join([f"{path} with --set" if overrides else f"{path}", *overrides])
    chain = _read_chain(path, ())
    # `output_root` is a path like any other.
    raw: dict[str, Any] = {"name": path.stem, "output_root": Manifest.model_fields["output_root"].default}
    typed = [_anchor(_read_override(override), Path.cwd()) for override in overrides]
    for content in [*(content for _, content in chain), *typed]:
        raw = merge(raw, expand(Manifest, content))
    raw = _map_paths(raw, lambda text, key: str(_expand(text, path.resolve().parent, f"{source}: {key}")))
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:

        def origin(keys: list[str]) -> str:
            """Name the inherited file that sets a key; empty if the manifest itself does."""
            setter = next((file for file, content in reversed(chain) if _has(content, keys)), path)
            return "" if setter == path else f" (in {setter}, which it inherits)"

        raise ManifestError(explain(error, Manifest, source, origin)) from None
    names = [Path(capture).name for capture in manifest.captures]
    for name in names:
        found = f"two folders called {name!r}, so their results would overwrite each other"
        if name in RUN_FILES:
            found = f"a folder called {name!r}, as a file of the run itself"
        if name in RUN_FILES or names.count(name) > 1:
            raise ManifestError.at(f"{source}: captures", found, do="Rename one, or name a link to it.")
    return manifest


def find_manifest(given: str | Path, here: Path = Path()) -> Path:
    """Return the path of a manifest that is given by its path or by its name, such as `demo`.

    One that is not in the folder `here` but comes with the toolkit is copied to its `data_manifests/` first, with those
    that it inherits, so that its data and runs are here, too, and a user can see and change it. Raise ManifestError if
    there is none.
    """
    path, folder = Path(given), here / "data_manifests"
    name = path.name if path.suffix in (".yaml", ".yml") else f"{path.name}.yaml"
    if path.is_file() or path.parent not in (Path(), folder):
        return path
    if (folder / name).is_file():
        return folder / name
    own = shipped("data_manifests")
    if not (own / name).is_file():
        known = sorted({one.stem for one in (*folder.glob("*.yaml"), *own.glob("*.yaml"))})
        raise ManifestError(f"{given}: no such manifest. {nearest(Path(name).stem, known)}")
    for file, _ in reversed(_read_chain(own / name, ())):
        target = folder / os.path.relpath(file, own)
        if not target.exists():
            write_text(target, file.read_text(encoding="utf-8"))
    return folder / name


def _read_chain(path: Path, heirs: tuple[Path, ...]) -> Chain:
    if path.resolve() in [heir.resolve() for heir in heirs]:
        circle = " inherits ".join(map(str, (*heirs, path)))
        raise ManifestError(f"{circle}: a manifest cannot inherit from itself. Remove one of these `inherits`.")
    raw = _read_yaml(path, heirs[-1] if heirs else None)
    bases = raw.pop("inherits", [])
    bases = [bases] if isinstance(bases, str) else bases
    if not (isinstance(bases, list) and all(isinstance(base, str) for base in bases)):
        raise ManifestError(f"{path}: inherits: found {bases!r}, expected a file name or a list of them.")
    chain: Chain = []
    for base in bases:
        file = _expand(base, path.parent, f"{path}: inherits")
        chain += _read_chain(file, (*heirs, path))
    return [*chain, (path, _anchor(raw, path.resolve().parent) if heirs else raw)]


def _map_paths(raw: dict[str, Any], change: Callable[[str, str], str], where: str = "") -> dict[str, Any]:
    """Return raw values with every path replaced by `change(path, key)`."""
    changed: dict[str, Any] = {}
    for name, value in raw.items():
        key = f"{where}{name}"
        if isinstance(value, dict):
            value = _map_paths(value, change, f"{key}.")
        elif re.search(r"checkpoint(\.\w+)?$", key) or key in PATHS:
            if isinstance(value, list):
                value = [change(text, key) if isinstance(text, str) else text for text in value]
            elif isinstance(value, str):
                value = change(value, key)
        changed[name] = value
    return changed


def _anchor(raw: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of an inherited file, or of `--set`, with paths made absolute, relative to a folder."""

    def anchor(text: str, key: str) -> str:
        if text.startswith("~") or "$" in os.path.expandvars(text):
            return text  # expanded or refused at the end, because the inheriting file may replace it
        return os.path.normpath(folder / os.path.expandvars(text))

    return _map_paths(raw, anchor)


def _read_yaml(path: Path, heir: Path | None = None) -> dict[str, Any]:
    where = f"{heir}: inherits {path}" if heir else f"{path}"
    try:
        raw = _parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ManifestError(f"{where}: no such manifest. `demo` is an example.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{where}: cannot be read as a text file ({error}).") from None
    except yaml.YAMLError as error:
        text = str(error).replace('"<unicode string>"', str(path))
        raise ManifestError(f"{where}: not valid YAML. {text}") from None
    if not isinstance(raw, dict):
        raise ManifestError(f"{path}: found {type(raw).__name__}, expected `key: value` lines.")
    return raw


def _parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; raise yaml.YAMLError for an invalid one, or aliases that expand too far."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}) > MAX_VALUES:
            raise yaml.YAMLError(f"Its aliases expand to more than {MAX_VALUES:,} values.")
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("It is nested too deeply, or an alias contains itself.") from None
    except (ValueError, LookupError, AttributeError, TypeError) as error:  # 2024-99-99, or !!int of no number
        raise yaml.YAMLError(f"A value does not fit its type ({error}).") from None


class _Loader(yaml.SafeLoader):
    """Raises YAMLError if a mapping has a key twice: PyYAML silently takes the last."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node, first = super().compose_mapping_node(anchor), dict[tuple[str, str], yaml.Node]()
        for key, _ in node.value:
            plain = isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge"
            if plain and (other := first.setdefault((key.tag, key.value), key)) is not key:
                found = f"The key {key.value!r} is there twice, first in line {other.start_mark.line + 1}"
                raise yaml.MarkedYAMLError(problem=f"{found}; keep one of them", problem_mark=key.start_mark)
        return node


def _size(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Return the number of values in a node with its aliases expanded; `sizes` caches it by the node's id."""
    if id(node) not in sizes:
        entries = node.value if isinstance(node, yaml.CollectionNode) else []
        children = itertools.chain.from_iterable(entry if isinstance(entry, tuple) else (entry,) for entry in entries)
        sizes[id(node)] = 1 + sum(_size(child, sizes) for child in children)
    return sizes[id(node)]


def _read_override(override: str) -> dict[str, Any]:
    """Return `section.key=value` as nested sections."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ManifestError.at(f"--set {override}", expected="key=value, for example localize.method=nearest")
    try:
        value = _parse_yaml(text)
    except yaml.YAMLError as error:
        raise ManifestError(f"--set {override}: the value is not valid YAML. {error}") from None
    return nested({key.strip(): value})


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by keys such as `localize.pnp.seed` as nested sections; values may be sections, too."""
    sections: dict[str, Any] = {}
    for key, value in values.items():
        for name in reversed(str(key).split(".")):
            value = {name: value}
        sections = merge(sections, value)
    return sections


def _has(content: Any, keys: list[str]) -> bool:
    """Tell whether the content of a file sets these keys itself."""
    for key in keys:
        if isinstance(content, list):
            return True
        if not isinstance(content, dict) or key not in content:
            return False
        content = content[key]
    return True


def _expand(text: str, folder: Path, where: str) -> Path:
    expanded = os.path.expandvars(text)
    if unset := re.search(r"\$\{?(\w+)\}?", expanded):
        found = f"the variable ${unset[1]}, which is not set, in {text!r}"
        raise ManifestError.at(where, found, do=f"Set it (export {unset[1]}=...) or write the folder itself.")
    try:
        path = Path(expanded).expanduser()
    except RuntimeError:
        raise ManifestError(f"{where}: {text!r} names an unknown user. Write the folder itself.") from None
    if "\0" in expanded:
        raise ManifestError(f"{where}: {text!r} is not a path: it contains a zero byte.")
    return Path(os.path.normpath(folder / path))
