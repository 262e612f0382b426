"""The settings of every stage, as one tree that manifest, notebooks and functions share.

`visloc settings` prints the tree. The sentence under each field is its only documentation.
"""

import difflib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from toolkit.errors import ArtifactError, ManifestError
from toolkit.models.compute import DEVICE_NAME

_BRANCH = r"literal|int$|str$|list\[|dict\[|constrained"
"""Names that pydantic adds to the path of a key whose value may have several types."""


def require_known(what: str, value: str, known: Iterable[str]) -> None:
    """Raise ManifestError, which names the nearest of the known values, for an unknown value of an option."""
    if value not in (known := [*known]):
        raise ManifestError(f"{what}: unknown {value!r}. {nearest(value, known)}")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence that suggests the known name nearest to `name`, and lists all known names."""
    known = sorted(known)
    match = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.5)
    return (f"Did you mean {match[0]!r}? " if match else "") + f"Known: {', '.join(known) or 'none'}."


def nested_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a field's type: M for `M`, `M | None` and `dict[str, M]`; None without a model."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((inner for part in get_args(annotation) if (inner := nested_model(part))), None)


def explain(
    error: ValidationError, model: type[BaseModel], source: str, origin: Callable[[list[str]], str] = lambda keys: ""
) -> str:
    """Return the message of a validation error of the file or class `source`, one line per problem; `origin` maps the
    keys of a value to a suffix that says where the value comes from.
    """
    lines = list[str]()
    for problem in error.errors():
        path = [str(key) for key in problem["loc"]]
        keys = [key for key in path if not re.match(_BRANCH, key)]
        where = ".".join(keys) or source
        of_branch = path != [] and re.match(_BRANCH, path[-1]) is not None
        if problem["type"] == "extra_forbidden":
            line = f"unknown key {where!r}{_why_unknown(keys[-1], _model_at(model, keys[:-1]))}"
        elif problem["type"] == "value_error":
            line = f"{where}: {problem['ctx']['error']}." if keys else f"{problem['ctx']['error']}."
        elif of_branch and problem["type"] in ("literal_error", "string_type") and isinstance(problem["input"], list):
            continue  # of `"all" | list` or `str | list`; the list branch reports what is wrong in the list
        elif of_branch and problem["type"] in ("list_type", "dict_type") and isinstance(problem["input"], list | dict):
            continue  # likewise for `list | dict`
        elif problem["type"] == "literal_error" and isinstance(problem["input"], str):
            choices = re.findall(r"'([^']*)'", problem["ctx"]["expected"])
            line = f"{where}: found {problem['input']!r}. {nearest(problem['input'], choices)}"
        elif problem["type"] == "missing":
            line = f"{where}: not given. {problem['msg']}."
        else:
            line = f"{where}: found {problem['input']!r}. {_expected(problem, model, keys)}"
            if lines and lines[-1].startswith(f"{where}: found {problem['input']!r}. Input should be "):
                # Another type that the value may have.
                lines[-1] = lines[-1].replace(" Input should be", f" {problem['msg']} or", 1)
                continue
        lines.append(line + origin(keys))
    return "\n  ".join([f"{source}:", *dict.fromkeys(lines)])


def _why_unknown(name: str, model: type[BaseModel]) -> str:
    """Return the end of a message: the file if a former setting is a constant now, else the known keys."""
    for file, names in getattr(model, "constants", {}).items():
        for setting, _, constant in (one.partition("=") for one in names.split()):
            if setting == name:
                return f": it is no setting any more, but {constant or name.upper()} in toolkit/{file}."
    return f". {nearest(name, model.model_fields)}"


def _expected(problem: Any, model: type[BaseModel], keys: list[str]) -> str:
    """Return what pydantic expected and the description of the setting; only the description instead of a regex."""
    fields = _model_at(model, keys[:-1]).model_fields
    meaning = " ".join((fields[keys[-1]].description or "").split()) if keys and keys[-1] in fields else ""
    expected = "" if meaning and problem["type"] == "string_pattern_mismatch" else f"{problem['msg']}."
    return f"{expected} Meaning: {meaning}".strip() if meaning else expected


def _model_at(model: type[BaseModel], keys: list[str]) -> type[BaseModel]:
    """Return the model of the section under these keys."""
    for key in keys:
        if key in model.model_fields:  # else it is a key of a mapping of sections
            model = nested_model(model.model_fields[key].annotation) or model
    return model


Positive = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]  # COLMAP and FAISS take 32 bits
PositiveNumber = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
ComputeDevice = Annotated[str, Field(pattern=f"^({DEVICE_NAME})$")]
Precision = Literal["auto", "float32", "bfloat16", "float16"]
Threshold = Annotated[list[PositiveNumber], Field(min_length=2, max_length=2)]


def _check_direction(direction: list[float]) -> list[float]:
    if not 1e-9 < math.hypot(*direction) < math.inf:
        raise ValueError(f"found {direction}, expected three finite numbers that are not all zero")
    return direction


def _check_models(model: str | list[str]) -> str | list[str]:
    """Refuse empty lists, repeated names and `auto` in a list; return a list of one name as that name."""
    if isinstance(model, str):
        return model
    twice = [name for name in dict.fromkeys(model) if model.count(name) > 1]
    if not model or twice or "auto" in model:
        found = f"{twice[0]!r} twice" if twice else "'auto' in a list" if model else "an empty list"
        raise ValueError(f"found {found}, expected a name, or a list of different names such as [megaloc, vlad]")
    return model if len(model) > 1 else model[0]


def _check_index(index: str) -> str:
    if not re.fullmatch(r"(PCA\d+,)?(Flat|RaBitQ|HNSW\d+|IVF\d+,(Flat|RaBitQ|PQ\d+(x\d+)?))", index):
        kinds = "Flat, RaBitQ, HNSW<links>, or IVF<cells> with Flat, RaBitQ or PQ<codes>, perhaps after PCA<dimensions>"
        raise ValueError(f"found {index!r}, expected {kinds}, such as PCA512,IVF4096,RaBitQ")
    return index


Unit = Literal["auto", "m"] | None
Direction = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(_check_direction)]


class Settings(BaseModel):
    """Frozen settings. Unknown keys and values of the wrong type are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)
    shorthand: ClassVar[str] = ""
    """Name of the field that a plain value sets: `matcher: mutual` means `matcher: {name: mutual}`."""
    constants: ClassVar[dict[str, str]] = {}
    """Former settings that are constants now, by their file in `toolkit/`, for the errors of such keys. The constant
    has the name of the setting in capitals, or the one after `=`."""

    @model_validator(mode="before")
    @classmethod
    def _from_shorthand(cls, raw: Any) -> Any:
        return {cls.shorthand: raw} if cls.shorthand and not isinstance(raw, dict | Settings) else raw

    @classmethod
    def of(cls, *layers: "Settings | Mapping[str, Any] | None") -> Self:
        """Return the defaults, overridden by the layers in turn; a later layer wins. One whole model stays as it is.

        Raise ManifestError that names an unknown key, or the key of an invalid value and what was expected.
        """
        if len(layers) == 1 and isinstance(layers[0], cls):
            return layers[0]
        merged: dict[str, Any] = {}
        for layer in layers:
            given = layer.given() if isinstance(layer, Settings) else layer or {}
            if not isinstance(given, Mapping):
                raise ManifestError(f"{cls.__name__}: found {layer!r}, expected a mapping such as {{'key': value}}.")
            merged = merge(merged, expand(cls, given))
        try:
            return cls.model_validate(merged)
        except ValidationError as error:
            raise ManifestError(explain(error, cls, cls.__name__)) from None

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Return the settings beside a stage's results; raise ArtifactError if missing or of another version."""
        try:
            return cls.of(json.loads((folder / "settings.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, ManifestError) as error:
            raise unreadable(folder / "settings.json", error) from None

    def given(self) -> dict[str, Any]:
        """Return the explicitly set fields as plain values; fields left at their defaults are absent."""
        return self.model_dump(mode="json", exclude_unset=True)

    def flat(self) -> dict[str, Any]:
        """Return all values by their keys, such as `pnp.min_inliers`; a section's shorthand has the section's key."""
        rows: dict[str, Any] = {}
        for name, value in self:
            nested = value.flat() if isinstance(value, Settings) else {"": value}
            short = getattr(value, "shorthand", "")
            rows |= {name if key in ("", short) else f"{name}.{key}": inner for key, inner in nested.items()}
        return rows


def unreadable(path: Path, error: Exception) -> ArtifactError:
    """Return the error for a file whose settings are missing or of another version, given what reading them raised."""
    other = "another version of the toolkit wrote it"
    problem = other if isinstance(error, ManifestError) else f"cannot read its settings ({error})"
    return ArtifactError(f"{path}: {problem}. Run its stage again.")


def expand(model: type[Settings], raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the raw values of a model with every shorthand written out, ready to be merged key by key."""
    expanded: dict[str, Any] = {}
    for key, value in raw.items():
        inner = nested_model(model.model_fields[key].annotation) if key in model.model_fields else None
        if inner and issubclass(inner, Settings):
            value = value.given() if isinstance(value, Settings) else value
            if isinstance(value, dict):
                value = expand(inner, value)
            elif inner.shorthand and value is not None:
                value = {inner.shorthand: _plain(value)}
            elif value is True and model.model_fields[key].default is None:
                value = {}  # switches an optional section on and keeps the keys of an inherited file
            elif value is None and type(None) not in get_args(model.model_fields[key].annotation):
                value = {}  # a section without any key
        expanded[key] = _plain(value)
    return expanded


def _plain(value: Any) -> Any:
    """Return a value as plain YAML data: tuples become lists, paths texts, NumPy scalars Python numbers."""
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value.item() if hasattr(value, "item") else value


def merge(base: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` overridden by `content`: mappings are merged key by key, all other values are replaced."""
    merged = dict(base)
    for key, value in content.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def describe(model: type[Settings], indent: str = "") -> Iterator[str]:
    """Yield the lines of a settings tree as YAML: each field with its default, below a comment that explains it.

    Fields without a default are left out. An optional section that is off is printed as a comment.
    """
    for name, field in model.model_fields.items():
        if field.is_required():
            continue
        inner, default = nested_model(field.annotation), field.get_default()
        needed = [name for name, of_inner in (inner.model_fields if inner else {}).items() if of_inner.is_required()]
        yield from (f"{indent}# {line}".rstrip() for line in (field.description or "").splitlines())
        if inner is not None and issubclass(inner, Settings) and not needed:
            off = "" if isinstance(default, Settings) else "# "
            yield f"{indent}{off}{name}:"
            yield from (f"{off}{line}" for line in describe(inner, indent + "  "))
        else:
            text = yaml.safe_dump(default, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
            yield f"{indent}{name}: {text}"


class ExploreSettings(Settings):
    """Contents of notebook 01, which shows a capture."""

    samples: Positive = 4
    """Number of sample images shown per session."""
    world_up: Direction | None = None
    """Up direction of the world, three numbers; null: estimate it from the camera poses."""
    unit: Unit = "auto"
    """Unit of the poses: m, or null if unknown, and figures show no unit; auto: as the sessions' import has noted."""


class EmbedSettings(Settings):
    """Global descriptors of the images."""

    constants = {"embedders/vlad.py": "vlad=MAX_WORDS"}
    model: Annotated[str | list[str], AfterValidator(_check_models)] = "vlad"
    """Global descriptor: vlad (needs no weights), megaloc, or auto (megaloc if its weights are available, else vlad).
    A list such as [megaloc, vlad] fuses the similarities by their generalized harmonic mean."""
    checkpoint: str | None = None
    """Weights file of a learned model; null: use the Hugging Face cache, else download."""
    batch_size: Positive = 8
    """Images per batch."""
    image_size: Annotated[int, Field(ge=126, multiple_of=14)] = 322
    """Side of the square input of a learned model, in pixels; a multiple of 14."""
    compute_device: ComputeDevice = "auto"
    """Device of the network: auto, cpu, cuda, cuda:<number> or mps. `vlad` always runs on the CPU."""
    dtype_compute: Precision = "auto"
    """Precision of the network; auto: a fast one for the device."""
    upright: bool | None = None
    """Rotate images by quarter turns so that gravity points down; null: only for learned models (`vlad` does not
    need it)."""
    normalize: bool = True
    """Scale descriptors to unit length."""
    dtype: Literal["float32", "float16"] = "float32"
    """Number type of the descriptors in the .npy files."""
    seed: Seed = 0
    """Random seed for learning the vocabulary."""
    world_up: Direction | None = None
    """Up direction of the map's world, three numbers; null: estimate it from the map's camera poses."""

    @property
    def models(self) -> list[str]:
        return [self.model] if isinstance(self.model, str) else self.model

    @property
    def of_network(self) -> dict[str, Any]:
        """Arguments of `create_embedder` for a learned model."""
        of_all = {"checkpoint": self.checkpoint, "image_size": self.image_size, "dtype_compute": self.dtype_compute}
        return of_all | {"device": self.compute_device}


class MaskSettings(Settings):
    """Priors on the query's location that restrict the search to a part of the map: rough poses, GPS, radio signals.

    The search covers the map images that all enabled priors allow. Priors apply in the order below. For each query, a
    prior without information, or one that contradicts those before it, is ignored.
    """

    constants = {"embedders/masks.py": "poses_angle_deg=MAX_ANGLE_DEG gps_margin_m radio_share window_s"}
    poses: str | None = None
    """File with rough poses of the query devices in the map's frame, in the format of trajectories.txt; restricts the
    search to map images near these poses. null: no such prior."""
    poses_distance: PositiveNumber = 10.0
    """Largest distance between the rough pose and a map camera, in the unit of the poses."""
    gps: bool = False
    """Search only map images whose GPS fix (gps.txt) is near the query's; map images without a fix are kept."""
    radio: bool = False
    """Search only the map images whose WiFi and Bluetooth signals are most similar to the query's."""


class RetrieveSettings(Settings):
    """Retrieval: the map images (references) most similar to each query image."""

    topk: Positive = 10
    """References per query image."""
    use_faiss: bool = True
    """Exact search with FAISS (true) or torch (false), with the same result. An approximate index always uses FAISS;
    fused similarities of several descriptors, and searches with masks, always use torch."""
    faiss_gpu: bool = False
    """Run FAISS on the GPU; needs a FAISS built with GPU support."""
    normalize: bool = True
    """Scale descriptors to unit length before the search, so that it compares by cosine similarity."""
    index: Annotated[str, AfterValidator(_check_index)] = "Flat"
    """FAISS factory string of an approximate index for large maps: RaBitQ, HNSW32, or IVF4096 with Flat, RaBitQ or
    PQ64, each also behind PCA, such as PCA512,IVF4096,RaBitQ. Flat: exact search without an index."""
    index_candidates: Positive = 1000
    """Candidates per query that an approximate index returns; they are then ranked by exact similarity."""
    nprobe: Positive | None = None
    """Cells of an IVF index to search per query; null: 1/32 of the cells, at least 16."""
    mask: MaskSettings = MaskSettings()
    """Priors on the location that restrict the search to a part of the map."""
    compute_device: ComputeDevice = "auto"
    """Device of the search with torch: auto, cpu, cuda, cuda:<number> or mps."""


class SiftSettings(Settings):
    """SIFT keypoints and descriptors."""

    constants = {"features/features.py": "contrast_threshold=MIN_CONTRAST"}
    min_long_side: Natural = 640
    """Before detection, smaller images are enlarged to this length of the longer side, pixels."""
    max_long_side: Positive = 1280
    """Before detection, larger images are reduced to this length of the longer side, pixels."""
    max_keypoints: Positive = 3072
    """Largest number of keypoints per image; those with the strongest response are kept."""


class SuperPointSettings(Settings):
    """SuperPoint keypoints and descriptors."""

    constants = {"features/network.py": "threshold=min_response nms_radius=nms_radius border=border"}
    max_long_side: Annotated[int, Field(ge=8)] = 1024
    """Larger images are reduced to this length of the longer side, pixels; the aspect ratio is kept."""
    max_keypoints: Positive = 2048
    """Largest number of keypoints per image; those with the strongest response are kept."""


AlikedModel = Literal["aliked-n16", "aliked-n16rot", "aliked-n32", "aliked-t16"]


class AlikedSettings(Settings):
    """ALIKED keypoints and descriptors."""

    constants = {"features/network.py": "min_long_side=min_long_side threshold=min_score nms_radius=nms_radius"}
    model: AlikedModel = "aliked-n16"
    """Variant of the network: n16rot tolerates more in-plane rotation, n32 is larger, t16 is smaller."""
    max_long_side: Annotated[int, Field(ge=32)] = 1024
    """Larger images are reduced to this length of the longer side, pixels; the aspect ratio is kept."""
    max_keypoints: Positive = 1024
    """Largest number of keypoints per image; those with the highest score are kept. With 2,048, LightGlue takes three
    times as long and poses hardly improve."""


Checkpoint = str | dict[Literal["superpoint", "aliked"], str]

AUTO = "auto"


class FeaturesSettings(Settings):
    """Local features: which kinds, and how each is extracted."""

    shorthand = "kinds"
    kinds: Annotated[list[str], BeforeValidator(lambda kinds: [kinds] if isinstance(kinds, str) else kinds)] = ["auto"]
    """Kinds of local features: sift, superpoint, aliked; the matches of several kinds are pooled for one pose.
    auto: sift, with aliked as `escalation`; on a GPU both from the start; sift alone if ALIKED's weights are missing.
    `features: [sift]` is short for `features: {kinds: [sift]}`."""
    escalation: list[str] = []
    """Further kinds that are used only for queries whose pose is not `ok` without them; the matches of all kinds then
    decide together."""
    checkpoint: Checkpoint | None = None
    """Weights file of the learned features, or one file per kind: `{aliked: <file>}`; null: use an installed package
    or a cache, else download."""
    sift: SiftSettings = SiftSettings()
    """Settings of `sift`."""
    superpoint: SuperPointSettings = SuperPointSettings()
    """Settings of `superpoint`."""
    aliked: AlikedSettings = AlikedSettings()
    """Settings of `aliked`."""

    @model_validator(mode="after")
    def _each_kind_once(self) -> Self:
        kinds = [*self.kinds, *self.escalation]
        if not self.kinds:
            raise ValueError("kinds is empty; expected at least one, such as sift")
        if AUTO in kinds and kinds != [AUTO]:
            raise ValueError(f"kinds is {self.kinds} and escalation {self.escalation}; {AUTO} cannot be combined")
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"kinds is {self.kinds} and escalation {self.escalation}; expected each kind once")
        return self


def checkpoint_of(checkpoint: str | Mapping[Any, str] | None, kind: str) -> str | None:
    """Return the weights file that a `checkpoint` setting names for a kind of local features; None if none."""
    return checkpoint.get(kind) if isinstance(checkpoint, Mapping) else checkpoint


class MatcherSettings(Settings):
    """Matching of the local features of a query image and a reference."""

    shorthand = "name"
    constants = {"features/matching.py": "min_confidence"}
    name: str | None = None
    """mutual: mutual nearest neighbors; lightglue: the LightGlue network; null: the usual matcher of each kind of
    features."""
    checkpoint: Checkpoint | None = None
    """Weights file of a learned matcher, or one file per kind of features: `{aliked: <file>}`; null: use an installed
    package or a cache, else download."""


class RerankSettings(Settings):
    """Reranking: sorts retrieved images by their number of geometrically verified matches with the query image."""

    constants = {"features/matching.py": "max_error_deg max_trials"}
    topn: Positive = 30
    """Retrieved images per query image to verify. It is also the number to retrieve, unless `retrieve.topk` is set."""
    topk: Positive = 10
    """References per query image to keep after reranking."""
    features: FeaturesSettings = FeaturesSettings()
    """Local features to match, one kind; auto: sift."""
    matcher: MatcherSettings = MatcherSettings()
    """Matcher of the local features."""
    max_features: Positive = 1536
    """Largest number of features per image to match; those with the strongest response are used."""
    compute_device: ComputeDevice = "auto"
    """Device of the networks: auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Precision = "auto"
    """Precision of the networks; auto: a fast one for the device."""
    seed: Seed = 0
    """Random seed of RANSAC. The same seed gives the same order."""
    world_up: Direction | None = None
    """Up direction of the map's world, three numbers, for learned features; null: estimate it from the map's camera
    poses."""

    @model_validator(mode="after")
    def _one_kind_of_features(self) -> Self:
        if len(self.features.kinds) != 1 or self.features.escalation:
            raise ValueError(f"features are {self.features.kinds + self.features.escalation}; reranking takes one kind")
        if self.topk > self.topn:
            raise ValueError(f"topk is {self.topk} and topn {self.topn}; expected topk to be at most topn")
        return self


class SequenceSettings(Settings):
    """Poses of whole recordings: a pose graph joins the odometry of the device and the poses of single queries."""

    constants = {"sequences/odometry.py": "max_gap_s max_speed_m_s", "sequence.py": "windows_s"}
    position_drift: PositiveNumber = 0.03
    """Position drift of the odometry: standard deviation per axis after 1 m, in meters; grows with the square root of
    the distance. If the motions between `ok` queries show more drift, this and `rotation_drift_deg` are raised to fit
    them, by up to 20 times."""
    rotation_drift_deg: PositiveNumber = 0.15
    """Rotation drift of the odometry: standard deviation per axis after 1 s, in degrees; grows with the square root of
    the time."""
    scale_std: PositiveNumber = 0.02
    """Relative standard deviation of the scale of a recording's odometry."""
    relocalize: bool = True
    """Localize queries again near their predicted pose if they are not `ok` or contradict the other queries."""
    online: bool = False
    """Estimate the pose of each query from earlier data only; other frames then get no pose."""
    length_s: PositiveNumber | None = None
    """If `online`: seconds of earlier data that a pose uses; null: everything since the start of its piece."""

    @model_validator(mode="after")
    def _length_needs_online(self) -> Self:
        if self.length_s is not None and not self.online:
            raise ValueError(f"length_s is {self.length_s:g}, which counts before a query: set online: true")
        return self


class MapSettings(Settings):
    """Triangulation of map points from the map images and their known poses."""

    constants = {
        "mapping/build.py": "max_epipolar_error_px ratio",
        "mapping/triangulation.py": "max_reprojection_error_px",
    }
    pairs_per_image: Positive = 14
    """Other map images that each map image is matched with."""
    min_triangulation_angle_deg: PositiveNumber = 1.5
    """Points with a smaller triangulation angle, degrees, are dropped, because their depth is unreliable."""
    refine_poses: bool = False
    """Refine the poses of a map by bundle adjustment if their noise is above a pixel, as that of SLAM often is. The
    given positions are priors, so the map stays where it was; intrinsics do not change. Takes about 0.4 s per image."""
    tile_images: Positive = 400
    """A map with more images is triangulated in tiles of about this many images plus their neighbors, which limits
    memory to about 3 MB per image of a tile."""


class PnpSettings(Settings):
    """Pose estimation from matches with map points. Errors are angles seen from the camera, in degrees."""

    constants = {
        "pose/pnp.py": "clear_inlier_ratio contested_inlier_ratio contested_references "
        "guided_radii_deg max_guided_matches ok_rival_support=MAX_RIVAL_SUPPORT",
        "pose/base.py": "max_ransac_matches ransac_max_trials=MAX_RANSAC_TRIALS",
        "pose/map_matching.py": "guided_images=MAX_GUIDED_IMAGES max_map_features max_query_features",
        "scene/map.py": "sure_position_std_m=MAX_SURE_STD_M",
    }
    ransac_max_error_deg: PositiveNumber = 0.45
    """Largest reprojection error of an inlier, degrees."""
    max_error_deg: PositiveNumber = 0.17
    """Largest reprojection error of a match that agrees with the final pose, guided or not, degrees."""
    min_inliers: Positive = 12
    """Smallest number of independent inliers, among the matches found without guidance, of a pose; with fewer, the
    query has no pose."""
    ok_probability: Share = 0.99
    """A pose is `ok` only if the estimated probability that it is right (within 5 degrees and 0.5 m) reaches this
    value; see `pose/pnp.py`."""


class PredictorSettings(Settings):
    """The feed-forward network that predicts cameras and depth from a query image and its references."""

    shorthand = "name"
    constants = {"prediction/feed_forward.py": "depth_points=MAX_DEPTH_POINTS least_points=MIN_POINTS"}
    name: Literal["vggt", "vggt-omega", "da3-base", "da3-small", "simulated"] = "vggt"
    """Network of the methods `feed_forward` and `hybrid`. `simulated` looks up the true poses, for trials."""
    checkpoint: str | None = None
    """Weights file of the network; null: use the Hugging Face cache, else download."""
    num_references: Positive = 5
    """Map images that the network receives with each query image."""
    batch_size: Positive = 4
    """Query devices per batch. Poses do not depend on it."""


Method = Annotated[
    Literal["pnp", "nearest", "feed_forward", "hybrid"],
    BeforeValidator(lambda value: "feed_forward" if value == "vggt" else value),  # the former name of the method
]


class LocalizeSettings(Settings):
    """Poses of single queries."""

    method: Method = "pnp"
    """pnp: pose from matches with map points; nearest: the pose of the best reference, as a baseline; feed_forward:
    cameras predicted by a network, aligned to the map; hybrid: pnp and feed_forward, where the predicted pose and depth
    guide further matching and the best supported pose wins."""
    features: FeaturesSettings = FeaturesSettings()
    """Local features."""
    matcher: MatcherSettings = MatcherSettings()
    """Matcher of query images and references; applies to the kinds of features that it supports."""
    map: MapSettings | None = MapSettings()
    """Triangulation of the map; null: no map, points are triangulated for each query from its references."""
    pnp: PnpSettings = PnpSettings()
    """Pose estimation from matches."""
    predictor: PredictorSettings = PredictorSettings()
    """Network of `feed_forward` and `hybrid`."""
    compute_device: ComputeDevice = "auto"
    """Device of the networks: auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Precision = "auto"
    """Precision of the networks; auto: a fast one for the device."""
    seed: Seed = 0
    """Random seed of RANSAC. The same seed gives the same poses for any number of threads."""
    world_up: Direction | None = None
    """Up direction of the map's world, three numbers; null: estimate it from the map's camera poses."""
    unit: Unit = "auto"
    """Unit of the capture's poses: m, or null if unknown, and limits are relative to the depth of the scene in the map.
    auto: as the sessions' import has noted, else m."""

    @property
    def predicts(self) -> bool:
        """Whether the method predicts cameras with a network."""
        return self.method in ("feed_forward", "hybrid")

    @model_validator(mode="after")
    def _unit_or_map(self) -> Self:
        if self.unit is None and self.map is None:
            raise ValueError("unit and map are null. Give `unit: m`, or a map: by its depth, limits are without a unit")
        return self


class EvaluateSettings(Settings):
    """Evaluation against ground truth."""

    constants = {"evaluate.py": "retrieval_ks retrieval_radius_m retrieval_angle_deg"}
    thresholds: Annotated[list[Threshold], Field(min_length=1)] = [[1.0, 0.1], [5.0, 0.5], [5.0, 1.0]]
    """Pose recall is reported at these thresholds: rotation error in degrees, translation error in meters."""


class VisualizeSettings(Settings):
    """Figures, and recordings for the rerun viewer. A pair is a map device and a query device."""

    samples: Natural = 2
    """Queries drawn per pair, evenly spread from the worst to the best."""
    recordings: bool = True
    """Write a rerun recording of each pair."""
    matched_queries: Natural = 12
    """Queries per pair whose references and matches the recording shows, the worst first."""
    session_recordings: bool = True
    """Write a rerun recording of each session."""
    keyframes_only: bool = False
    """Record only the keyframes of query sessions."""
    every: Positive | None = None
    """Record every n-th frame of a session; null: choose n so that a session has at most 1000 images."""
    world_up: Direction | None = None
    """Up direction of the world, three numbers; null: estimate it from the camera poses."""
