"""What hloc imports from the package `lightglue`, on kornia's networks: ALIKED and its LightGlue, for hloc_worker.py.

That package needs torchvision; kornia has both networks in plain PyTorch. hloc's own wrappers call what is here with
hloc's own settings. Early stopping and pruning of features are kornia's, which are those of the package.
"""

import re
from typing import Any

import kornia.feature
import torch

WEIGHTS: dict[str, str] = {}
"""Files of the official weights, by class."""


class ALIKED(kornia.feature.ALIKED):
    """Called with {"image": (1, 3, H, W)}; gives lists of an entry for each image."""

    def __init__(self, **conf: Any) -> None:
        super().__init__(**conf)
        _load(self)

    def forward(self, data: dict[str, Any]) -> dict[str, Any]:
        images = super().forward(data["image"])
        return {key: [getattr(image, key) for image in images] for key in vars(images[0])}


class LightGlue(kornia.feature.LightGlue):
    def __init__(self, features: str, **conf: Any) -> None:
        super().__init__(None, input_dim=self.features[features]["input_dim"], **conf)
        _load(self)


def _load(network: torch.nn.Module) -> None:
    """Load the official weights; buffers that only kornia has keep their values."""
    state = torch.load(WEIGHTS[type(network).__name__], map_location="cpu", weights_only=True)
    # The authors' first release of LightGlue has other names.
    state = {re.sub(r"^(self|cross)_attn\.(\d+)", r"transformers.\2.\1_attn", key): state[key] for key in state}
    missing, unexpected = network.load_state_dict(state, strict=False)
    learned = dict(network.named_parameters())
    if unexpected or any(key in learned for key in missing):
        raise SystemExit(f"{type(network).__name__}: other weights; missing {missing}, unexpected {unexpected}.")
