"""Shortened RootSIFT descriptors."""

import numpy as np

from toolkit.features import features as rootsift
from toolkit.features.features import KINDS, LENGTH, STEP, MutualMatcher, rootsift_64


def test_shortened_descriptors_have_length_1_and_none_at_all_stays_zero() -> None:
    rng = np.random.default_rng(0)
    roots = np.sqrt(rng.dirichlet(np.full(128, 0.3), 50)).astype(np.float32)
    shortened = rootsift_64(roots)
    assert shortened.shape == (50, LENGTH)
    assert shortened.dtype == np.float32
    np.testing.assert_array_equal(shortened, np.rint(shortened / STEP) * STEP)
    np.testing.assert_allclose(np.linalg.norm(shortened, axis=1), 1, atol=np.sqrt(LENGTH) * STEP / 2)
    np.testing.assert_array_equal(rootsift_64(np.zeros((2, 128), np.float32)), np.zeros((2, LENGTH), np.float32))
    assert rootsift_64(np.zeros((0, 128), np.float32)).shape == (0, LENGTH)
    of_another_kind = np.ones((2, 256), np.float32)
    assert rootsift_64(of_another_kind) is of_another_kind


def test_the_components_are_orthogonal_waves_over_cells_and_directions() -> None:
    squares = rootsift._COMPONENTS.T @ rootsift._COMPONENTS
    weights = 1 / np.sort(rootsift._DEVIATIONS.reshape(-1))[::-1][:LENGTH]
    np.testing.assert_array_equal(rootsift._COMPONENTS, np.rint(rootsift._COMPONENTS / STEP) * STEP)
    lengths = np.sqrt(weights)
    # Rounding turns a wave of length l by about sqrt(128 / 12) steps / l.
    np.testing.assert_allclose(squares / np.outer(lengths, lengths), np.eye(LENGTH), atol=4 * STEP)
    # One wave over the directions, equal in all cells, is one component.
    wave = np.tile(np.sin(2 * np.pi * np.arange(8) / 8), 16).astype(np.float32)
    entries = np.sort(np.abs(rootsift_64(wave[None])[0]))
    np.testing.assert_allclose(entries[[0, -2, -1]], [0, 0, 1], atol=STEP)


def test_only_sift_is_shortened_and_the_fingerprint_of_the_matches_says_so() -> None:
    shortened = {name: MutualMatcher.of(kind).settings.get("shorten") for name, kind in KINDS.items()}
    assert shortened == {"sift": "rootsift_64", "superpoint": None, "aliked": None}
