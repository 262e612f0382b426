"""Extractors that run a network: image sizes, batches, the way back to the image's pixels; ALIKED and SuperPoint."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from toolkit.errors import ToolkitError, optional
from toolkit.features.features import LocalFeatures
from toolkit.files import Remade
from toolkit.manifest import AlikedSettings, SuperPointSettings
from toolkit.models.aliked import Aliked, find_keypoints
from toolkit.models.compute import Fitting, in_single_threads, on_device, resolve_device, resolve_precision
from toolkit.models.weights import ALIKED, SUPERPOINT, given_or_resolved, load_checkpoint, weights_digest

NOT_FINITE = "Its weights may hold NaN: compare the file with the official one. Or float16 overflowed: use bfloat16."


class NetworkExtractor(Remade):
    """Extracts features with a network, on any device.

    Images of equal size run as a batch. The features of an image do not depend on the rest of the batch.
    """

    color: bool
    threaded = False
    name: ClassVar[str]  # key of the features in `KINDS`
    title: ClassVar[str]  # name of the network in messages
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
        self.batch_size = batch_size or (self._batch_on_cpu() if self._device.type == "cpu" else 16)
        model = self._load(checkpoint)
        self._weights = weights_digest(model)
        self._model: Any = on_device(model, self._device, self.title)
        self._fitting: dict[tuple[int, ...], Fitting] = {}

    @property
    def settings(self) -> dict[str, Any]:
        precision = str(self._dtype).removeprefix("torch.")
        return {"name": self.name, "weights": self._weights, "dtype_compute": precision, **self._values.model_dump()}

    def _batch_on_cpu(self) -> int:
        return 2  # larger batches take more memory and are not faster

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
    defaults = AlikedSettings()

    def _batch_on_cpu(self) -> int:
        return torch.get_num_threads()

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> Aliked:
        model = self._values.model
        return Aliked.from_checkpoint(given_or_resolved(ALIKED[model], checkpoint), model)

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
        load_checkpoint(network, given_or_resolved(SUPERPOINT, checkpoint), SUPERPOINT.model)
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
