"""The official numbers of Depth Anything 3 on weights by formula, as `make_da3.py` wrote them, and how they compare."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from tests.golden.formula import numbers, photographs

HERE = Path(__file__).parent
SIZES = ("da3-base", "da3-small")
CASES: dict[str, dict[str, Any]] = {
    "two": {"scene": "house", "views": 2, "size": (70, 98)},
    "four": {"scene": "house", "views": 4, "size": (112, 84)},
    "first": {"scene": "house", "views": 4, "size": (112, 84), "reference": "first"},
}
PICTURES = {
    "landscape": (480, 640),
    "portrait": (640, 360),
    "small": (100, 133),
    "wide": (301, 999),
    "as is": (378, 504),
}
"""Height and width of pictures for the loader."""

# Endings of names, and what a layer's numbers are multiplied by beside 1 / sqrt(fan in).
_GAINS = {
    "patch_embed.proj.weight": 0.1,
    "cam_dec.backbone.0.weight": 6.0,
    "cam_dec.backbone.2.weight": 1.4,
    "fc_t.weight": 1.0,
    "fc_qvec.weight": 1.0,
    "fc_fov.0.weight": 0.5,
    "conv1.weight": 1.4,
    "output_conv2.2.weight": 0.2,
}


def weight(name: str, shape: tuple[int, ...], normed: bool = False) -> torch.Tensor:
    """Return a parameter by its official name; `normed`: of queries and keys that are normalized after."""
    values = numbers(name, int(np.prod(shape))).reshape(shape)
    kind = name.rsplit(".", 1)[-1]
    small = 0.1 if "pretrained.norm." in name else 1.0  # its output goes on as tokens: the epsilons of norms are seen
    if kind == "gamma":
        values = 0.05 + 0.03 * values
    elif kind == "weight" and len(shape) == 1:  # of a norm
        values = small * (1 + 0.25 * values)
    elif kind == "weight":
        transposed = "resize_layers.0." in name or "resize_layers.1." in name
        fan_in = shape[0] if transposed else int(np.prod(shape[1:]))
        gain = next((gain for ending, gain in _GAINS.items() if name.endswith(ending)), 1.0)
        values = values * (gain * (3 / fan_in) ** 0.5)
    elif kind == "bias":
        values = values * (0.1 * small)
    else:
        values = values * 0.17  # tokens and the embedding of positions
    if normed:
        values[: 2 * (len(values) // 3)] *= 0.1
    if name.endswith("fc_qvec.bias"):
        values[3] += 1
    elif name.endswith("fc_fov.0.bias"):
        values += 1
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


@cache
def info() -> Any:
    return json.loads((HERE / "da3.golden.json").read_text())


def shapes(size: str) -> dict[str, tuple[int, ...]]:
    """Return the shape of each entry of the official state dict, without the `model.` of checkpoints."""
    keys = json.loads((HERE / "da3.keys.json").read_text())
    return {name: tuple(of[SIZES.index(size)]) for name, of in keys.items()}


def state(shapes: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Return weights for parameters of these shapes."""
    return {
        name: weight(name, shape, ".attn.qkv." in name and f"{name.split('.qkv.')[0]}.q_norm.weight" in shapes)
        for name, shape in shapes.items()
    }


def inputs(case: str) -> dict[str, Any]:
    """Return images (S, 3, H, W), and how to choose the reference if the case says it."""
    spec = CASES[case]
    found: dict[str, Any] = {"images": photographs(spec["scene"], spec["views"], *spec["size"])}
    if "reference" in spec:
        found["reference"] = spec["reference"]
    return found


def expected(group: str) -> dict[str, np.ndarray]:
    """Return what is recorded under `<size>/<case>` or `loader/<pictures>`, by name."""
    with np.load(HERE / "da3.golden.npz") as stored:
        names = [name for name in stored.files if name.startswith(f"{group}/")]
        return {name.removeprefix(f"{group}/"): stored[name] for name in names}


def sampled(outputs: dict[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Return the part of each output that is recorded."""
    parts = {
        "block2": np.s_[:, :6, ::16],  # (S, 1 + P, C)
        "block3": np.s_[:, 1:7, ::16],
        "tokens": np.s_[:, :, :6, ::32],  # (4, S, P, 2 C)
        "camera_tokens": np.s_[:, ::16],  # (S, 2 C)
        "depth": np.s_[:, 1::4, 2::3],  # (S, H, W)
        "depth_conf": np.s_[:, 1::4, 2::3],
    }
    return {name: np.asarray(value)[parts.get(name, ...)] for name, value in outputs.items()}


def errors(size: str, case: str, outputs: dict[str, ArrayLike]) -> dict[str, float]:
    """Return the largest error of each recorded output in units of its tolerance; inf for a wrong shape or NaN."""
    found, tolerances = sampled(outputs), info()["tolerances"][size][case]
    result = {}
    for name, wanted in expected(f"{size}/{case}").items():
        same = found[name].shape == wanted.shape and np.isfinite(found[name]).all()
        result[name] = float(np.abs(found[name] - wanted).max() / tolerances[name]) if same else np.inf
    return result
