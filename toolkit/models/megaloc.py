"""MegaLoc (Berton and Masone, 2025): a global descriptor of images for place recognition.

A DINOv2 ViT-B/14, whose patches are aggregated by optimal transport (SALAD, Izquierdo and Civera, CVPR 2024). The
official network is MIT-licensed, at github.com/gmberton/MegaLoc.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.vit import PATCH, Dinov2, set_matrix_type
from toolkit.models.weights import load_checkpoint

_SINKHORN_STEPS = 3


class Backbone(Dinov2):
    """DINOv2 without registers."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the patches (B, N, C), row by row, and the class token (B, C) of images (B, 3, H, W)."""
        x = self.norm(self._tokens(images))
        return x[:, 1:], x[:, 0]


class PatchMlp(nn.Sequential):
    """Two linear layers on each patch, (B, N, C) -> (B, N, out); the checkpoint stores them as 1 x 1 convolutions."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        # The identity takes the position of the dropout in training, so that keys have the official numbers.
        super().__init__(nn.Conv2d(dim, hidden, 1), nn.Identity(), nn.ReLU(), nn.Conv2d(hidden, out, 1))

    def forward(self, patches: Tensor) -> Tensor:
        first: Any = self[0]
        last: Any = self[3]
        # Linear layers, unlike convolutions, need no arrangement of the patches in rows and columns.
        hidden = F.relu(F.linear(patches, first.weight.flatten(1), first.bias))
        return F.linear(hidden, last.weight.flatten(1), last.bias)


class Salad(nn.Module):
    """Aggregation: assigns patches to clusters by optimal transport, and sums their features per cluster."""

    def __init__(self, dim: int, clusters: int, cluster_dim: int, token_dim: int, hidden: int) -> None:
        super().__init__()
        self.token_features = nn.Sequential(nn.Linear(dim, hidden), nn.ReLU(), nn.Linear(hidden, token_dim))
        self.cluster_features = PatchMlp(dim, hidden, cluster_dim)
        self.score = PatchMlp(dim, hidden, clusters)
        self.dust_bin = nn.Parameter(torch.empty(()))

    def forward(self, patches: Tensor, cls_token: Tensor) -> Tensor:
        """Return unit vectors (B, token_dim + cluster_dim * clusters) of patches (B, N, C) and class tokens (B, C)."""
        features = self.cluster_features(patches)
        share = transport(self.score(patches).transpose(1, 2).float(), self.dust_bin)
        clusters = features.float().transpose(1, 2) @ share.transpose(1, 2)  # (B, cluster_dim, clusters)
        token = F.normalize(self.token_features(cls_token).float(), dim=-1)
        return F.normalize(torch.cat([token, F.normalize(clusters, dim=1).flatten(1)], dim=-1), dim=-1)


def transport(scores: Tensor, dust_bin: Tensor) -> Tensor:
    """Return the share of each patch that each cluster receives, (B, M, N), for scores (B, M, N), N > M.

    Sinkhorn's iteration on logarithms (Cuturi, NeurIPS 2013). The margins require that each of the M clusters receives
    one patch in total, and that a dust bin (an additional row with the score `dust_bin`) receives the other N - M.
    """
    B, M, N = scores.shape
    scores = torch.cat([scores, dust_bin.to(scores.dtype).expand(B, 1, N)], dim=1)
    log_received = scores.new_zeros(M + 1)
    log_received[M] = math.log(N - M)
    log_given = 0.0
    # The factor 1 / (N + M) of both margins cancels.
    columns = scores.new_zeros(B, 1, N)
    for _ in range(_SINKHORN_STEPS):
        rows = log_received[:, None] - torch.logsumexp(scores + columns, dim=2, keepdim=True)
        columns = log_given - torch.logsumexp(scores + rows, dim=1, keepdim=True)
    return torch.exp(scores + rows + columns)[:, :M]


class Aggregator(nn.Module):
    """Computes the descriptor, before its last normalization, from the patches and the class token."""

    def __init__(self, dim: int, clusters: int, cluster_dim: int, token_dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.agg = Salad(dim, clusters, cluster_dim, token_dim, hidden)
        self.linear = nn.Linear(token_dim + clusters * cluster_dim, out)

    def forward(self, patches: Tensor, cls_token: Tensor) -> Tensor:
        """Return (B, out) of patches (B, N, C) and class tokens (B, C)."""
        return self.linear(self.agg(patches, cls_token).to(self.linear.weight.dtype))


class MegaLoc(nn.Module):
    """The network: maps images to unit vectors. The defaults are the official sizes."""

    def __init__(
        self,
        dim: int = 768,
        depth: int = 12,
        num_heads: int = 12,
        grid: int = 37,
        clusters: int = 64,
        cluster_dim: int = 256,
        token_dim: int = 256,
        hidden: int = 512,
        out: int = 8448,
    ) -> None:
        """`dim`, `depth`, `num_heads` are sizes of the transformer, whose position embedding was trained for a `grid`
        of patches; `clusters`, `cluster_dim`, `token_dim`, `hidden` those of the aggregation; `out` of the descriptor.
        """
        super().__init__()
        self.clusters = clusters
        self.dim = out
        """Length of the descriptor."""
        self.backbone = Backbone(dim, depth, num_heads, grid)
        self.aggregator = Aggregator(dim, clusters, cluster_dim, token_dim, hidden, out)

    @classmethod
    def from_checkpoint(cls, checkpoint: str | Path | Mapping[str, Tensor]) -> "MegaLoc":
        """Return the network with official weights, float32, on the CPU, in evaluation mode.

        Args:
            checkpoint: the official `model.safetensors`, or its tensors by name (shared, not copied).

        Raises:
            WeightsError: no checkpoint, or one of another model; names missing, unexpected, mis-shaped keys.
        """
        with torch.device("meta"):
            model = cls()
        load_checkpoint(model, checkpoint, "MegaLoc")
        return model

    def compute_in(self, dtype: torch.dtype) -> None:
        """Choose the data type of the transformer's matrix products; its sums and the aggregation stay float32.

        With bfloat16, the cosines to the float32 descriptors are above 1 - 1e-5; with bfloat16 sums, above 1 - 1e-4.
        """
        set_matrix_type(self.backbone, dtype)

    def forward(self, images: Tensor) -> Tensor:
        """Return descriptors (B, 8448) float32, of length 1.

        Args:
            images: (B, 3, H, W), RGB in [0, 1] minus `vit.IMAGENET_MEAN`, divided by `vit.IMAGENET_STD`. Resized to
                the nearest multiples of 14.

        Raises:
            ValueError: wrong shape, or too small: the aggregation needs more patches of 14 x 14 pixels than clusters.
        """
        if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point():
            found = f"{images.dtype} {tuple(images.shape)}"
            raise ValueError(f"images are {found}; expected (B, 3, H, W), ImageNet-normalized.")
        height, width = (round(side / PATCH) for side in images.shape[2:])  # half to even, as the official code
        if height * width <= self.clusters:
            given = f"images of {images.shape[3]} x {images.shape[2]} pixels give {height * width} patches"
            raise ValueError(f"{given} of {PATCH} x {PATCH}; expected more than {self.clusters}. Enlarge them.")
        size = [height * PATCH, width * PATCH]
        if list(images.shape[2:]) != size:
            images = F.interpolate(images.float(), size, mode="bilinear", align_corners=False, antialias=True)
        descriptors: Tensor = F.normalize(self.aggregator(*self.backbone(images)).float(), dim=-1)
        return descriptors
