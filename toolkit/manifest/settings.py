"""The settings of every stage, as one tree: manifest, notebooks and functions share it.

`python -m toolkit settings` prints it. The sentence under each field is its only documentation.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from toolkit.errors import ManifestError
from toolkit.manifest.messages import explain, nested_model
from toolkit.models.compute import DEVICE_NAME

Positive = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
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
    """Return a list of one name as the name."""
    if isinstance(model, str):
        return model
    twice = [name for name in dict.fromkeys(model) if model.count(name) > 1]
    if not model or twice or "auto" in model:
        found = f"{twice[0]!r} twice" if twice else "'auto' in a list" if model else "an empty list"
        raise ValueError(f"found {found}, expected a name, or a list of different names such as [megaloc, vlad]")
    return model if len(model) > 1 else model[0]


Unit = Literal["m"] | None
Direction = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(_check_direction)]


class Settings(BaseModel):
    """Frozen settings that refuse keys and types that they do not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)
    shorthand: ClassVar[str] = ""
    """Name of the field that a plain value stands for: `matcher: mutual` is `matcher: {name: mutual}`."""

    @model_validator(mode="before")
    @classmethod
    def _from_shorthand(cls, raw: Any) -> Any:
        return {cls.shorthand: raw} if cls.shorthand and not isinstance(raw, dict | Settings) else raw

    @classmethod
    def of(cls, *layers: "Settings | Mapping[str, Any] | None") -> Self:
        """Return the defaults with what the layers say merged over them, a later layer over an earlier one.

        Raises:
            ManifestError: an unknown key or a value that does not fit; names the key and what was expected.
        """
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
    def needed(cls) -> list[str]:
        """Return the names of the fields that have no default."""
        return [name for name, field in cls.model_fields.items() if field.is_required()]

    def given(self) -> dict[str, Any]:
        """Return what was said, without what was left to the defaults; plain values."""
        return self.model_dump(mode="json", exclude_unset=True)


def expand(model: type[Settings], raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return raw values of a model with every shorthand written out, so that they can be merged key by key."""
    expanded: dict[str, Any] = {}
    for key, value in raw.items():
        inner = nested_model(model.model_fields[key].annotation) if key in model.model_fields else None
        if inner and issubclass(inner, Settings):
            if isinstance(value, dict):
                value = expand(inner, value)
            elif inner.shorthand and value is not None:
                value = {inner.shorthand: _plain(value)}
            elif value is True and model.model_fields[key].default is None:
                value = {}  # switches an optional section on, and leaves what a base says in it
            elif value is None and isinstance(model.model_fields[key].default, Settings):
                value = {}  # a section without a key in it
        expanded[key] = _plain(value)
    return expanded


def _plain(value: Any) -> Any:
    """Return a value as YAML has it, so that callers may also give tuples, paths and numpy's numbers."""
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value.item() if hasattr(value, "item") else value


def merge(base: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with what `content` says: mappings are merged, anything else is replaced."""
    merged = dict(base)
    for key, value in content.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def describe(model: type[Settings], indent: str = "") -> Iterator[str]:
    """Yield the lines of a settings tree in YAML: every field with its meaning above it and its default.

    What has to be given is left out. A section that is off is a comment with the defaults that it would have.
    """
    for name, field in model.model_fields.items():
        if field.is_required():
            continue
        inner, default = nested_model(field.annotation), field.get_default()
        yield from (f"{indent}# {line}".rstrip() for line in (field.description or "").splitlines())
        if inner is not None and issubclass(inner, Settings) and not inner.needed():
            off = "" if isinstance(default, Settings) else "# "
            yield f"{indent}{off}{name}:"
            yield from (f"{off}{line}" for line in describe(inner, indent + "  "))
        else:
            text = yaml.safe_dump(default, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
            yield f"{indent}{name}: {text}"


class ExploreSettings(Settings):
    """What notebook 01 shows."""

    samples: Positive = 4
    """Images shown of each session."""
    world_up: Direction | None = None
    """Direction that is up in the world; null: estimated from the cameras."""
    unit: Unit = "m"
    """Unit of the poses; null: not known, and not shown."""


class VladSettings(Settings):
    """How a VLAD is built."""

    words: Positive = 256
    """Visual words; fewer where the map has too few descriptors."""
    local_dim: Positive = 64
    """Local descriptors are PCA-whitened to this length."""
    min_scale_px: float = 1.6
    """Finer keypoints are left out: blur, noise and another camera's resolution change them first.
    The standard deviation of the blob in pixels of the image as stored."""
    min_features: Natural = 300
    """At least this many of the coarsest keypoints are taken, however fine they are."""
    dim: Positive = 512
    """Most dimensions of the result; it cannot have more than there are map images."""
    prior_images: Natural = 2000
    """Shrinkage of the whitening: the weight, in images, of the belief that all directions vary alike.
    Directions learned from a hundred images say where those were taken, not what repeats between places."""
    sample_descriptors: Positive = 50_000
    """Local descriptors that the vocabulary is learned from."""
    iterations: Positive = 15
    """Rounds of k-means."""


class EmbedSettings(Settings):
    """How images become global descriptors."""

    model: Annotated[str | list[str], AfterValidator(_check_models)] = "vlad"
    """Global descriptor: vlad, megaloc, or auto: megaloc if its weights are there. `vlad` needs no weights.
    Of a list, such as [megaloc, vlad], the similarities are fused by their generalized harmonic mean."""
    checkpoint: str | None = None
    """File with the weights of a learned model; null: the hub's cache, else a download."""
    batch_size: Positive = 8
    """Images a step."""
    image_size: Annotated[int, Field(ge=126, multiple_of=14)] = 322
    """Side of the square that a learned model sees, pixels, a multiple of 14."""
    compute_device: ComputeDevice = "auto"
    """Where a network runs: auto, cpu, cuda, cuda:<number> or mps. `vlad` runs on the CPU."""
    dtype_compute: Precision = "auto"
    """Precision of a learned model; auto: what is fast on the device."""
    upright: bool | None = None
    """Turn images so that gravity points down; null: for learned models. `vlad` does not need it."""
    normalize: bool = True
    """Scale descriptors to unit length."""
    dtype: Literal["float32", "float16"] = "float32"
    """Type of the numbers in the .npy files."""
    vlad: VladSettings = VladSettings()
    """Of `vlad`."""
    seed: Natural = 0
    """Of the vocabulary."""
    world_up: Direction | None = None
    """Direction that is up in the map's world; null: estimated from its cameras."""

    @property
    def models(self) -> list[str]:
        return [self.model] if isinstance(self.model, str) else self.model


class MaskSettings(Settings):
    """What is known of the place of a query image before the search, and leaves only a part of the map to it.

    All that is known is joined; what says nothing about a query, or contradicts what stands before it, does not count.
    """

    poses: str | None = None
    """File of rough poses of query devices in the map's frame, in the format of trajectories.txt: search only ..."""
    poses_distance_m: PositiveNumber = 10.0
    """... map cameras so near, in the unit of the poses ..."""
    poses_angle_deg: PositiveNumber = 90.0
    """... that look in a direction at most so different. The roll about the viewing direction does not count."""
    gps: bool = False
    """Search only map images whose fix in gps.txt is as near the query's as ..."""
    gps_margin_m: PositiveNumber = 25.0
    """... this and twice both accuracies, and those without a fix."""
    radio: bool = False
    """Search only the map images at which WiFi and Bluetooth were received most nearly as at the query, ..."""
    radio_share: Share = 0.025
    """... this share of the map, and at least three times `topk`."""
    window_s: PositiveNumber = 2.0
    """Scans and fixes count for images so long before and after them."""


class RetrieveSettings(Settings):
    """How references are found."""

    topk: Positive = 10
    """References a query image."""
    use_faiss: bool = True
    """Exact search with FAISS, else with torch; the result is the same. An index is always FAISS's.
    Fused similarities of several descriptors are torch's."""
    faiss_gpu: bool = False
    """FAISS on the GPU; needs a FAISS built for it."""
    normalize: bool = True
    """Compare by cosine: scale descriptors to unit length before the search."""
    index: str = "Flat"
    """FAISS factory string, for large maps; such as PCA512,IVF4096,RaBitQ. Flat: exact search, without an index."""
    index_candidates: Positive = 1000
    """Of an index: found for each query, then compared exactly."""
    nprobe: Positive | None = None
    """Cells of an IVF index that are looked at; null: a 32nd of them, at least 16."""
    mask: MaskSettings = MaskSettings()
    """What leaves a query only a part of the map."""
    compute_device: ComputeDevice = "auto"
    """Where torch searches: auto, cpu, cuda, cuda:<number> or mps."""


class SiftSettings(Settings):
    """How SIFT features are extracted."""

    min_long_side: Natural = 640
    """Smaller images are enlarged to this long side, pixels, before detection."""
    max_long_side: Positive = 1280
    """Larger images are reduced to this long side, pixels, before detection."""
    max_keypoints: Positive = 3072
    """The strongest responses are kept."""
    contrast_threshold: Annotated[float, Field(ge=0)] = 0.01
    """Least contrast of a keypoint, after the image's contrast has been stretched to the full range."""


class SuperPointSettings(Settings):
    """How SuperPoint features are extracted."""

    max_long_side: Annotated[int, Field(ge=8)] = 1024
    """Larger images are reduced to this long side, pixels; the aspect is kept."""
    max_keypoints: Positive = 2048
    """The strongest responses are kept."""
    threshold: Annotated[float, Field(ge=0)] = 0.005
    """Least response of a keypoint, of at most 1."""
    nms_radius: Natural = 4
    """No two keypoints are closer than this in x and in y, pixels of the reduced image."""
    border: Natural = 4
    """Keypoints closer than this to the image's border are left out, pixels of the reduced image."""


AlikedModel = Literal["aliked-n16", "aliked-n16rot", "aliked-n32", "aliked-t16"]


class AlikedSettings(Settings):
    """How ALIKED features are extracted."""

    model: AlikedModel = "aliked-n16"
    """Variant of the network: n16rot bears more rotation in the image, n32 is larger, t16 smaller."""
    min_long_side: Natural = 640
    """Smaller images are enlarged to this long side, pixels ..."""
    max_long_side: Annotated[int, Field(ge=32)] = 1024
    """... and larger ones reduced to this one; the aspect is kept."""
    max_keypoints: Positive = 1024
    """The highest scores are kept. LightGlue takes three times as long for 2,048, and poses gain next to nothing."""
    threshold: Share = 0.02
    """Least score of a keypoint. A dark photograph has few above the authors' 0.2; a plain wall has none above 0.02."""
    nms_radius: Positive = 2
    """No two maxima of the score are closer than this in x and in y, pixels of the resized image."""


Checkpoint = str | dict[Literal["superpoint", "aliked"], str]


AUTO = "auto"


class FeaturesSettings(Settings):
    """Local features, and how each kind is extracted."""

    shorthand = "kinds"
    kinds: Annotated[list[str], Field(min_length=1)] = ["auto"]
    """Kinds of local features: sift, superpoint, aliked; of several, the matches are pooled in one pose. auto: sift,
    with aliked as `escalation`; on a GPU both from the start; where ALIKED's weights are not at hand, sift alone.
    `features: [sift]` is short for it."""
    escalation: list[str] = []
    """Kinds asked too where the pose is not `ok` otherwise; the matches of all then decide together."""
    checkpoint: Checkpoint | None = None
    """File with the weights of learned features, or of several kinds a file each: `{aliked: <file>}`; null: an
    installed package or a cache, else a download."""
    sift: SiftSettings = SiftSettings()
    """Of `sift`."""
    superpoint: SuperPointSettings = SuperPointSettings()
    """Of `superpoint`."""
    aliked: AlikedSettings = AlikedSettings()
    """Of `aliked`."""

    @model_validator(mode="before")
    @classmethod
    def _one_kind(cls, raw: Any) -> Any:
        """Take `features: sift` as `features: [sift]`."""
        if isinstance(raw, dict) and isinstance(raw.get("kinds"), str):
            return {**raw, "kinds": [raw["kinds"]]}
        return raw

    @model_validator(mode="after")
    def _each_kind_once(self) -> Self:
        kinds = [*self.kinds, *self.escalation]
        if AUTO in kinds and kinds != [AUTO]:
            raise ValueError(f"kinds is {self.kinds} and escalation {self.escalation}; {AUTO} stands alone")
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"kinds is {self.kinds} and escalation {self.escalation}; expected each kind once")
        return self


def checkpoint_of(checkpoint: str | Mapping[Any, str] | None, kind: str) -> str | None:
    """Return the file that a setting `checkpoint` names for a kind of local features."""
    return checkpoint.get(kind) if isinstance(checkpoint, Mapping) else checkpoint


class MatcherSettings(Settings):
    """How the features of a query image and a reference image are matched."""

    shorthand = "name"
    name: str | None = None
    """mutual: nearest neighbors; lightglue: the network; null: what is usual for the features."""
    checkpoint: Checkpoint | None = None
    """File with the weights of a learned matcher, or a file for each kind of features: `{aliked: <file>}`; null: an
    installed package or a cache, else a download."""
    min_confidence: Share = 0.1
    """Least confidence of a match of a learned matcher."""


class RerankSettings(Settings):
    """How references are put in the order of their verified matches."""

    topn: Positive = 30
    """Retrieved images whose matches are verified; retrieval finds so many, if `retrieve.topk` does not say."""
    topk: Positive = 10
    """References kept of them."""
    features: FeaturesSettings = FeaturesSettings()
    """Local features whose matches are verified: one kind; auto: sift."""
    matcher: MatcherSettings = MatcherSettings()
    """How they are matched."""
    max_features: Positive = 1536
    """Features of an image that are matched at most, the strongest."""
    max_error_deg: PositiveNumber = 0.2
    """Largest Sampson error of an inlier, as an angle seen from the camera."""
    max_trials: Positive = 500
    """Samples of five matches, the best matches first."""
    compute_device: ComputeDevice = "auto"
    """Where networks run: auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Precision = "auto"
    """Precision of networks; auto: what is fast on the device."""
    seed: Natural = 0
    """Of RANSAC. The same seed gives the same order."""
    world_up: Direction | None = None
    """Direction that is up in the map's world, for learned features; null: estimated from its cameras."""

    @model_validator(mode="after")
    def _one_kind_of_features(self) -> Self:
        if len(self.features.kinds) != 1 or self.features.escalation:
            raise ValueError(f"features are {self.features.kinds + self.features.escalation}; reranking takes one kind")
        if self.topk > self.topn:
            raise ValueError(f"topk is {self.topk} and topn {self.topn}; expected topk to be at most topn")
        return self


class SequenceSettings(Settings):
    """How odometry and the poses of single queries are joined to poses of a whole recording."""

    position_drift: PositiveNumber = 0.03
    """Standard deviation, by axis, that a meter of odometry adds to a position, meters; grows with the way's root. This
    and the next become larger, up to 20 times, where the motions between `ok` queries ask for that."""
    rotation_drift_deg: PositiveNumber = 0.15
    """Standard deviation, by axis, that a second of odometry adds to a rotation; grows with the time's root."""
    scale_std: PositiveNumber = 0.02
    """Relative standard deviation of the lengths of a recording's odometry."""
    gravity_std_deg: PositiveNumber | None = None
    """Standard deviation, by axis, of the direction that is up at the first pose of each piece, such as 0.5, where one
    axis of the odometry's frame is found to be up, and not online; null: odometry may lean by any angle."""
    max_gap_s: PositiveNumber = 10.0
    """A longer time without a pose is a loss of tracking: a new piece, with a frame of its own, begins."""
    max_speed_m_s: PositiveNumber = 15.0
    """So is a step that is faster."""
    relocalize: bool = True
    """Whether queries that are not `ok`, or contradict the others, are localized again near their predicted pose."""
    bundle_adjust: bool = False
    """Whether the poses at last fit the map points that `ok` queries show, in place of their poses; not online."""
    online: bool = False
    """Whether the pose of a query rests on what was before it alone; other frames then have none."""
    length_s: PositiveNumber | None = None
    """Seconds before a query that its pose rests on, if `online`; null: all that was before it in its piece."""

    windows_s: list[PositiveNumber] = [10.0, 20.0]
    """Seconds before a query: what it would be online, by single queries of so long, and of all that was before it, is
    written beside the result for comparison; `[]`: not."""

    @model_validator(mode="after")
    def _of_the_past(self) -> Self:
        if self.length_s is not None and not self.online:
            raise ValueError(f"length_s is {self.length_s:g}, which counts before a query: set online: true")
        return self


class MapSettings(Settings):
    """How a map is triangulated."""

    pairs_per_image: Positive = 14
    """Partners that an image is matched with."""
    max_epipolar_error_px: PositiveNumber = 4.0
    """Largest distance of a match to its epipolar line, at either side, pixels."""
    ratio: PositiveNumber = 0.9
    """Lowe's ratio, among the candidates along the epipolar line."""
    max_reprojection_error_px: PositiveNumber = 4.0
    """Observations further off, in pixels, are taken out of a point's track."""
    min_triangulation_angle_deg: PositiveNumber = 1.5
    """Points seen under a smaller angle are dropped: their depth is not known."""
    tile_images: Positive = 400
    """A map of more images is triangulated in tiles of about so many, and of their neighbors: some 3 MB an image."""


class PnpSettings(Settings):
    """How a pose is found from matches with map points. Angles are seen from the camera."""

    max_map_features: Positive = 1000
    """Features of a map image that are used at most, those of the longest tracks."""
    max_query_features: Positive = 1536
    """Features of a query image that are matched by descriptors alone, the strongest; guided passes use all."""
    ransac_max_error_deg: PositiveNumber = 0.45
    """Largest reprojection error of an inlier in RANSAC."""
    ransac_max_trials: Positive = 5000
    """Samples that RANSAC draws at most."""
    clear_inlier_ratio: Share = 0.56
    """With more inliers than this share of the matches, no other pose is looked for: what is left over cannot support
    one by more than `ok_rival_support`."""
    contested_inlier_ratio: Share = 0.4
    """With fewer, the pose may lie between two: it is sought again under a tighter limit, and by single references."""
    contested_references: Natural = 4
    """References, those with the most matches, that then give a pose each: together, look-alikes can outvote the one
    that shows the place."""
    guided_radii_deg: list[PositiveNumber] = [0.7, 0.35]
    """Search radius around a projected map point, one guided pass each."""
    max_ransac_matches: Positive = 2500
    """Matches that RANSAC sees at most, a random choice: the guided passes find the rest again."""
    max_guided_matches: Positive = 1000
    """Guided matches of a camera at most, the most alike."""
    guided_images: Positive = 12
    """Covisible map images whose points are projected."""
    max_error_deg: PositiveNumber = 0.17
    """Largest reprojection error of an inlier of the final pose."""
    min_inliers: Positive = 12
    """Fewer independently matched inliers than this are no pose."""
    ok_probability: Share = 0.99
    """Probability of being right, within 5 degrees and 0.5 m, that a pose needs to be `ok`: see
    `localizers/confidence.py`."""
    ok_rival_support: PositiveNumber = 0.8
    """Support of the best other pose, relative to this one's, up to which a pose is `ok`."""
    sure_position_std_m: PositiveNumber = 0.05
    """Largest standard deviation of the position, meters, with which a pose that is `ok` is precise enough that no
    further features are asked."""


CONDITIONED = ("da3-base", "da3-small")
"""Names of predictors that can be told cameras."""


class PredictorSettings(Settings):
    """The network that predicts cameras, and what it is shown."""

    shorthand = "name"
    name: Literal["vggt", "vggt-omega", "da3-base", "da3-small", "simulated"] = "vggt"
    """What `feed_forward` and `hybrid` ask; `simulated` looks up true poses, for trying things out."""
    checkpoint: str | None = None
    """File with the network's weights; null: the hub's cache, else a download."""
    num_references: Positive = 5
    """Map images that the network is shown with each query image."""
    candidates: Positive | None = None
    """Retrieved images to choose them from, the best so many; null: all."""
    batch_size: Positive = 4
    """Query devices that the network is given at once. Poses do not depend on it."""
    compile: bool = False
    """Compile the network's blocks by `torch.compile`, which takes a minute or more at the start of each run, and on a
    CPU a C++ compiler. Changes rounding only."""
    upright: bool = True
    """Show the network images turned so that gravity points down."""
    depth_points: Positive = 200
    """Map points of a reference at most whose depth is compared, those of the longest tracks."""
    least_points: Natural = 20
    """With fewer, the capture's depth map of the reference is asked, where there is one."""
    conditioned: bool = False
    """Tell a network that takes cameras (da3-base, da3-small) those of the map: the intrinsics of all views, and of six
    references or more the poses of every other one. The rest align the prediction. Officially all cameras are told or
    none; what a partly told scene gains is not measured."""

    @model_validator(mode="after")
    def _cameras_to_who_takes_them(self) -> Self:
        if self.conditioned and self.name not in CONDITIONED:
            raise ValueError(
                f"conditioned is true, but {self.name} cannot be told cameras; expected the name to be one of "
                f"{', '.join(CONDITIONED)}, or conditioned: false"
            )
        return self


Method = Annotated[
    Literal["pnp", "nearest", "feed_forward", "hybrid"],
    BeforeValidator(lambda value: "feed_forward" if value == "vggt" else value),  # its name until there were others
]


class LocalizeSettings(Settings):
    """How poses are found."""

    method: Method = "pnp"
    """pnp: matches with map points; nearest: the pose of the best reference, to compare against; feed_forward: a
    network's cameras, aligned to the map; hybrid: the better supported of pnp and that, each helped by the other."""
    features: FeaturesSettings = FeaturesSettings()
    """Local features."""
    matcher: MatcherSettings = MatcherSettings()
    """How a query image is matched with its references, for the kinds of features that the matcher suits."""
    map: MapSettings | None = MapSettings()
    """How the map is triangulated; null: it is not, and points are triangulated for each query, from its references."""
    pnp: PnpSettings = PnpSettings()
    """How a pose is found from matches."""
    predictor: PredictorSettings = PredictorSettings()
    """Of `feed_forward` and `hybrid`."""
    compute_device: ComputeDevice = "auto"
    """Where networks run: auto, cpu, cuda, cuda:<number> or mps."""
    dtype_compute: Precision = "auto"
    """Precision of networks; auto: what is fast on the device."""
    seed: Natural = 0
    """Of RANSAC. The same seed gives the same poses, whatever the number of threads."""
    world_up: Direction | None = None
    """Direction that is up in the map's world; null: estimated from its cameras."""
    unit: Unit = "m"
    """Unit of the capture's poses; null: not known, and limits are relative to the depth of what the map shows."""

    @property
    def predicts(self) -> bool:
        """Whether the method asks a network for cameras."""
        return self.method in ("feed_forward", "hybrid")

    @model_validator(mode="after")
    def _a_map_or_meters(self) -> Self:
        if self.unit is None and self.map is None:
            raise ValueError("unit and map are null; the depth that limits are relative to is that of a map")
        return self


class EvaluateSettings(Settings):
    """What is counted."""

    thresholds: list[Threshold] = [[1.0, 0.1], [5.0, 0.5], [5.0, 1.0]]
    """Recall is counted at these (degrees, meters)."""
    retrieval_ks: list[Positive] = [1, 5, 10]
    """Retrieval recall is counted at these numbers of references."""
    retrieval_radius_m: PositiveNumber = 8.0
    """A good reference is at most so far from the query, meters ..."""
    retrieval_angle_deg: PositiveNumber = 45.0
    """... and looks in a direction at most so different. The roll about the viewing direction does not count."""


class VisualizeSettings(Settings):
    """What is drawn and recorded."""

    samples: Natural = 2
    """Queries shown of each pair, from the worst to the best."""
    recordings: bool = True
    """Write a recording of each pair for the rerun viewer."""
    matched_queries: Natural = 12
    """Queries of each pair shown in it with references and matches, the worst first."""
    session_recordings: bool = True
    """Write a recording of each session."""
    keyframes_only: bool = False
    """Recordings of query sessions hold only keyframes."""
    every: Positive | None = None
    """Recordings of sessions hold every so many frames; null: so that a session has at most 1000 images."""
    world_up: Direction | None = None
    """Direction that is up in the world; null: estimated from the cameras."""
