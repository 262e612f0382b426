"""MegaLoc as an embedder: resizes images of any size and embeds them in batches, on any device."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from toolkit.errors import ManifestError, ToolkitError
from toolkit.features.network import NOT_FINITE
from toolkit.files import Remade
from toolkit.models.compute import Fitting, is_out_of_memory, on_device, resolve_device, resolve_precision, upload
from toolkit.models.megaloc import PATCH, MegaLoc
from toolkit.models.vit import normalized
from toolkit.models.weights import MEGALOC, resolve_weights, weights_digest


class MegaLocEmbedder(Remade):
    """Global descriptors by MegaLoc, (8448,) unit vectors."""

    name = "megaloc"
    inputs: Literal["images"] = "images"
    upright = True

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | MegaLoc | None = None,
        device: str = "auto",
        dtype_compute: str = "auto",
        image_size: int = 322,
    ) -> None:
        """Take the official file, its tensors by name, or a network; None: the hub's cache, or a download.

        Images are resized to a square of `image_size` pixels, a multiple of 14, whatever their aspect ratio.

        Raises:
            WeightsError: the weights are missing, or of another network.
            ManifestError, ToolkitError: see `toolkit.models.compute`.
        """
        if not isinstance(image_size, int) or image_size < 9 * PATCH or image_size % PATCH:
            expected = f"a multiple of {PATCH}, at least {9 * PATCH} (322 is usual)"
            raise ManifestError(f"image_size is {image_size}; expected {expected}.")
        self._size = image_size
        # Images may be decoded at twice the network's size, as Pillow does for thumbnails. The cosines to descriptors
        # of fully decoded images are then above 1 - 1e-4, the error of bfloat16; at the network's size, 1 - 1e-3.
        self.min_side = 2 * image_size
        self._device = resolve_device(device)
        self._dtype = resolve_precision(dtype_compute, self._device)
        weights: Path | Mapping[str, Tensor] | MegaLoc = resolve_weights(MEGALOC, checkpoint)
        # Copy the caller's network: its type and device must not change.
        model = deepcopy(weights) if isinstance(weights, MegaLoc) else MegaLoc.from_checkpoint(weights)
        self._weights = weights_digest(model)
        self.dim = model.dim
        model.compute_in(self._dtype)
        self._model = on_device(model, self._device, "MegaLoc").eval()
        self._fitting = Fitting(self._forward, "images", self._device)

    @property
    def settings(self) -> dict[str, Any]:
        sizes = {"image_size": self._size, "least_side": self.min_side}
        precision = str(self._dtype).removeprefix("torch.")
        return {"name": self.name, "weights": self._weights, **sizes, "dtype_compute": precision}

    def prepare(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resize an image (H, W, 3) or (H, W), uint8 RGB or gray, to (S, S, 3); raise ValueError if it is none."""
        image = np.asarray(image)
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)) or not image.size:
            raise ValueError(f"an image is {image.dtype} {image.shape}; expected uint8 (H, W, 3) RGB or (H, W).")
        if image.ndim == 2:
            image = np.repeat(image[:, :, None], 3, axis=2)
        if image.shape[:2] == (self._size, self._size):
            return image
        # Pillow's bilinear filter is antialiased, as the resizing of the official code.
        square = (self._size, self._size)
        return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize(square, Image.Resampling.BILINEAR))

    def stack(self, inputs: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return images (H, W, 3), uint8 RGB, of any sizes as a batch (B, S, S, 3), on the device if it fits there."""
        batch = torch.from_numpy(np.stack([self.prepare(image) for image in inputs]))
        try:
            return upload(batch, self._device)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
        return batch  # `embed` moves it there in parts

    def embed(self, inputs: Sequence[NDArray[np.uint8]] | Tensor) -> NDArray[np.float32]:
        """Return unit vectors (B, 8448) of images (H, W, 3), uint8 RGB, of any sizes, or of a batch from `stack`.

        Raises:
            ToolkitError: a vector is not finite.
        """
        if not len(inputs):
            return np.zeros((0, self.dim), np.float32)
        batch = inputs if isinstance(inputs, Tensor) else self.stack(inputs)
        with torch.inference_mode():
            vectors = self._fitting(batch).float().cpu().numpy()
        if not np.isfinite(vectors).all():
            raise ToolkitError(f"MegaLoc returned a descriptor that is not finite. {NOT_FINITE}")
        return vectors

    def _forward(self, images: Tensor) -> Tensor:
        descriptors: Tensor = self._model(normalized(images.permute(0, 3, 1, 2).float() / 255))
        return descriptors
