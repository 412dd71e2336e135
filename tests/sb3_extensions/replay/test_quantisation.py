import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay.quantisation import Quantiser

BOUNDS = [(0, 0.4), (-1, 1), (0.1, 0.35), (-3, 100)]


def box(low, high, shape=(1, 4, 4)):
    return spaces.Box(low, high, shape, np.float32)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("low, high", BOUNDS)
def test_levels_survive_the_way_out_and_back(low, high, dtype):
    quantiser = Quantiser(box(low, high), dtype)
    levels = np.arange(quantiser.levels + 1).astype(dtype)
    values = quantiser.decode(levels)
    assert values.dtype == np.float32 and quantiser.encode(values).dtype == np.dtype(dtype)
    np.testing.assert_array_equal(quantiser.encode(values), levels)
    np.testing.assert_array_equal(quantiser.round_trip(th.from_numpy(values)).numpy(), values)
    assert values[0] == np.float32(low) and values[-1] == pytest.approx(high, rel=1e-6)
    assert (values <= np.float32(high)).all()


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("low, high", BOUNDS)
def test_tensors_are_rounded_as_arrays_are(low, high, dtype):
    quantiser = Quantiser(box(low, high), dtype)
    margin = 0.1 * (high - low)
    values = np.random.default_rng(0).uniform(low - margin, high + margin, 10_000).astype(np.float32)
    stored = quantiser.decode(quantiser.encode(values))
    np.testing.assert_array_equal(quantiser.round_trip(th.from_numpy(values)).numpy(), stored)
    seen, trained = (quantiser.normalise(th.from_numpy(x)) for x in (values, stored))
    assert th.equal(seen, trained) and seen.min() == 0 and seen.max() == 1
    step = (high - low) / quantiser.levels
    np.testing.assert_allclose(stored, np.clip(values, low, high), atol=0.51 * step)
    np.testing.assert_allclose(seen, (stored - low) / (high - low), atol=1e-5)


def test_levels_cover_the_bounds_of_all_entries():
    space = spaces.Box(np.float32([[0, -1]]), np.float32([[1, 3]]), dtype=np.float32)
    quantiser = Quantiser(space)
    np.testing.assert_array_equal(quantiser.encode(np.float32([[[-1, 3]]])), [[[0, 255]]])
    np.testing.assert_array_equal(quantiser.decode(np.uint8([[[0, 255]]])), [[[-1, 3]]])


def test_rounding_carries_no_gradient_and_writes_to_no_argument():
    values = th.full((1, 4, 4), 0.123, requires_grad=True)
    rounded = Quantiser(box(0, 0.4)).round_trip(values)
    assert not rounded.requires_grad and (values == 0.123).all()


@pytest.mark.parametrize(
    "space, dtype, named",
    [
        (box(0, np.inf), "uint8", "finite"),
        (box(1, 1), "uint8", "low < high"),
        (box(0, 1), "int8", "dtype"),
        (box(1000, 1000.01), "uint16", "too narrow"),
    ],
)
def test_refuses_bounds_without_levels(space, dtype, named):
    with pytest.raises(ValueError, match=named):
        Quantiser(space, dtype)
