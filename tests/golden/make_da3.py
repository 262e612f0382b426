"""Write da3.keys.json, da3.golden.json and da3.golden.npz: what the official Depth Anything 3 computes.

    git clone https://github.com/ByteDance-Seed/Depth-Anything-3 <checkout>
    pip install --target <folder> --no-deps einops addict omegaconf antlr4-python3-runtime==4.9.3
    PYTHONPATH=.:<folder> python tests/golden/make_da3.py <checkout>

From the top of this repository. The official code runs as it is, on a CPU in float32, with weights by formula. What it
imports for its outputs and services only is replaced by nothing, and torchvision by the three transforms of its loader.

A tolerance is ten times the largest difference among computations that are equal on paper: one thread, attention
written out, oneDNN off, float64. Takes two minutes.
"""

import importlib.machinery
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from tests.golden.da3 import CASES, HERE, PICTURES, SIZES, inputs, sampled, state
from tests.golden.formula import photograph

MEAN, STD = (torch.tensor(values).view(3, 1, 1) for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))


def stub(checkout: Path) -> None:
    """Make the official code importable."""
    for name in ("moviepy", "moviepy.editor", "imageio", "evo", "depth_anything_3.utils.export",
                 "depth_anything_3.utils.io.output_processor", "depth_anything_3.utils.pose_align"):  # fmt: skip
        sys.modules[name] = MagicMock(__spec__=importlib.machinery.ModuleSpec(name, None))
    transforms = ModuleType("torchvision.transforms")

    def normalize(mean: list[float], std: list[float]) -> Callable[[Tensor], Tensor]:
        def take_out(middle: Tensor, spread: Tensor, x: Tensor) -> Tensor:
            return (x - middle) / spread

        # Partial, as it becomes an attribute of a class, where a function would be a method.
        return partial(take_out, *(torch.tensor(values).view(3, 1, 1) for values in (mean, std)))

    def to_tensor() -> Callable[[Image.Image], Tensor]:
        return lambda image: torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255

    def center_crop(size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
        def crop(x: Tensor) -> Tensor:
            top, left = (round((own - wanted) / 2) for own, wanted in zip(x.shape[1:], size, strict=True))
            return x[:, top : top + size[0], left : left + size[1]]

        return crop

    transforms.Normalize, transforms.ToTensor, transforms.CenterCrop = normalize, to_tensor, center_crop  # type: ignore[attr-defined]
    sys.modules["torchvision"] = ModuleType("torchvision")
    sys.modules["torchvision.transforms"] = transforms
    sys.modules["torchvision"].transforms = transforms  # type: ignore[attr-defined]
    sys.path.insert(0, str(checkout / "src"))


def official(size: str) -> Any:
    """Return the official network with weights by formula."""
    from depth_anything_3.cfg import create_object, load_config
    from depth_anything_3.registry import MODEL_REGISTRY

    network = create_object(load_config(MODEL_REGISTRY[size])).eval().requires_grad_(False)
    network.load_state_dict(state({name: tuple(value.shape) for name, value in network.state_dict().items()}))
    return network


def run(network: Any, case: str, dtype: torch.dtype) -> dict[str, Any]:
    """Return all outputs of a case, in the order of its views, without the axis of scenes."""
    from depth_anything_3.model.dinov2 import vision_transformer
    from depth_anything_3.model.reference_view_selector import restore_original_order

    given = inputs(case)
    S = len(given["images"])
    images = ((given["images"] - MEAN) / STD)[None].to(dtype)
    trunk = network.backbone.pretrained
    seen: dict[str, Tensor] = {"reference": torch.zeros(1, dtype=torch.long)}
    select = vision_transformer.select_reference_view

    def selects(*args: Any, **kwargs: Any) -> Tensor:
        seen["reference"] = select(*args, **kwargs)
        return seen["reference"]

    hooks = [
        trunk.blocks[number].register_forward_hook(
            lambda _m, _i, out, name=f"block{number}": seen.update({name: out.unflatten(0, (1, S)).clone()})
        )
        for number in (2, 3)
    ]
    hooks.append(network.cam_dec.register_forward_hook(lambda _m, _i, out: seen.update(pose_enc=out)))
    hooks.append(network.backbone.register_forward_hook(lambda _m, _i, out: seen.update(feats=out[0])))
    with patch.object(vision_transformer, "select_reference_view", selects):
        options = {"ref_view_strategy": given.get("reference", "saddle_balanced")}
        output = network(images, **options)
    for hook in hooks:
        hook.remove()
    reference = seen.pop("reference")
    feats = seen.pop("feats")
    found = {
        "block2": seen["block2"][0],
        "block3": (restore_original_order(seen["block3"], reference) if S >= 3 else seen["block3"])[0],
        "tokens": torch.stack([patches[0] for patches, _ in feats]),
        "camera_tokens": feats[-1][1][0],
        "pose_enc": seen["pose_enc"][0],
        **{name: output[name][0] for name in ("depth", "depth_conf", "extrinsics", "intrinsics")},
    }
    return sampled({name: value.double().numpy() for name, value in found.items()}) | {"reference": int(reference)}


def written_out(q: Tensor, k: Tensor, v: Tensor, **_: Any) -> Tensor:
    """Attention in steps."""
    return (q * q.shape[-1] ** -0.5 @ k.transpose(-2, -1)).softmax(dim=-1) @ v


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


def golden(size: str) -> tuple[dict[str, np.ndarray], dict[str, Any], dict[str, Any]]:
    """Return the recorded numbers, the tolerances and the chosen references of all cases."""
    network, exact = official(size), official(size).double()
    arrays, tolerances, references = {}, {}, {}
    variants = {
        "one thread": lambda: threads(1),
        "attention": lambda: patch.object(F, "scaled_dot_product_attention", written_out),
        "no oneDNN": lambda: torch.backends.mkldnn.flags(enabled=False),
    }
    for case in CASES:
        found = run(network, case, torch.float32)
        references[case] = found.pop("reference")
        others = []
        for variant in variants.values():
            with ExitStack() as stack:
                stack.enter_context(variant())
                others.append(run(network, case, torch.float32))
        # The official code asks for float32 in places.
        with patch.object(torch.Tensor, "float", lambda x: x):
            others.append(run(exact, case, torch.float64))
        assert all(other.pop("reference") == references[case] for other in others), "rounding decides the reference"
        tolerances[case] = {
            name: float(f"{10 * max(np.abs(other[name] - value).max() for other in others):.2g}")
            for name, value in found.items()
        }
        arrays |= {f"{size}/{case}/{name}": value.astype(np.float32) for name, value in found.items()}
        for name, value in found.items():
            print(f"{size} {case} {name}: rms {np.sqrt((value**2).mean()):.3g}, tolerance {tolerances[case][name]:.1e}")
        print(f"{size} {case}: reference {references[case]}")
    return arrays, tolerances, references


def loaded() -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return parts of what the official loader makes of the pictures, one by one and together, and their shapes."""
    from depth_anything_3.utils.io.input_processor import InputProcessor

    pictures = {name: photograph(name, *size) for name, size in PICTURES.items()}
    arrays, shapes = {}, {}
    for name, chosen in {**{name: [one] for name, one in pictures.items()}, "all": [*pictures.values()]}.items():
        images, _, _ = InputProcessor()(chosen, sequential=True)
        levels = torch.round(255 * (images * STD + MEAN)).to(torch.uint8).numpy()
        arrays[f"loader/{name}"] = levels[:, :, 3::17, 5::19]
        shapes[name] = levels.shape
    return arrays, shapes


def main() -> None:
    stub(Path(sys.argv[1]))
    torch.manual_seed(0)
    keys: dict[str, list[list[int]]] = {}
    for size in SIZES:
        for name, value in official(size).state_dict().items():
            keys.setdefault(name, []).append(list(value.shape))
    arrays, shapes = loaded()
    facts: dict[str, Any] = {"torch": torch.__version__, "loader": shapes, "tolerances": {}, "references": {}}
    for size in SIZES:
        found, facts["tolerances"][size], facts["references"][size] = golden(size)
        arrays |= found
    np.savez_compressed(HERE / "da3.golden.npz", **arrays)
    (HERE / "da3.golden.json").write_text(json.dumps(facts, indent=1) + "\n")
    (HERE / "da3.keys.json").write_text("{\n" + ",\n".join(f' "{n}": {s}' for n, s in keys.items()) + "\n}\n")


if __name__ == "__main__":
    main()
