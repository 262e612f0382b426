"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018): learned keypoints and descriptors.

The network is that of the package `transformers`, of which only `encoder`, `keypoint_decoder` and
`descriptor_decoder` are used: its processor would squeeze every photograph to 640 x 480.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import ToolkitError
from toolkit.features.features import LocalFeatures
from toolkit.manifest import SuperPointSettings
from toolkit.models.compute import Fitting, resolve_device, resolve_precision
from toolkit.models.weights import SUPERPOINT, WeightsSource, load_checkpoint, resolve_weights, weights_digest

DESCRIPTOR_LENGTH = 256
# Side of the cells of the network's coarsest grid, pixels.
_CELL = 8
# Few images keep a CPU busy; more at once take more memory and no less time.
_BATCH = {"cpu": 2}
_BATCH_ELSEWHERE = 16


def import_transformers(model: str) -> Any:
    """Return the package `transformers`.

    Raises:
        ToolkitError: it is not installed; says how to install it.
    """
    try:
        import transformers
    except ImportError as error:
        raise ToolkitError(
            f"{model} needs the package transformers, which cannot be imported ({error}). Install it, in the folder "
            "of this project: python -m pip install --constraint constraints.txt --editable '.[learned]'. "
            "Or use `sift` features, which need nothing else."
        ) from error
    return transformers


def load_network(
    source: WeightsSource,
    checkpoint: str | Path | Mapping[str, Tensor] | None,
    build: Callable[[Any], Any],
    ignore: tuple[str, ...] = (),
) -> Any:
    """Return a network of `transformers` with official weights, float32, on the CPU, ready to use.

    Args:
        checkpoint: the official file, or its tensors by name; None: the hub's cache, else a download.
        ignore: prefixes of tensors in the file that the network does not use.

    Raises:
        WeightsError: no weights, or other ones; names missing, unexpected and mis-shaped keys.
        ToolkitError: the package is missing; before a download.
    """
    with torch.device("meta"):
        network = build(import_transformers(source.model))
    if checkpoint is None or isinstance(checkpoint, str | Path):
        checkpoint = resolve_weights(source, checkpoint)
    load_checkpoint(network, checkpoint, source.model, ignore)
    return network


class SuperPointExtractor:
    """Extracts SuperPoint features: keypoints at whole pixels, unit descriptors (256,), on any device.

    Images of one size run together. The features of an image do not depend on the others in the batch.
    """

    color = False
    threaded = False

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        settings: SuperPointSettings | None = None,
    ) -> None:
        """
        Args:
            checkpoint: the official file, or its tensors by name (shared, not copied); None: from the hub's cache,
                else downloaded there.
            device: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
            dtype: of the encoder: `float32`, `bfloat16`, `float16`; `auto`: the fastest on the device. The heads are
                always float32, so that neighboring pixels do not tie.
            batch_size: most images at a time; None: as suits the device.

        Raises:
            WeightsError: no weights, or other ones.
            ManifestError: no such device, precision or setting.
            ToolkitError: the package transformers is missing, or the device.
        """
        self._settings = settings or SuperPointSettings()
        self._device = resolve_device(device)
        self._dtype = resolve_precision(dtype, self._device)
        self.batch_size = batch_size or _BATCH.get(self._device.type, _BATCH_ELSEWHERE)
        model = load_network(SUPERPOINT, checkpoint, self._build)
        self._weights = weights_digest(model)
        self._model = model.to(self._device)
        self._fitting: dict[tuple[int, int], Fitting] = {}

    @property
    def settings(self) -> dict[str, Any]:
        precision = str(self._dtype).removeprefix("torch.")
        return {
            "name": "superpoint", "weights": self._weights, "dtype_compute": precision, **self._settings.model_dump()
        }  # fmt: skip

    def _build(self, transformers: Any) -> Any:
        # Borders and the number of keypoints are left to `_forward`, which knows where the photograph ends.
        config = transformers.SuperPointConfig(
            keypoint_threshold=float(self._settings.threshold),
            nms_radius=self._settings.nms_radius,
            max_keypoints=-1,
            border_removal_distance=0,
        )
        return transformers.SuperPointForKeypointDetection(config)

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, (H, W) gray or (H, W, 3) RGB, uint8, of any sizes; float16 descriptors.

        Raises:
            ValueError: another shape or type.
            ToolkitError: a response is not finite, or not even one image fits the device's memory.
        """
        prepared = [self._prepare(image) for image in images]
        of_size: dict[tuple[int, int], list[int]] = {}
        for number, image in enumerate(prepared):
            of_size.setdefault(image.shape, []).append(number)
        features: dict[int, LocalFeatures] = {}
        for size, numbers in of_size.items():
            fitting = self._fitting.setdefault(size, Fitting(partial(self._forward, size=size), "images"))
            for start in range(0, len(numbers), self.batch_size):
                part = numbers[start : start + self.batch_size]
                # Whole cells: the last column and row are repeated, so that the image's border is no edge.
                margins = [(0, 0), *((0, -side % _CELL) for side in size)]
                batch = torch.from_numpy(np.pad(np.stack([prepared[number] for number in part]), margins, mode="edge"))
                with torch.inference_mode():
                    packed = fitting(batch.to(self._device)).cpu().numpy()
                for number, rows in zip(part, packed, strict=True):
                    features[number] = _unpack(rows, size, images[number].shape)
        return [features[number] for number in range(len(images))]

    def _prepare(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image in gray and of the size that the network sees."""
        image = np.asarray(image)
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)) or not image.size:
            raise ValueError(f"an image is {image.dtype} {image.shape}; expected uint8 (H, W) or (H, W, 3) RGB.")
        if image.ndim == 3:
            image = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
        height, width = image.shape
        factor = self._settings.max_long_side / max(height, width)
        if factor >= 1:
            return image
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _forward(self, batch: Tensor, size: tuple[int, int]) -> Tensor:
        """Return x, y, response and descriptor of keypoints, (B, K, 3 + 256), strongest first, then rows of zeros.

        Args:
            batch: (B, H, W) uint8, padded at the right and below to whole cells.
            size: (H, W) without that. In x and y the center of the top-left pixel is at 0.
        """
        settings, model = self._settings, self._model
        pixels = batch[:, None].float() / 255
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            encoded = model.encoder(pixels).last_hidden_state
        most = settings.max_keypoints
        packed = torch.zeros(len(batch), most, 3 + DESCRIPTOR_LENGTH, device=batch.device)
        last = torch.tensor(size[::-1], device=batch.device) - settings.border
        for row, features in zip(packed, encoded.float().split(1), strict=True):
            keypoints, responses = model.keypoint_decoder(features)
            inside = ((keypoints >= settings.border) & (keypoints < last)).all(dim=1)
            keypoints, responses = keypoints[inside], responses[inside]
            responses, order = responses.sort(descending=True, stable=True)
            keypoints, responses = keypoints[order[:most]], responses[:most]
            if len(keypoints):
                descriptors = model.descriptor_decoder(features, keypoints.clone())
                row[: len(keypoints)] = torch.cat([keypoints, responses[:, None], descriptors], dim=1)
            elif not features.isfinite().all():
                row[0] = torch.nan  # what is not finite is above no threshold
        return packed


def _unpack(rows: NDArray[np.float32], size: tuple[int, int], shape: tuple[int, ...]) -> LocalFeatures:
    """Return what `_forward` found in an image (H, W) of `size`, in the pixels of the photograph of `shape`."""
    if not np.isfinite(rows).all():
        raise ToolkitError(
            "SuperPoint gave a response or a descriptor that is not finite. Its weights may hold NaN: compare the "
            "file with the official one. With float16, numbers may have been too large: use bfloat16 or float32."
        )
    rows = rows[rows[:, 2] > 0]
    (rows_shown, columns_shown), (height, width) = size, shape[:2]
    # Pixel centers of the network are at whole numbers; resizing keeps corners, not centers, where they are.
    keypoints = (rows[:, :2] + 0.5) * np.array([width / columns_shown, height / rows_shown])
    return LocalFeatures(
        keypoints.astype(np.float32),
        np.ones(len(rows), np.float32),
        rows[:, 2].copy(),
        rows[:, 3:].astype(np.float16),
        (width, height),
    )
