"""The manifest: one YAML file that says what to run on which captures, checked before anything runs."""

import difflib
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from toolkit.capture.devices import TABLE
from toolkit.errors import ManifestError
from toolkit.models.compute import DEVICE_NAME

STAGES = ("explore", "embed", "retrieve", "rerank", "localize", "evaluate", "visualize")
OPTIONAL = ("rerank",)
"""Stages that run only where the manifest has their section."""

Positive = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
PositiveNumber = Annotated[float, Field(gt=0)]
ComputeDevice = Annotated[str, Field(pattern=f"^({DEVICE_NAME})$")]
DevicePair = Annotated[list[str], Field(min_length=2, max_length=2)]
LocalFeaturesName = Literal["sift", "superpoint"]
Threshold = Annotated[list[PositiveNumber], Field(min_length=2, max_length=2)]


class _Strict(BaseModel):
    """A frozen model without coercion of strings to numbers that refuses keys it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Section(_Strict):
    """Settings of one stage. A key that is not given leaves the default of the stage's notebook in force."""

    def given(self) -> dict[str, Any]:
        """Return what the manifest says, without what it leaves to the notebook's defaults."""
        return self.model_dump(mode="json", exclude_none=True)


class DemoData(_Strict):
    """A rendered capture instead of a recorded one."""

    rooms: Positive = 2
    """Rooms to render."""
    frames: Annotated[int, Field(ge=2)] = 12
    """Frames a room and map session; queries have half."""
    seed: Natural = 0
    """Another seed, another place."""


class ExtraDevice(_Strict):
    """A further kind of device, or what is different about a known one."""

    key: Annotated[str, Field(pattern=r"^[a-z0-9-]+$")]
    """Its sessions are `<key>_map` and `<key>_query`."""
    label: str | None = None
    """For people."""
    color: Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")] | None = None
    """In figures, as #rrggbb."""
    sessions: dict[Literal["map", "query"], str] | None = None
    """Or: what the folders of its sessions are called, e.g. {query: query_drone}."""


class ExploreSettings(_Section):
    samples: Positive | None = None
    """Images shown of each session."""


class EmbedSettings(_Section):
    model: str | None = None
    """Global descriptor: vlad, megaloc, or auto: megaloc if its weights are there. `vlad` needs no weights."""
    checkpoint: str | None = None
    """File with the weights of a learned model; without it the hub's cache, else a download."""
    batch_size: Positive | None = None
    """Images a step."""
    image_size: Annotated[int, Field(ge=126, multiple_of=14)] | None = None
    """Side of the square that a learned model sees, a multiple of 14."""
    compute_device: ComputeDevice | None = None
    """auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Literal["auto", "float32", "bfloat16", "float16"] | None = None
    """Precision of a learned model; auto: what is fast on the device."""
    upright: bool | None = None
    """Turn images so that gravity points down; without it: for learned models."""
    normalize: bool | None = None
    """Scale descriptors to unit length."""
    dtype: Literal["float32", "float16"] | None = None
    """Type of the numbers in the .npy files."""


class RetrieveSettings(_Section):
    topk: Positive | None = None
    """References a query image."""
    use_faiss: bool | None = None
    """Search with FAISS, else with torch."""
    faiss_gpu: bool | None = None
    """FAISS on the GPU."""
    normalize: bool | None = None
    """Compare by cosine."""
    compute_device: ComputeDevice | None = None
    """auto, cpu, cuda, cuda:<number> or mps."""


class RerankSettings(_Section):
    topn: Positive | None = None
    """Retrieved images whose matches are verified; retrieval finds so many, if `retrieve.topk` does not say."""
    topk: Positive | None = None
    """References kept of them."""
    features: LocalFeaturesName | None = None
    """Local features whose matches are verified."""
    matcher: Literal["mutual", "lightglue"] | None = None
    """Of queries with references; without it, what is usual for the features."""
    features_checkpoint: str | None = None
    """File with the weights of learned features; without it the hub's cache, else a download."""
    matcher_checkpoint: str | None = None
    """File with the weights of a learned matcher; likewise."""
    compute_device: ComputeDevice | None = None
    """auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Literal["auto", "float32", "bfloat16", "float16"] | None = None
    """Precision of networks; auto: what is fast on the device."""


class LocalizeSettings(_Section):
    method: Literal["pnp", "nearest", "vggt", "hybrid"] | None = None
    """`pnp`; `nearest`: the pose of the best reference, to compare against; `vggt`: a network's; `hybrid`: both."""
    predictor: Literal["vggt", "simulated"] | None = None
    """What `vggt` and `hybrid` ask; `simulated` looks up true poses, for trying things out."""
    checkpoint: str | None = None
    """File with the network's weights; without it the hub's cache, else a download."""
    num_references: Positive | None = None
    """Map images that the network is shown with each query image ..."""
    candidates: Positive | None = None
    """... chosen from so many of the best retrieved; without it, from all."""
    compute_device: ComputeDevice | None = None
    """auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Literal["auto", "float32", "bfloat16", "float16"] | None = None
    """Precision of the network; auto: what is fast on the device."""
    batch_size: Positive | None = None
    """Query devices that the network is given at once."""
    upright: bool | None = None
    """Show the network images turned so that gravity points down."""
    features: Annotated[list[LocalFeaturesName], Field(min_length=1)] | None = None
    """Local features; of several, the matches are pooled in one pose."""
    matcher: Literal["mutual", "lightglue"] | None = None
    """Of queries with references; without it, what is usual for the features."""
    features_checkpoint: str | None = None
    """File with the weights of learned features; without it the hub's cache, else a download."""
    matcher_checkpoint: str | None = None
    """File with the weights of a learned matcher; likewise."""


class EvaluateSettings(_Section):
    thresholds: list[Threshold] | None = None
    """Recall is counted at these (degrees, meters)."""
    retrieval_ks: list[Positive] | None = None
    """Retrieval recall is counted at these numbers of references."""
    retrieval_radius_m: PositiveNumber | None = None
    """A reference this near is a good one ..."""
    retrieval_angle_deg: PositiveNumber | None = None
    """... when it also looks the same way to within this angle."""


class VisualizeSettings(_Section):
    samples: Natural | None = None
    """Queries shown of each pair."""
    recordings: bool | None = None
    """Write a recording of each pair for the rerun viewer."""
    matched_queries: Natural | None = None
    """Queries of each pair shown in it with references and matches, the worst first."""
    session_recordings: bool | None = None
    """Write a recording of each session."""
    keyframes_only: bool | None = None
    """Recordings of query sessions hold only keyframes."""
    every: Positive | None = None
    """Recordings of sessions hold every so many frames; at most 1000 images where not given."""


class Source(_Strict):
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
    def _one_place(self) -> "Source":
        if (self.hub is None) == (not self.urls):
            raise ValueError("a source has either `hub` (owner/name) or `urls` (a list), and not both")
        return self


class DatasetSettings(_Strict):
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
    def _renames_archives_only(self) -> "DatasetSettings":
        if not self.sessions:
            raise ValueError("dataset.sessions is empty; expected names such as ios_map")
        keys = [kind.key for kind in TABLE]
        for name in self.session_names:
            if not re.fullmatch(f"({'|'.join(keys)})_(map|query)", name):
                raise ValueError(f"dataset.sessions: found {name!r}, expected <{', '.join(keys)}>_<map or query>")
        if isinstance(self.sessions, dict) and any(source.hub for source in self.sources.values()):
            raise ValueError("dataset.sessions gives new names, which works with archives (`urls`) only")
        return self


class Manifest(_Strict):
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
    world_up: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    """Direction that is up in the captures' world; estimated from the map's cameras where it is needed."""
    explore: ExploreSettings = ExploreSettings()
    embed: EmbedSettings = EmbedSettings()
    retrieve: RetrieveSettings = RetrieveSettings()
    rerank: RerankSettings | None = None
    """Optional: the stage runs if the section is there, also without a key in it, or is `true`."""
    localize: LocalizeSettings = LocalizeSettings()
    evaluate: EvaluateSettings = EvaluateSettings()
    visualize: VisualizeSettings = VisualizeSettings()

    @field_validator("world_up")
    @classmethod
    def _a_direction(cls, world_up: list[float] | None) -> list[float] | None:
        if world_up is not None and not 1e-9 < math.hypot(*world_up) < math.inf:
            raise ValueError(f"world_up is {world_up}; expected three finite numbers that are not all zero")
        return world_up

    @field_validator("rerank", mode="before")
    @classmethod
    def _a_switch(cls, rerank: Any) -> Any:
        """Take `rerank:` and `rerank: true` as a section without keys, and `false` as none."""
        return {} if rerank is None or rerank is True else None if rerank is False else rerank

    @model_validator(mode="after")
    def _enough_references(self) -> "Manifest":
        wanted, found = self.rerank and self.rerank.topn, self.retrieve.topk
        if wanted and found and wanted > found:
            raise ValueError(
                f"rerank.topn is {wanted}, but retrieve.topk finds only {found}: raise it, or leave it out"
            )
        return self

    @model_validator(mode="after")
    def _one_source(self) -> "Manifest":
        if bool(self.captures) == (self.demo_data is not None):
            raise ValueError("give either `captures` (a list of folders) or `demo_data`, and not both")
        return self

    @model_validator(mode="after")
    def _known_devices(self) -> "Manifest":
        known = [kind.key for kind in TABLE] + [device.key for device in self.extra_devices]
        devices = [] if self.devices == "auto" else self.devices
        pairs = [] if self.pairs == "all" else [key for pair in self.pairs for key in pair]
        for name, keys in (("devices", devices), ("pairs", pairs)):
            for key in keys:
                if key not in known:
                    raise ValueError(f"{name}: found {key!r}. {nearest(key, known)} `extra_devices` adds others")
        return self

    def stage(self, stage: str) -> _Section:
        """Return the settings of one stage, also of one that is off."""
        section: _Section | None = getattr(self, stage)
        return RerankSettings() if section is None else section

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that run, in order."""
        return tuple(stage for stage in STAGES if getattr(self, stage) is not None)


def load_manifest(path: str | Path, overrides: Iterable[str] = ()) -> Manifest:
    """Read and check a manifest.

    `inherits: FILE` (or a list of files, relative to the manifest) takes over what those files say: sections are
    merged key by key, lists and values replaced, and each path counts from the folder of the file that has it.

    Args:
        path: YAML file.
        overrides: `key=value` or `section.key=value`, the value in YAML; they replace what the file says.

    Returns:
        The manifest with its paths made absolute.

    Raises:
        ManifestError: naming the file, the key, what was found, and the nearest known key; also the file that an
            inherited key is from.
    """
    path = Path(path)
    source = str(path)
    chain = _read_chain(path, ())
    raw: dict[str, Any] = {}
    for _, content in chain:
        raw = _merge(raw, content)
    for override in overrides:
        _apply(raw, override)
        source = f"{path} with --set {override}" if source == str(path) else f"{source} {override}"
    raw.setdefault("name", path.stem)
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:
        raise ManifestError(_explain(error, source, path, chain)) from None
    folder = path.resolve().parent
    update: dict[str, Any] = {
        "captures": [str(_expand(text, folder, f"{source}: captures")) for text in manifest.captures],
        "output_root": str(_expand(manifest.output_root, folder, f"{source}: output_root")),
    }
    for stage in ("embed", "localize"):
        section = getattr(manifest, stage)
        given = {key: text for key, text in section.given().items() if key.endswith("checkpoint")}
        if given:
            weights = {key: str(_expand(text, folder, f"{source}: {stage}.{key}")) for key, text in given.items()}
            update[stage] = section.model_copy(update=weights)
    names = [Path(capture).name for capture in update["captures"]]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ManifestError(
            f"{source}: captures: two folders are called {sorted(twice)[0]!r}, so their results would "
            "overwrite each other. Rename one, or use two manifests."
        )
    return manifest.model_copy(update=update)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence that names the nearest of the known names, and lists them all."""
    known = sorted(known)
    match = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.5)
    return (f"Did you mean {match[0]!r}? " if match else "") + f"Known: {', '.join(known)}."


Chain = list[tuple[Path, dict[str, Any]]]
"""The files that make up a manifest, each with what it says itself; a later one wins."""


def _read_chain(path: Path, heirs: tuple[Path, ...]) -> Chain:
    if path.resolve() in [heir.resolve() for heir in heirs]:
        circle = " inherits ".join(map(str, (*heirs, path)))
        raise ManifestError(f"{circle}: a manifest cannot inherit from itself. Take one of these `inherits` out.")
    raw = _read_yaml(path, heirs[-1] if heirs else None)
    bases = raw.pop("inherits", [])
    bases = [bases] if isinstance(bases, str) else bases
    if not (isinstance(bases, list) and all(isinstance(base, str) for base in bases)):
        raise ManifestError(f"{path}: inherits: found {bases!r}, expected a file name or a list of them.")
    chain: Chain = []
    for base in bases:
        file = _expand(base, path.parent, f"{path}: inherits")
        chain += _read_chain(file, (*heirs, path))
    if heirs:
        _anchor(raw, path.resolve().parent)
    return [*chain, (path, raw)]


def _merge(base: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with what `content` says: mappings are merged, anything else is replaced."""
    merged = dict(base)
    for key, value in content.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _anchor(raw: dict[str, Any], folder: Path) -> None:
    """Make the paths of a base absolute: they count from its own folder, not from its heir's."""

    def anchor(text: Any) -> Any:
        if not isinstance(text, str) or text.startswith("~") or "$" in os.path.expandvars(text):
            return text  # expanded, or refused, at the end: an heir may replace it
        return os.path.normpath(folder / os.path.expandvars(text))

    if isinstance(raw.get("captures"), list):
        raw["captures"] = [anchor(text) for text in raw["captures"]]
    if "output_root" in raw:
        raw["output_root"] = anchor(raw["output_root"])
    for stage in ("embed", "localize"):
        if isinstance(raw.get(stage), dict):
            files = {key: anchor(text) for key, text in raw[stage].items() if str(key).endswith("checkpoint")}
            raw[stage] = raw[stage] | files


def _read_yaml(path: Path, heir: Path | None = None) -> dict[str, Any]:
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if heir:
            raise ManifestError(f"{heir}: inherits {path}, and there is no such file. Correct `inherits`.") from None
        raise ManifestError(f"{path}: no such manifest. data_manifests/demo.yaml is an example.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{path}: cannot be read as a text file ({error}).") from None
    except yaml.YAMLError as error:
        text = str(error).replace('"<unicode string>"', str(path))
        raise ManifestError(f"{path}: not valid YAML. {text}") from None
    if not isinstance(raw, dict):
        raise ManifestError(f"{path}: found {type(raw).__name__}, expected `key: value` lines.")
    return raw


def _apply(raw: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ManifestError(f"--set {override}: expected key=value, for example localize.method=nearest.")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ManifestError(f"--set {override}: the value is not valid YAML. {error}") from None
    *sections, last = key.strip().split(".")
    for section in sections:
        if not isinstance(raw.get(section), dict):
            raw[section] = {}
        raw = raw[section]
    raw[last] = value


def _explain(error: ValidationError, source: str, path: Path, chain: Chain) -> str:
    lines = []
    for problem in error.errors():
        keys = [str(key) for key in problem["loc"] if not re.match(r"literal|list\[|dict\[|constrained", str(key))]
        where = ".".join(keys) or "the manifest"
        if problem["type"] == "extra_forbidden":
            known = _model_at(keys[:-1]).model_fields
            line = f"unknown key {where!r}. {nearest(keys[-1], known)}"
        elif problem["type"] == "value_error":
            line = f"{problem['ctx']['error']}."
        elif problem["type"] == "literal_error" and isinstance(problem["input"], list):
            continue  # the other branch of `"all" | list`, which says what is wrong in the list
        elif problem["type"] in ("list_type", "dict_type") and isinstance(problem["input"], list | dict):
            continue  # likewise, of `list | dict`
        elif problem["type"] == "missing":
            line = f"{where}: not given. {problem['msg']}."
        else:
            line = f"{where}: found {problem['input']!r}. {problem['msg']}."
        giver = next((file for file, content in reversed(chain) if _has(content, keys)), path)
        lines.append(line if giver == path else f"{line} (in {giver}, which it inherits)")
    return "\n  ".join([f"{source}:", *dict.fromkeys(lines)])


def _has(content: Any, keys: list[str]) -> bool:
    """Tell whether a file itself says something under these keys."""
    for key in keys:
        if isinstance(content, list):
            return True
        if not isinstance(content, dict) or key not in content:
            return False
        content = content[key]
    return True


def _model_at(keys: list[str]) -> type[BaseModel]:
    """Return the model of the section under these keys."""
    model: Any = Manifest
    for key in keys:
        if key not in model.model_fields:
            continue  # a name in a mapping of sections
        kinds: list[Any] = [model.model_fields[key].annotation]
        while kinds:  # the section in `Section | None` and `dict[str, Section]`
            kind = kinds.pop()
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                model = kind
                break
            kinds += get_args(kind)
    section: type[BaseModel] = model
    return section


def _expand(text: str, folder: Path, where: str) -> Path:
    expanded = os.path.expandvars(text)
    if unset := re.search(r"\$\{?(\w+)\}?", expanded):
        raise ManifestError(
            f"{where}: {text!r} uses the variable ${unset[1]}, which is not set. "
            f"Set it (export {unset[1]}=...) or write the folder itself."
        )
    return Path(os.path.normpath(folder / Path(expanded).expanduser()))
