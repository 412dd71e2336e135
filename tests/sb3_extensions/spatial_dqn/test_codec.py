"""Conversion of actions to the grid and back, rounding, and the actions that the environment decodes."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest

import bulletarm_gym  # noqa: F401  registers the environments
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

THETA_BOUNDS = [(0.0, math.pi), (-math.pi, math.pi), (-math.pi / 2, math.pi / 2)]
SIZE = 6


def make_codec(sequence: str, **kwargs) -> SpatialActionCodec:
    return SpatialActionCodec(SIZE, sequence, num_rotations=4, num_heights=5, num_tilts=3, **kwargs)


def slowly_encoded(codec: SpatialActionCodec, action: np.ndarray) -> list[int]:
    """Number by number: the place of the grid that is the fewest metres or radians away."""
    value = dict(zip(codec.numbers, action.tolist(), strict=True))
    middles = [(2 * i + 1) / SIZE - 1 for i in range(SIZE)]
    indices = [int(np.argmin([abs(value[name] - middle) for middle in middles])) for name in "xy"]
    ranges = {"z": (0.0, 0.3), "theta": codec.theta_bounds, "phi": (-math.pi / 4, math.pi / 4)}
    ranges["psi"] = ranges["phi"]
    flipped = False
    for name, grid in codec.grids.items():
        low, high = ranges[name]
        at = low + (value[name] + 1) / 2 * (high - low)
        if name == "theta":
            turns = list(itertools.product(range(len(grid)), range(-2, 3)))  # yaw, number of rotations by pi
            index, half_turns = min(turns, key=lambda turn: abs(at - grid[turn[0]] - turn[1] * math.pi))
            flipped = half_turns % 2 == 1
        else:
            wanted = -at if flipped and name in ("phi", "psi") else at
            index = min(range(len(grid)), key=lambda k: abs(wanted - grid[k]))
        indices.append(index)
    return indices


@pytest.mark.parametrize("theta_bounds", THETA_BOUNDS)
@pytest.mark.parametrize("sequence", ["xy", "pxy", "xyrp", "pxyzrrr", "zrrpyrx"])
def test_actions_are_rounded_to_the_nearest_grid_point(sequence, theta_bounds):
    """The grid's own actions are decoded and encoded exactly."""
    codec = make_codec(sequence, theta_bounds=theta_bounds)
    indices = np.indices(codec.shape).reshape(len(codec.shape), -1).T
    places = np.arange(len(indices)) % 3 == 0
    exact = codec.decode(indices, places)
    assert exact.dtype == np.float32 and exact.shape == (len(indices), len(sequence))
    assert np.abs(exact).max() <= 1.0 and len(np.unique(exact, axis=0)) == len(indices)
    np.testing.assert_array_equal(codec.encode(exact), indices)
    np.testing.assert_array_equal(codec.places(exact), places & ("p" in sequence))
    np.testing.assert_array_equal(codec.snap(exact), exact)
    actions = np.random.default_rng(0).uniform(-1, 1, (300, len(sequence)))
    expected = [slowly_encoded(codec, action) for action in actions]
    np.testing.assert_array_equal(codec.encode(actions), expected)
    np.testing.assert_array_equal(codec.encode(codec.snap(actions)), expected)
    np.testing.assert_array_equal(codec.places(codec.snap(actions)), codec.places(actions))


def test_order_of_indices_and_default_grid():
    codec = SpatialActionCodec(128, "rrrzyxp")
    assert codec.shape == (128, 128, 16, 36, 7, 7)
    assert list(codec.grids) == ["theta", "z", "phi", "psi"]
    assert math.isclose(codec.resolution, 0.4 / 128)
    np.testing.assert_allclose(codec.grids["theta"], np.arange(16) * math.pi / 16)
    np.testing.assert_allclose(codec.grids["z"][[0, -1]], [0.02, 0.20])
    for name in ("phi", "psi"):
        np.testing.assert_allclose(np.degrees(codec.grids[name]), [-30, -20, -10, 0, 10, 20, 30], atol=1e-9)


@pytest.mark.parametrize("half_rotation", [True, False])
@pytest.mark.parametrize("sequence", ["xy", "xyrp", "pxyzrrr"])
def test_decoded_actions_match_the_environment(sequence, half_rotation):
    kwargs = {"obs_size": 16, "workspace": [[0.3, 0.6], [-0.1, 0.2], [0.0, 1.0]], "num_objects": 2}
    kwargs |= {"action_sequence": sequence, "half_rotation": half_rotation}
    env = gym.make("BulletArm/OpenLoopBlockStacking-v0", **kwargs)
    env.reset(seed=0)
    low = 0.0 if half_rotation else -math.pi
    codec = SpatialActionCodec(16, sequence, theta_bounds=(low, math.pi), workspace_size=0.3)
    rng = np.random.default_rng(0)
    indices = np.stack([rng.integers(count, size=60) for count in codec.shape], axis=1)
    places = rng.random(60) < 0.5
    for index, place, action in zip(indices, places, codec.decode(indices, places), strict=True):
        assert env.action_space.contains(action)
        move = env.unwrapped.decode_action(action)
        middle = [0.3 + (index[0] + 0.5) * 0.3 / 16, -0.1 + (index[1] + 0.5) * 0.3 / 16]
        np.testing.assert_allclose(move.position[:2], middle, atol=1e-6)
        values = {name: grid[k] for (name, grid), k in zip(codec.grids.items(), index[2:], strict=True)}
        rotation = [values.get(name, 0.0) for name in ("theta", "phi", "psi")]
        np.testing.assert_allclose(move.rotation, rotation, atol=1e-6)
        if "z" in values:
            np.testing.assert_allclose(move.position[2], values["z"], atol=1e-6)
        assert "p" not in sequence or move.primitive == ("place" if place else "pick")
    env.close()


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"size": 0}, "size .* got 0"),
        ({"num_rotations": 0}, "num_rotations"),
        ({"num_heights": -1}, "num_heights .* got -1"),
        ({"num_tilts": 0}, "num_tilts"),
        ({"workspace_size": 0.0}, "workspace_size"),
        ({"heights": (0.1, 0.05)}, "heights"),
        ({"heights": (0.1, 0.5)}, r"heights .*z_bounds=\(0.0, 0.3\)"),
        ({"tilt": 1.0}, "tilt"),
        ({"tilt": -0.1}, "tilt"),
        ({"theta_bounds": (0.0, 1.0)}, r"theta_bounds .* got \(0"),
        ({"theta_bounds": (3.0, 6.0)}, "theta_bounds"),
        *[({"action_sequence": name}, f"got '{name}'") for name in ("pxr", "pr", "pxyq", "xxy", "xyrrrr")],
    ],
)
def test_invalid_arguments_are_rejected(kwargs, named):
    with pytest.raises(ValueError, match=named):
        SpatialActionCodec(**{"size": 32, **kwargs})
