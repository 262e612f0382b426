"""Extractors that run a network: image sizes, batches, the way back to the image's pixels; ALIKED and SuperPoint. And
LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023), which matches the learned features of two images.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from toolkit.errors import ManifestError, ToolkitError, optional
from toolkit.features.features import LocalFeatures, PairMatches
from toolkit.features.matching import MATCHER_WEIGHTS
from toolkit.files import Remade
from toolkit.manifest import AlikedSettings, SuperPointSettings
from toolkit.models.aliked import Aliked, find_keypoints
from toolkit.models.compute import Fitting, in_single_threads, on_device, resolve_device, resolve_precision
from toolkit.models.lightglue import LightGlue, official_names
from toolkit.models.weights import ALIKED, SUPERPOINT, load_checkpoint, resolve_weights, weights_digest
from toolkit.threads import release_memory

NOT_FINITE = "Its weights may hold NaN: compare the file with the official one. Or float16 overflowed: use bfloat16."
_DESCRIPTOR_LENGTHS = {"superpoint": 256, "aliked": 128}


class NetworkExtractor(Remade):
    """Extracts features with a network, on any device.

    Images of equal size run as a batch. The features of an image do not depend on the rest of the batch.
    """

    color: bool
    threaded = False
    name: ClassVar[str]  # key of the features in `KINDS`
    title: ClassVar[str]  # name of the network in messages
    cpu_batch = 2  # images per batch on a CPU: more take more memory and are not faster; 0: one per thread of torch
    min_long_side = 0  # smaller images are enlarged to this length of the longer side, pixels
    defaults: ClassVar[AlikedSettings | SuperPointSettings]

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        settings: AlikedSettings | SuperPointSettings | None = None,
    ) -> None:
        """Take the official file of the network, or its tensors by name; None: an installed package, a cache, or a
        download.

        `dtype` is the precision of the encoder (`auto`: float32 on a CPU, else the fastest); positions, scores and
        descriptors are always computed in float32. `batch_size` is the largest number of images per batch; None:
        depends on the device. `settings` are `defaults` by default.

        Raises:
            WeightsError: the weights are missing, or are those of another network.
            ManifestError: unknown device, precision or setting.
            ToolkitError: a package or the device is missing.
        """
        self._values: Any = settings or self.defaults
        self._device = resolve_device(device)
        # All CPUs extract the same features.
        dtype = "float32" if dtype == "auto" and self._device.type == "cpu" else dtype
        self._dtype = resolve_precision(dtype, self._device)
        on_cpu = self.cpu_batch or torch.get_num_threads()
        self.batch_size = batch_size or (on_cpu if self._device.type == "cpu" else 16)
        model = self._load(checkpoint)
        self._weights = weights_digest(model)
        self._model: Any = on_device(model, self._device, self.title)
        self._fitting: dict[tuple[int, ...], Fitting] = {}

    @property
    def settings(self) -> dict[str, Any]:
        precision = str(self._dtype).removeprefix("torch.")
        return {"name": self.name, "weights": self._weights, "dtype_compute": precision, **self._values.model_dump()}

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> nn.Module:
        """Return the network with its weights, on the CPU."""
        raise NotImplementedError

    def _forward(self, batch: Tensor) -> Tensor:
        """Return x, y, score and descriptor of keypoints, (B, K, 3 + D), strongest first, padded with rows of zeros, of
        images (B, H, W) or (B, H, W, 3), uint8, in the size of the network's input. The center of the top-left pixel is
        at 0.

        If the scores of an image are not finite, it has a row that is not finite.
        """
        raise NotImplementedError

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, (H, W) gray or (H, W, 3) RGB, uint8, of any sizes; float16 descriptors.

        Raise ValueError if an image has another shape or type; ToolkitError if a response is not finite, or not even
        one image fits the device's memory.
        """
        prepared = [self._prepare(image) for image in images]
        by_shape: dict[tuple[int, ...], list[int]] = {}
        for number, image in enumerate(prepared):
            by_shape.setdefault(image.shape, []).append(number)
        features: dict[int, LocalFeatures] = {}
        for shape, numbers in by_shape.items():
            fitting = self._fitting.setdefault(shape, Fitting(self._forward, "images", self._device))
            for start in range(0, len(numbers), self.batch_size):
                in_batch = numbers[start : start + self.batch_size]
                batch = torch.from_numpy(np.stack([prepared[number] for number in in_batch]))
                with torch.inference_mode():
                    packed = fitting(batch).cpu().numpy()
                for number, rows in zip(in_batch, packed, strict=True):
                    features[number] = self._unpack(rows, shape, images[number].shape)
        return [features[number] for number in range(len(images))]

    def _prepare(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image with the size and the channels of the network's input."""
        image = np.asarray(image)
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)) or not image.size:
            raise ValueError(f"found an image {image.dtype} {image.shape}; expected uint8 (H, W) or (H, W, 3) RGB.")
        if image.ndim == 3 and not self.color:
            image = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
        height, width = image.shape[:2]
        long_side = max(height, width)
        factor = min(max(long_side, self.min_long_side), self._values.max_long_side) / long_side
        if factor != 1:
            size = (max(1, round(width * factor)), max(1, round(height * factor)))
            interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
            image = np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)
        return np.repeat(image[:, :, None], 3, axis=2) if self.color and image.ndim == 2 else image

    def _unpack(self, rows: NDArray[np.float32], resized: tuple[int, ...], shape: tuple[int, ...]) -> LocalFeatures:
        """Return the features of an image of shape `shape`, from the output of `_forward` for shape `resized`."""
        if not np.isfinite(rows).all():
            raise ToolkitError(f"{self.title} gave a response or a descriptor that is not finite. {NOT_FINITE}")
        rows = rows[rows[:, 2] > 0]
        (resized_height, resized_width), (height, width) = resized[:2], shape[:2]
        # The network's pixel centers are at integers; resizing maps the corners of the image onto each other.
        keypoints = (rows[:, :2] + 0.5) * np.array([width / resized_width, height / resized_height])
        descriptors = rows[:, 3:].astype(np.float16)  # gives the same 5,321 mutual matches of ALIKED as float32
        scales, scores = np.ones(len(rows), np.float32), rows[:, 2].copy()
        return LocalFeatures(keypoints.astype(np.float32), scales, scores, descriptors, (width, height))


class AlikedExtractor(NetworkExtractor):
    """ALIKED (Zhao et al., IEEE Transactions on Instrumentation and Measurement, 2023): learned local features.

    Keypoints with subpixel positions, unit descriptors (128,).
    """

    min_score = 0.02  # of a keypoint; the authors' 0.2 leaves few in dark images, and plain walls stay below 0.02
    nms_radius = 2  # pixels of the resized image: two maxima are further apart in x or in y
    color = True
    name = "aliked"
    title = "ALIKED"
    min_long_side = 640
    cpu_batch = 0
    defaults = AlikedSettings()

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> Aliked:
        model = self._values.model
        return Aliked.from_checkpoint(resolve_weights(ALIKED[model], checkpoint), model)

    def _forward(self, batch: Tensor) -> Tensor:
        if batch.device.type == "cpu":
            return torch.cat(in_single_threads(self._run, batch.split(1)))
        return self._run(batch)

    def _run(self, batch: Tensor) -> Tensor:
        settings, model = self._values, self._model
        pixels = batch.permute(0, 3, 1, 2).float() / 255
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            levels = model.encode(pixels)
        packed = torch.zeros(len(batch), settings.max_keypoints, 3 + model.descriptor_length, device=batch.device)
        for number, (row, scores) in enumerate(zip(packed, model.scores(levels), strict=True)):
            if not scores.isfinite().all():
                row[0] = torch.nan
                continue
            keypoints, values = find_keypoints(scores, settings.max_keypoints, self.min_score, self.nms_radius)
            descriptors = model.describe(levels, number, keypoints)
            row[: len(keypoints)] = torch.cat([keypoints, values[:, None], descriptors], dim=1)
        return packed


class SuperPointExtractor(NetworkExtractor):
    """SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018): learned local features.

    Keypoints at integer pixels, unit descriptors (256,).

    The network comes from the package `transformers`. Only its `encoder`, `keypoint_decoder` and `descriptor_decoder`
    are used, because its image processor would squeeze every image to 640 x 480.
    """

    min_response = 0.005  # of a keypoint; responses are at most 1
    nms_radius = 4  # pixels of the resized image: two keypoints are further apart in x or in y
    border = 4  # keypoints closer to the image border are dropped, pixels of the resized image
    color = False
    name = "superpoint"
    title = "SuperPoint"
    defaults = SuperPointSettings()

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> nn.Module:
        transformers = optional("transformers")
        # `_forward` limits border and number of keypoints, because only it knows the unpadded size of the image.
        limits: Any = {"keypoint_threshold": self.min_response, "nms_radius": self.nms_radius}
        config = transformers.SuperPointConfig(**limits, max_keypoints=-1, border_removal_distance=0)
        with torch.device("meta"):
            network: nn.Module = transformers.SuperPointForKeypointDetection(config)
        load_checkpoint(network, resolve_weights(SUPERPOINT, checkpoint), SUPERPOINT.model)
        return network

    def _forward(self, batch: Tensor) -> Tensor:
        model, limit = self._model, self._values.max_keypoints
        size = batch.shape[1:]
        # Pad to whole cells of 8 pixels by repeating the last column and row, so that the border gives no edge.
        pixels = F.pad(batch[:, None].float() / 255, (0, -size[1] % 8, 0, -size[0] % 8), mode="replicate")
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            encoded = model.encoder(pixels).last_hidden_state
        packed = torch.zeros(len(batch), limit, 3 + 256, device=batch.device)
        last = torch.tensor([size[1], size[0]], device=batch.device) - self.border
        for row, features in zip(packed, encoded.float().split(1), strict=True):
            keypoints, responses = model.keypoint_decoder(features)
            inside = ((keypoints >= self.border) & (keypoints < last)).all(dim=1)
            keypoints, responses = keypoints[inside], responses[inside]
            responses, order = responses.sort(descending=True, stable=True)
            keypoints, responses = keypoints[order[:limit]], responses[:limit]
            if len(keypoints):
                descriptors = model.descriptor_decoder(features, keypoints.clone())
                row[: len(keypoints)] = torch.cat([keypoints, responses[:, None], descriptors], dim=1)
            elif not features.isfinite().all():
                row[0] = torch.nan  # no threshold shows that features are not finite, as NaN is above none
        return packed


# LightGlue


class LightGlueMatcher(Remade):
    """Matches pairs of images of any sizes, with any numbers of learned features, in batches, on any device.

    On a CPU, each thread matches one pair at a time, so its matches do not depend on the other pairs. As the authors'
    code by default, it stops early, and drops features when it is confident that they match nothing: this takes half
    the time. On other devices, every pair of a batch goes through all layers with all its features, and rounding
    depends on the batch.
    """

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        min_score: float = 0.1,
        features: str = "superpoint",
    ) -> None:
        """Take the authors' or the hub's file, see `NetworkExtractor`, for features of the kind `superpoint` or
        `aliked`.

        `dtype` is the precision of the attention blocks, `batch_size` the largest number of pairs per batch (None:
        depends on the device), `min_score` the smallest confidence of a match, from 0 to 1.

        Raises:
            WeightsError: the weights are missing, or are those of another network.
            ManifestError: unknown device, precision or kind, or a confidence out of range.
            ToolkitError: this machine does not have the device.
        """
        if not 0 <= min_score <= 1:
            raise ManifestError(f"lightglue: min_score is {min_score}; expected a confidence from 0 to 1.")
        if features not in _DESCRIPTOR_LENGTHS:
            raise ManifestError(f"lightglue: no weights for {features!r}. Known: {', '.join(_DESCRIPTOR_LENGTHS)}.")
        self._kind = features
        self._min_score = min_score
        self._device = resolve_device(device)
        self._dtype = resolve_precision(dtype, self._device)
        self._one_by_one = self._device.type == "cpu"
        self.batch_size = batch_size or (8 if self._one_by_one else 32)
        source = MATCHER_WEIGHTS["lightglue", features]
        with torch.device("meta"):
            model = LightGlue(_DESCRIPTOR_LENGTHS[features])
        # The hub's file contains a copy of SuperPoint; the authors' newer code stores thresholds for early stopping.
        ignore = ("keypoint_detector.", "confidence_thresholds")
        load_checkpoint(model, resolve_weights(source, checkpoint), source.model, ignore, official_names)
        self._weights = weights_digest(model)
        model.fold_(self._dtype)
        self._model: Any = on_device(model, self._device, "LightGlue")
        self._fitting_images = Fitting(self._encode, "images", self._device)
        self._fitting_pairs = Fitting(lambda pairs: self._forward(*pairs.unbind(1)), "pairs of images", self._device)

    @property
    def settings(self) -> dict[str, Any]:
        numbers = {"dtype_compute": str(self._dtype).removeprefix("torch."), "min_score": self._min_score}
        return {"name": "lightglue", "weights": self._weights, **numbers, "adaptive": self._one_by_one}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images, in the order of the first image's features.

        If several pairs share an image (the same object), it goes through the first half of the first layer only once.
        Raise ToolkitError if features are of another kind, a confidence is not finite, or not even one pair fits the
        device's memory.
        """
        matches = [PairMatches.none() for _ in pairs]
        # Pairs with similar numbers of features form a batch, as all are padded to the largest. The largest come first,
        # so that a batch that does not fit the memory fails at the start.
        sizes = [-max(len(a), len(b)) for a, b in pairs]
        order = [number for number in np.argsort(sizes, kind="stable") if all(map(len, pairs[number]))]
        for features in (features for number in order for features in pairs[number]):
            self._check(features)  # an image without features has no kind of its own
        uses = Counter(id(features) for number in order for features in pairs[number])
        encoded: dict[int, Tensor] = {}
        with torch.inference_mode():
            for start in range(0, len(order), self.batch_size):
                batch = order[start : start + self.batch_size]
                images = [features for number in batch for features in pairs[number]]
                self._encode_new(images, encoded)
                states = [encoded[id(features)] for features in images]
                for number, result in zip(batch, self._match(states), strict=True):
                    matches[number] = _unpack(result.cpu().numpy())
                uses.subtract(map(id, images))
                encoded = {key: value for key, value in encoded.items() if uses[key]}
        return matches

    def _match(self, states: Sequence[Tensor]) -> Iterable[Tensor]:
        """Return the output of `_forward` for consecutive pairs of images, given by their output of `_encode`."""
        if not self._one_by_one:
            return self._fitting_pairs(pad_sequence(list(states), batch_first=True).unflatten(0, (-1, 2)))

        def match_one(pair: tuple[Tensor, Tensor]) -> Tensor:
            matches = self._forward(pair[0][None], pair[1][None])[0]
            release_memory()  # hundreds of megabytes, as the numbers of features differ after each layer
            return matches

        return in_single_threads(match_one, zip(states[::2], states[1::2], strict=True))

    def _check(self, features: LocalFeatures) -> None:
        dtype, shape, expected = features.descriptors.dtype, features.descriptors.shape, _DESCRIPTOR_LENGTHS[self._kind]
        if dtype == np.uint8 or shape[1:] != (expected,):
            wanted = f"descriptors of {self._kind}, (N, {expected}) unit vectors; found {dtype} {shape}"
            raise ToolkitError(f"These weights of LightGlue expect {wanted}. Use the matcher `mutual`.")

    def _encode_new(self, images: Sequence[LocalFeatures], encoded: dict[int, Tensor]) -> None:
        """Add the missing images to `encoded`: by the id of the object, the input (N, 2 + DIM + 1) of `_forward`."""
        new = list({id(features): features for features in images if id(features) not in encoded}.values())
        if self._one_by_one:
            packed = [torch.from_numpy(_pack(features))[None] for features in new]
            for features, rows in zip(new, in_single_threads(self._encode, packed), strict=True):
                encoded[id(features)] = rows[0]
            return
        for start in range(0, len(new), 2 * self.batch_size):
            part = new[start : start + 2 * self.batch_size]
            batch = pad_sequence([torch.from_numpy(_pack(features)) for features in part], batch_first=True)
            for features, rows in zip(part, self._fitting_images(batch), strict=True):
                encoded[id(features)] = rows[: len(features)]

    def _encode(self, batch: Tensor) -> Tensor:
        """Replace the descriptors of images (B, N, 2 + D + 1), see `_pack`, by the network's initial states."""
        xy, mask = batch[..., :2], _mask(batch)
        states = self._model.encode(xy, batch[..., 2:-1], mask)
        return torch.cat([xy, states, batch[..., -1:]], dim=-1)

    def _forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Return for each feature of the first images its partner (-1: none) and the confidence, (B, N, 2).

        Both images (B, N, 2 + DIM + 1) have the normalized x y, the state of the network, and 1; padded with zeros.
        """
        masks = _mask(a), _mask(b)
        partners, scores = self._model((a[..., :2], b[..., :2]), (a[..., 2:-1], b[..., 2:-1]), masks, self._one_by_one)
        partners = partners.where(scores > self._min_score, -1)
        return torch.stack([partners.float(), scores], dim=2)  # exact: there are fewer than 2^24 features


def _mask(images: Tensor) -> Tensor | None:
    """Return which rows of images (B, N, ... + 1) are features, not padding, (B, N); None: all."""
    real = images[..., -1].bool()
    return None if bool(real.all()) else real


def _pack(features: LocalFeatures) -> NDArray[np.float32]:
    """Return the features of an image as `_encode` takes them, (N, 2 + D + 1): normalized x y, descriptor, and 1."""
    features = features.turned(features.turns)  # the network was trained on upright images
    size = np.array(features.image_size, np.float32)
    # As in training: pixel centers at integers, the longer side from -1 to 1.
    xy = (features.keypoints - 0.5 - size / 2) / (size.max() / 2)
    return np.concatenate([xy, features.descriptors, np.ones((len(xy), 1))], axis=1, dtype=np.float32)


def _unpack(result: NDArray[np.float32]) -> PairMatches:
    """Return the matches of one pair, from its output (N, 2) of `_forward`."""
    if not np.isfinite(result).all():
        raise ToolkitError(f"LightGlue gave a confidence that is not finite. {NOT_FINITE}")
    partners = result[:, 0].astype(np.int64)
    matched = np.flatnonzero(partners >= 0)
    return PairMatches(np.stack([matched, partners[matched]], axis=1), result[matched, 1].copy())
