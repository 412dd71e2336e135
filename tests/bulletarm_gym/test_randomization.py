"""Sampled physics, cameras and noise: in effect, in ``info``, in the state, and repeatable."""

import itertools
import pickle
import re
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rollouts import TYPICAL, advance, digest, is_open_loop, make_env, transcript

import bulletarm_gym
from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations.depth_noise import measured_depths
from bulletarm_gym.randomization import NAMES, PRESETS, Randomization

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
DRAWER = "BulletArm/CloseLoopDrawerOpening-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
PREFIX = "randomization/"
FACTORS = {"object_friction": 0.8, "surface_friction": 1.2, "object_mass": 0.5}


def values_of(info: dict[str, Any]) -> dict[str, Any]:
    """Return the sampled values in an info."""
    return {key.removeprefix(PREFIX): value for key, value in info.items() if key.startswith(PREFIX)}


# Ranges


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "value", [[2.0, -2.0], [0.0, 99.0], float("nan"), "much", ["1", "1"], [1.0], None], ids=str
)
def test_invalid_range_is_rejected_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be a number or \[low, high\], from .*, got "):
        Randomization(**{name: value})
    with pytest.raises(ValueError, match=rf"^randomization: {name} must be a number or .*, got "):
        make_env(PICKING, randomization={name: value})


@pytest.mark.parametrize(
    ("env_id", "value", "message"),
    [
        (PICKING, "heavy", "None, 'light', 'real', a Randomization or a dict with keys from .*, got 'heavy'"),
        (PICKING, 3, "None, .*, got 3"),
        (PICKING, {"weight": 1.0}, r"None, .*, got \{'weight'"),
        (STACKING, {"action_delay": 0.1}, r"action_delay must be 0 in open-loop control, got \[0\.1, 0\.1\]"),
    ],
)
def test_invalid_randomization_is_rejected(env_id: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=rf"randomization.* must be {message}|randomization: {message}"):
        make_env(env_id, randomization=value)


def test_a_randomization_is_stored_as_json() -> None:
    ranges = Randomization(object_mass=(0.5, 2.0), depth_noise=0.001)
    env = gymnasium.make(PICKING, randomization=ranges, obs_size=16)
    stored = {"object_mass": [0.5, 2.0], "depth_noise": [0.001, 0.001]}
    assert env.unwrapped.config.randomization == stored == env.spec.kwargs["randomization"]  # type: ignore
    assert gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()) == env.spec  # type: ignore
    env.close()


# Info


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_sampled_values_are_in_info(make: Make, env_id: str) -> None:
    env = make(env_id, obs_size=32, randomization="real")
    ranges = Randomization.of("real", is_open_loop(env_id))
    seen = []
    for seed in range(5):
        _, info = env.reset(seed=seed)
        values = values_of(info)
        assert values == values_of(env.step(env.expert_action())[4])
        for key, value in values.items():
            low, high = getattr(ranges, key.removesuffix("_x").removesuffix("_y").removesuffix("_z"))
            assert type(value) is float and low <= value <= high
        seen.append(values)
    assert len(seen[0]) == len(ranges.varied) + 6 and len({v["object_mass"] for v in seen}) == 5
    assert not values_of(make(env_id).reset(seed=0)[1])


def test_arrangement_does_not_depend_on_the_randomization(make: Make) -> None:
    env, other = make(PICKING), make(PICKING, randomization={"depth_noise": 0.01})
    assert env.reset(seed=4)[0]["heightmap"].shape == other.reset(seed=4)[0]["heightmap"].shape
    assert env.scene["cube"].pose == other.scene["cube"].pose


# Effects


def test_factors_change_the_properties_of_bodies(make: Make) -> None:
    env = make(DRAWER, randomization={**FACTORS, "gripper_force": 1.5, "colour": 0.5})
    env.reset(seed=0)
    world, robot = env.scene.world, env.scene.robot
    for obj in env.scene.objects:
        assert obj.properties.friction == pytest.approx(0.8 * obj.spec.friction)
        assert obj.properties.mass == pytest.approx(0.5 * obj.spec.mass)
        assert obj.properties.colour != obj.spec.colour
    floor = world.ground
    assert world.get_properties(floor).friction == pytest.approx(1.2 * floor.spec.friction)
    force = robot.model.gripper.force
    assert robot._fingers.forces == (1.5 * force,) * 2
    env.reset(seed=0, options={"randomization": {"gripper_force": 1.5}})
    make(DRAWER).reset(seed=0)


def opened(env: ManipulationEnv) -> list[float]:
    """Return the positions of the drawer's parts after some steps of the expert."""
    env.reset(seed=0)
    for _ in range(5):
        env.step(env.expert_action())
    return list(env.scene["drawer"].joints)


def test_resistance_of_joints_changes_motions(make: Make) -> None:
    found = [opened(make(DRAWER, randomization={"joint_resistance": factor})) for factor in (1.0, 10.0)]
    assert opened(make(DRAWER)) == found[0] != found[1]


def test_weak_gripper_drops_a_heavy_cube(make: Make) -> None:
    env = make(PICKING, randomization={"gripper_force": [0.1, 1.0], "object_mass": [1.0, 10.0]})
    lifted = []
    for force, mass in ((1.0, 1.0), (0.1, 10.0)):
        env.reset(seed=0, options={"randomization": {"gripper_force": force, "object_mass": mass}})
        for _ in range(20):
            *_, terminated, truncated, info = env.step(env.expert_action())
            if terminated or truncated:
                break
        lifted.append(info["is_success"])
    assert lifted == [True, False]


def test_calibration_error_moves_images(make: Make) -> None:
    cameras = [
        "heightmap",
        {"name": "above", "sensor": "depth", "position": [0.45, 0, 1], "target": [0.45, 0, 0]},
    ]
    exact = make(PICKING, observation=cameras)
    shifted = make(PICKING, observation=cameras, randomization={"camera_position": [0.02, 0.02]})
    rotated = make(PICKING, observation=cameras, randomization={"camera_rotation": [0.1, 0.1]})
    images = {env: env.reset(seed=0)[0] for env in (exact, shifted, rotated)}
    heights = images[exact]["heightmap"][0]
    pixels = round(0.02 / (0.45 / 128))
    moved = np.roll(heights, (pixels, pixels), (0, 1)) - 0.02
    assert np.isclose(images[shifted]["heightmap"][0], moved, atol=2e-3).mean() > 0.97
    assert not np.allclose(images[rotated]["heightmap"][0], heights, atol=5e-3)
    for other in (shifted, rotated):
        assert not np.allclose(images[other]["above"], images[exact]["above"], atol=5e-3)
        nominal = exact.cameras["above"].extrinsics
        assert (other.cameras["above"].extrinsics == nominal).all()


def test_point_cloud_is_computed_with_the_nominal_camera(make: Make) -> None:
    exact = make(PICKING, observation=["point_cloud"])
    error = {"camera_position": [0.01, 0.01]}
    shifted = make(PICKING, observation=["point_cloud"], randomization=error)
    clouds = [env.reset(seed=0)[0]["point_cloud"] for env in (exact, shifted)]
    distance = np.abs(clouds[0].mean(axis=0) - clouds[1].mean(axis=0)).max()
    assert 1e-3 < distance < 0.03


def test_light_changes_rendered_images(make: Make) -> None:
    images = [
        make(PICKING, render_mode="rgb_array", render_size=64, randomization=ranges)
        for ranges in (None, {"light_brightness": 0.5}, {"light_direction": [-0.5, -0.5]})
    ]
    for env in images:
        env.reset(seed=0)
    plain, dark, other = (env.render() for env in images)
    assert dark.mean() < 0.95 * plain.mean() and (other != plain).any()


FLAT = np.full((64, 64), 0.8, np.float32)
EDGE = np.where(np.arange(64) < 32, 0.8, 0.9).astype(np.float32) * np.ones((64, 1), np.float32)


def test_depth_noise_grows_with_the_square_of_the_distance() -> None:
    noise = partial(measured_depths, {"depth_noise": 0.002}, 0)
    for distance in (0.5, 1.0, 2.0):
        errors = noise(np.full((128, 128), distance, np.float32)) - distance
        assert errors.std() == pytest.approx(0.002 * distance**2, rel=0.05)
        assert abs(errors.mean()) < 1e-4


def test_depth_step_limits_the_measurable_depths() -> None:
    depths = partial(measured_depths, {"depth_step": 0.01}, 0)(
        np.linspace(0.9, 1.1, 64, dtype=np.float32)[None]
    )
    found = np.unique(depths)
    assert 15 < len(found) < 25 and np.diff(found).min() == pytest.approx(0.0085, abs=1e-3)


def test_missing_pixels_have_the_depth_to_their_left() -> None:
    ramp = np.arange(64, dtype=np.float32) * np.ones((64, 1), np.float32) + 1.0
    depths = partial(measured_depths, {"depth_missing": 0.2}, 0)(ramp)
    assert 0.1 < (depths != ramp).mean() < 0.25
    assert (depths <= ramp).all() and (depths[:, 0] == 1.0).all()


def test_edges_are_ragged_and_planes_are_not() -> None:
    noise = partial(measured_depths, {"depth_edges": 0.5}, 0)
    assert (noise(FLAT) == FLAT).all()
    changed = (noise(EDGE) != EDGE).any(axis=0)
    assert changed[31:33].all() and not changed[:31].any() and not changed[33:].any()


def test_errors_differ_between_seeds_and_cameras(make: Make) -> None:
    env = make(PICKING, randomization="real", observation=["heightmap"])
    env.reset(seed=0)
    camera = env.cameras["render"].camera
    values = {"depth_noise": 0.01}
    images = [measured_depths(values, seed, FLAT, eye) for seed in (0, 1) for eye in (None, camera)]
    assert len({image.tobytes() for image in images}) == 4
    first, again = env.observe(), env.observe()
    assert digest(first) == digest(again)
    env.step(np.zeros(5))
    assert (env.observe()["heightmap"] != first["heightmap"]).mean() > 0.5


def test_depth_sensor_is_noisy(make: Make) -> None:
    sensors = ["depth", "point_cloud"]
    env, noisy = (make(PICKING, observation=sensors, randomization=r) for r in (None, {"depth_noise": 0.01}))
    exact, found = env.reset(seed=0)[0], noisy.reset(seed=0)[0]
    assert 1e-3 < np.abs(found["depth"] - exact["depth"]).mean() < 0.05
    assert (found["point_cloud"] != exact["point_cloud"]).any()


# Actions


def test_delayed_actions_are_executed_one_step_later(make: Make) -> None:
    env, late = make(PICKING), make(PICKING, randomization={"action_delay": 1.0})
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 5)).astype(np.float32)
    actions[:, 0] = 1.0
    for one in (env, late):
        one.reset(seed=0)
    start = late.scene.robot.pose
    late.step(actions[0])
    assert np.allclose(late.scene.robot.pose.position, start.position, atol=1e-3)
    for before, action in itertools.pairwise(actions):
        env.step(before)
        late.step(action)
        assert np.allclose(env.scene.robot.pose.position, late.scene.robot.pose.position, atol=1e-3)


def test_action_noise_spares_the_opening(make: Make) -> None:
    env = make(PICKING, randomization={"action_noise": 0.2})
    openings, moves = [], []
    for seed in range(12):
        env.reset(seed=seed)
        start = env.scene.robot.pose.position
        env.step([1.0, 0.0, 0.0, 0.0, 0.0])
        moves.append(np.subtract(env.scene.robot.pose.position, start))
        openings.append(env.scene.robot.opening_ratio)
    assert np.std(moves) == pytest.approx(0.2 * 0.05, rel=0.5)
    assert np.allclose(openings, 1.0, atol=0.01)
    with pytest.raises(ValueError, match="action must be 5 finite numbers"):
        env.step([1.0, 0.0])


# Exactness


def check_exactness(make: Make, env_id: str, **parameters: Any) -> None:
    """Check determinism, states in another instance, JSON and pickles."""
    parameters = {"obs_size": 32, **parameters}
    env, other = (make(env_id, number, randomization="real", **parameters) for number in range(2))
    expected = transcript(env, 6, seed=3)
    transcript(other, 2, seed=8)
    assert transcript(other, 6, seed=3) == expected
    state = advance(env, 5, 1)
    assert digest(env.observe()) == digest(env.observe())
    copied = pickle.loads(pickle.dumps(env))
    expected = [digest(env.observe()), *transcript(env, 6)]
    other.reset(seed=1)
    other.set_state(json_state.loads(json_state.dumps(state)))
    for one in (other, copied):
        assert [digest(one.observe()), *transcript(one, 6)] == expected
    plain = make_env(env_id, **parameters)
    plain.set_state(state)
    assert [digest(plain.observe()), transcript(plain, 1)[0]] == expected[:2]
    plain.close()
    copied.close()


def check_interface(env_id: str) -> None:
    """Run Gymnasium's check of an environment."""
    env = make_env(env_id, randomization="real", obs_size=32)
    check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("env_id", TYPICAL, ids=lambda env_id: env_id.split("/")[1])
def test_real_randomization_is_exact(make: Make, env_id: str) -> None:
    check_exactness(make, env_id)
    check_interface(env_id)


def test_all_sensors_are_exact(make: Make) -> None:
    cameras = ["heightmap", "rgb", "depth", "point_cloud"]
    check_exactness(make, PICKING, view="point_cloud", observation=cameras)
    check_exactness(make, PICKING, observation=["heightmap", "color", "segmentation", "state"])


def test_states_are_exact_in_another_process(make: Make, in_another_process: Callable[..., Any]) -> None:
    parameters = {"randomization": "real", "obs_size": 32}
    env = make(PICKING, **parameters)
    request = (PICKING, parameters, advance(env, 3, 4))
    assert in_another_process({"picking": request}) == {"picking": transcript(env)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "env_id", [i for i in bulletarm_gym.ENV_IDS if i not in TYPICAL], ids=lambda env_id: env_id.split("/")[1]
)
def test_real_randomization_is_exact_for_all_ids(make: Make, env_id: str) -> None:
    check_exactness(make, env_id)
    check_interface(env_id)


def random_ranges(rng: np.random.Generator, open_loop: bool) -> dict[str, list[float]]:
    """Return accepted ranges of some quantities."""
    chosen = [entry for entry in fields(Randomization) if rng.random() < 0.5]
    ranges = {entry.name: sorted(rng.uniform(*entry.metadata["limits"], 2).tolist()) for entry in chosen}
    return {name: ends for name, ends in ranges.items() if not (open_loop and name == "action_delay")}


def reset_at_random(count: int) -> None:
    """Reset environments with random ranges, and act."""
    rng = np.random.default_rng(0)
    for number in range(count // 10):
        env_id = TYPICAL[number % len(TYPICAL)]
        env = make_env(env_id, obs_size=32, randomization=random_ranges(rng, is_open_loop(env_id)))
        for seed in range(10):
            observation, info = env.reset(seed=seed)
            assert env.observation_space.contains(observation)
            assert all(np.isfinite(list(values_of(info).values())))
        env.step(env.action_space.sample())
        env.close()


def test_resets_with_random_ranges() -> None:
    reset_at_random(60)


@pytest.mark.slow
def test_a_thousand_resets_with_random_ranges() -> None:
    reset_at_random(1000)


PAGE = Path(__file__).parents[2] / "docs" / "guides" / "randomization.md"
ROW = re.compile(r"^\| `(\w+)` \|.*\| ([-\d.]+) to ([-\d.]+) \| ([-\d.]+) to ([-\d.]+) \|$", re.MULTILINE)


def test_the_page_has_the_ranges_of_the_presets() -> None:
    rows = {
        name: [float(end) for end in ends] for name, *ends in ROW.findall(PAGE.read_text(encoding="utf-8"))
    }
    ends = {name: [*getattr(PRESETS["light"], name), *getattr(PRESETS["real"], name)] for name in NAMES}
    assert list(rows) == list(NAMES)
    for name, values in ends.items():
        assert rows[name] == pytest.approx(values, rel=0.01, abs=1e-9), name
