"""The network LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023), with the key names of the authors' files.

Call `fold_` before use: it merges matrices that are only ever multiplied with each other. The result is equal up to
rounding.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.compute import has_onednn, linear
from toolkit.models.vit import Rope, rotate_

DIM = 256
"""Channels of a feature inside the network."""
_HEADS = 4
_LAYERS = 9
# The authors' defaults for adaptive depth and width (section 3.3 of the paper): a pair is done if this share of its
# features is confident, and a confident feature is dropped if it has a match with less than this probability.
_DEPTH_CONFIDENCE = 0.95
_MIN_MATCHABILITY = 0.01
# Rows of the attention matrix at a time, per CPU thread: they fit the cache.
_ROWS = 128

# Patterns of key names in checkpoints of the package `transformers` and in the authors' first files, and our names.
_NAMES = {
    r"^positional_encoder\.projector": "posenc.Wr",
    r"^input_projection": "input_proj",
    r"^transformer_layers": "transformers",
    r"(self|cross)_mlp\.fc1": r"\1_attn.ffn.0",
    r"(self|cross)_mlp\.layer_norm": r"\1_attn.ffn.1",
    r"(self|cross)_mlp\.fc2": r"\1_attn.ffn.3",
    r"self_attention\.o_proj": "self_attn.out_proj",
    r"cross_attention\.q_proj": "cross_attn.to_qk",
    r"cross_attention\.v_proj": "cross_attn.to_v",
    r"cross_attention\.o_proj": "cross_attn.to_out",
    r"^match_assignment_layers": "log_assignment",
    r"final_projection": "final_proj",
    r"(token_confidence\.\d+\.token)\.(weight|bias)": r"\1.0.\2",
    r"^(self|cross)_attn\.(\d+)": r"transformers.\2.\1_attn",
}


def official_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the tensors of a checkpoint, the authors' or of `transformers`, to those of `LightGlue`; others stay."""
    renamed = {}
    for name, value in state.items():
        for pattern, own in _NAMES.items():
            name = re.sub(pattern, own, name)
        renamed[name] = value
    for name in [name for name in renamed if "self_attention.q_proj" in name]:
        names = [name.replace("q_proj", projection) for projection in ("q_proj", "k_proj", "v_proj")]
        if all(part in renamed for part in names):
            # `Wqkv` interleaves the rows of queries, keys and values.
            value = torch.stack([renamed.pop(part) for part in names], dim=1).flatten(0, 1)
            renamed[name.replace("self_attention.q_proj", "self_attn.Wqkv")] = value
    for name in [name for name in renamed if "cross_attn.to_qk" in name]:
        # In cross-attention, queries and keys share one projection. If they differ, the file is of another network.
        keys = name.replace("cross_attn.to_qk", "cross_attention.k_proj")
        if keys in renamed and torch.equal(renamed[keys], renamed[name]):
            del renamed[keys]
    return renamed


def _rotate(x: Tensor, rope: Rope) -> Tensor:
    """Rotate each pair of channels of queries or keys (B, N, heads, D) by its own angle, see `rotate_`."""
    return rotate_(x.float(), rope, groups=1).to(x.dtype)


def _attend(queries: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None) -> Tensor:
    """Return the attention output without scaling, softmax(queries @ keys.T) @ values, (B, N, heads * D), of queries
    (B, N, heads, D), keys and values (B, M, heads, D), and a mask (B, 1, 1, M) that is True for real keys, or None.
    """
    q, k, v = (tensor.transpose(1, 2).contiguous() for tensor in (queries, keys, values))
    if mask is not None or not has_onednn(queries):
        return F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=1.0).transpose(1, 2).flatten(2)
    # On a CPU this is 1.7 (float32) to 2.6 (bfloat16) times as fast as torch's function, whose products are slower.
    attended = torch.empty_like(queries, memory_format=torch.contiguous_format)
    rows = _ROWS * max(2, torch.get_num_threads())
    for image, heads in enumerate(zip(q, k, v, strict=True)):
        for head, (query, key, value) in enumerate(zip(*heads, strict=True)):
            for start in range(0, len(query), rows):
                weights = linear(query[start : start + rows], key)
                mean = linear(torch.softmax(weights, dim=-1, out=weights), value.t())
                attended[image, start : start + rows, head] = mean
    return attended.flatten(2)


def _project(layer: nn.Linear, x: Tensor) -> Tensor:
    return linear(x.to(layer.weight.dtype), layer.weight, layer.bias)


class _Block(nn.Module):
    """Common part of self-attention and cross-attention: updates features with the attention output."""

    def __init__(self) -> None:
        super().__init__()
        layers = nn.Linear(2 * DIM, 2 * DIM), nn.LayerNorm(2 * DIM), nn.GELU(), nn.Linear(2 * DIM, DIM)
        self.ffn: Any = nn.Sequential(*layers)

    def _fold_(self, projection: nn.Linear) -> None:
        """Merge the output projection of the attention into the first layer of the MLP."""
        layer = self.ffn[0]
        first, second = layer.weight.double().chunk(2, dim=1)
        layer.bias.data = (layer.bias + second @ projection.bias.double()).float()
        layer.weight.data = torch.cat([first, second @ projection.weight.double()], dim=1).float()

    def _update(self, states: Tensor, attended: Tensor) -> Tensor:
        """Return updated features (B, N, DIM), float32, for the attention output (B, N, DIM)."""
        first, norm, _, last = self.ffn
        hidden = _project(first, torch.cat([states.to(attended.dtype), attended], dim=-1))
        return states + _project(last, F.gelu(norm(hidden)))


class SelfBlock(_Block):
    """Attention among the features of one image."""

    def __init__(self) -> None:
        super().__init__()
        self.Wqkv = nn.Linear(DIM, 3 * DIM)
        self.out_proj = nn.Linear(DIM, DIM)

    def fold_(self) -> None:
        # The rows are heads x pairs of channels x 2 x (query, key, value). Reorder them to all queries, all keys, all
        # values; for queries and keys, put the first channels of all pairs before the second ones, as `_rotate` needs.
        rows = torch.arange(3 * DIM).view(_HEADS, -1, 2, 3)
        queries_and_keys, values = rows[..., :2].permute(3, 0, 2, 1), rows[..., 2]
        order = torch.cat([queries_and_keys.flatten(), values.flatten()])
        scale = torch.ones(3 * DIM)
        scale[:DIM] = (DIM // _HEADS) ** -0.5
        self.Wqkv.weight.data = self.Wqkv.weight[order] * scale[:, None]
        self.Wqkv.bias.data = self.Wqkv.bias[order] * scale
        self._fold_(self.out_proj)

    def forward(self, states: Tensor, rope: Rope, mask: Tensor | None) -> Tensor:
        queries, keys, values = _project(self.Wqkv, states).unflatten(-1, (3, _HEADS, -1)).unbind(2)
        return self._update(states, _attend(_rotate(queries, rope), _rotate(keys, rope), values, mask))


class CrossBlock(_Block):
    """Attention between the features of two images."""

    def __init__(self) -> None:
        super().__init__()
        self.to_qk = nn.Linear(DIM, DIM)
        self.to_v = nn.Linear(DIM, DIM)
        self.to_out = nn.Linear(DIM, DIM)

    def fold_(self) -> None:
        for parameter in self.to_qk.parameters():
            parameter.data = parameter * (DIM // _HEADS) ** -0.25
        self._fold_(self.to_out)

    def forward(self, a: Tensor, b: Tensor, mask_a: Tensor | None, mask_b: Tensor | None) -> tuple[Tensor, Tensor]:
        # The keys of an image are also its queries.
        keys_a, values_a, keys_b, values_b = (
            _project(layer, states).unflatten(-1, (_HEADS, -1))
            for states in (a, b)
            for layer in (self.to_qk, self.to_v)
        )
        a = self._update(a, _attend(keys_a, keys_b, values_b, mask_b))
        return a, self._update(b, _attend(keys_b, keys_a, values_a, mask_a))


class LightGlue(nn.Module):
    """Matches the features of two images: `encode` each image, then pass both to `forward`."""

    def __init__(self, input_dim: int) -> None:
        """`input_dim` is the length of the descriptors."""
        super().__init__()
        self.input_proj = nn.Identity() if input_dim == DIM else nn.Linear(input_dim, DIM)
        self.posenc: Any = nn.ModuleDict({"Wr": nn.Linear(2, DIM // _HEADS // 2, bias=False)})
        self.transformers: Any = nn.ModuleList(
            nn.ModuleDict({"self_attn": SelfBlock(), "cross_attn": CrossBlock()}) for _ in range(_LAYERS)
        )
        self.log_assignment: Any = nn.ModuleList(
            nn.ModuleDict({"matchability": nn.Linear(DIM, 1), "final_proj": nn.Linear(DIM, DIM)})
            for _ in range(_LAYERS)
        )
        # Confidence that a feature's match, or that it has none, does not change after a layer.
        self.token_confidence: Any = nn.ModuleList(
            nn.ModuleDict({"token": nn.Sequential(nn.Linear(DIM, 1))}) for _ in range(_LAYERS - 1)
        )

    @torch.no_grad()
    def fold_(self, dtype: torch.dtype) -> None:
        """Merge matrices, and convert the attention blocks to the type in which to compute. Call it once, on the CPU.

        Does not change the loaded tensors, which may be mapped from a file or belong to the caller.
        """
        for layer in self.transformers:
            for block in (layer.self_attn, layer.cross_attn):
                block.fold_()
                block.to(dtype)

    def encode(self, keypoints: Tensor, descriptors: Tensor, mask: Tensor | None) -> Tensor:
        """Return features (B, N, DIM), float32, before the first cross-attention. They depend on this image only.

        Keypoints (B, N, 2) are from -1 to 1 along the longer side of the image, descriptors (B, N, input_dim); the mask
        (B, N) is True for real features, False for padding; None: all are real.
        """
        mask = None if mask is None else mask[:, None, None]
        return self.transformers[0].self_attn(self.input_proj(descriptors), self._rope(keypoints), mask)

    def forward(
        self,
        keypoints: tuple[Tensor, Tensor],
        encoded: tuple[Tensor, Tensor],
        masks: tuple[Tensor | None, Tensor | None] = (None, None),
        adaptive: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return the match of each feature of the first images, -1 for none, and its confidence, each (B, N).

        Args:
            keypoints, encoded, masks: of both images, as in `encode` and from it; at least one feature per image
                is real.
            adaptive: stop early, and drop features that match nothing, as the authors' code does by default. Only for
                B = 1 without masks.
        """
        ropes = [self._rope(xy) for xy in keypoints]
        attended = [None if mask is None else mask[:, None, None] for mask in masks]
        states = list(encoded)
        rows = [torch.arange(state.shape[1], device=state.device) for state in states]
        partners, scores = rows[0].new_full(states[0].shape[:2], -1), states[0].new_zeros(states[0].shape[:2])
        count = sum(map(len, rows))
        for number, layer in enumerate(self.transformers):
            if number:
                states = [layer.self_attn(*inputs) for inputs in zip(states, ropes, attended, strict=True)]
            states = list(layer.cross_attn(*states, *attended))
            if not adaptive or number == _LAYERS - 1:
                continue
            confident = [self._is_confident(state[0], number) for state in states]
            # Dropped features are confident.
            if count - sum(int((~sure).sum()) for sure in confident) > _DEPTH_CONFIDENCE * count:
                break
            for side, (state, sure) in enumerate(zip(states, confident, strict=True)):
                matchability = self.log_assignment[number].matchability(state[0])[:, 0].sigmoid()
                kept = ~sure | (matchability > _MIN_MATCHABILITY)
                states[side], rows[side] = state[:, kept], rows[side][kept]
                ropes[side] = ropes[side][0][:, kept], ropes[side][1][:, kept]
            if not all(map(len, rows)):
                return partners, scores
        best, confidence = self._assign(states[0], states[1], *masks, number)
        best = rows[1][best].where(best >= 0, -1)
        return partners.index_copy_(1, rows[0], best), scores.index_copy_(1, rows[0], confidence)

    def _is_confident(self, states: Tensor, number: int) -> Tensor:
        """Return which features (N, DIM) after a layer are confident that their match is the final one, (N,) bool."""
        confidence = self.token_confidence[number].token(states)[:, 0].sigmoid()
        return confidence > 0.8 + 0.1 * math.exp(-4 * number / _LAYERS)

    def _assign(
        self, a: Tensor, b: Tensor, mask_a: Tensor | None, mask_b: Tensor | None, number: int
    ) -> tuple[Tensor, Tensor]:
        """Return mutual best matches after a layer, by the log softmax over rows plus that over columns."""
        layer = self.log_assignment[number]
        scores = layer.final_proj(a) @ (layer.final_proj(b) / DIM**0.5).mT
        for mask, dim in ((mask_a, 2), (mask_b, 1)):
            if mask is not None:  # -inf would make the softmax of fully masked rows NaN
                scores.masked_fill_(~mask.unsqueeze(dim), torch.finfo(scores.dtype).min / 4)
        # Subtract before adding: the rounding of sums of large numbers would show in the confidence.
        rows, columns = scores - scores.logsumexp(2, keepdim=True), scores.sub_(scores.logsumexp(1, keepdim=True))
        matchable = F.logsigmoid(layer.matchability(a)), F.logsigmoid(layer.matchability(b)).mT
        scores = rows.add_(columns).add_(matchable[0]).add_(matchable[1])
        best, matches = scores.max(dim=2)
        mutual = scores.argmax(dim=1).gather(1, matches) == torch.arange(a.shape[1], device=a.device)
        if mask_a is not None:
            mutual &= mask_a  # the padding of one image may match the padding of the other
        return matches.where(mutual, -1), best.exp()

    def _rope(self, keypoints: Tensor) -> Rope:
        """Return the rotary position embedding (B, N, 1, DIM / heads) of features, see `rotate_`."""
        angles = F.linear(keypoints, self.posenc.Wr.weight)[:, :, None]
        cosine, sine = angles.cos(), angles.sin()
        return torch.cat([cosine, cosine], dim=-1), torch.cat([-sine, sine], dim=-1)
