"""Properties that tasks change, and sampled physics, cameras and noise: in effect, stored and repeatable."""

import itertools
import math
import re
from contextlib import closing
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rollouts import PICKING, STACKING, TYPICAL, advance, digest, is_open_loop, make_env, transcript

from bulletarm_gym.observations.depth_noise import measured_depths
from bulletarm_gym.randomization import NAMES, PRESETS, Randomization
from bulletarm_gym.simulation.state import Properties

DRAWER = "BulletArm/CloseLoopDrawerOpening-v0"
CHANGES = {"mass": 0.08, "friction": 0.7, "rolling_friction": 1e-3, "spinning_friction": 2e-3}
CHANGES |= {"restitution": 0.1}
GREEN = (0.1, 0.9, 0.2, 1.0)
PREFIX = "randomization/"
FACTORS = {"object_friction": 0.8, "surface_friction": 1.2, "object_mass": 0.5}


def values_of(info):
    """Return the sampled values in an info."""
    return {key.removeprefix(PREFIX): value for key, value in info.items() if key.startswith(PREFIX)}


def test_invalid_ranges_are_rejected_by_name():
    for name, value in itertools.product(NAMES, ([2.0, -2.0], [0.0, 99.0], float("nan"), ["1", "1"], [1.0])):
        with pytest.raises(ValueError, match=rf"^{name} must be a number or \[low, high\], from .*, got "):
            Randomization(**{name: value})
    for env_id, name, value in ((PICKING, "object_mass", "much"), (STACKING, "action_delay", 0.1)):
        with pytest.raises(ValueError, match=rf"randomization: {name} must be .*, got .*{value}"):
            make_env(env_id, randomization={name: value})


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_sampled_values_are_in_info(make, env_id):
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


def in_engine(env):
    """Return the engine's dynamics and colour of the cube."""
    client, body = env.scene.world.client, env.scene["cube"].body
    (shape,) = client.getVisualShapeData(body.id)
    return (*client.getDynamicsInfo(body.id, -1)[:8], tuple(np.float32(shape[7]).tolist()))


def test_properties_are_in_effect_until_the_next_reset(picking):
    expected = transcript(picking, 20, seed=0)
    picking.reset(seed=0)
    item = picking.scene["cube"]
    before = in_engine(picking)
    item.set_properties(**CHANGES, colour=GREEN)
    assert item.properties == Properties(**CHANGES, colour=GREEN)
    mass, friction, inertia, _, _, restitution, rolling, spinning, colour = in_engine(picking)
    assert (mass, friction, restitution, rolling, spinning) == (0.08, 0.7, 0.1, 1e-3, 2e-3)
    np.testing.assert_allclose(inertia, np.array(before[2]) * 0.08 / item.spec.mass)
    assert colour == pytest.approx(GREEN)
    item.set_properties(mass=0.2)
    assert item.properties.mass == 0.2 and item.properties.friction == 0.7
    picking.reset(seed=0)
    assert item.properties == Properties.of(item.spec) and in_engine(picking) == before
    assert transcript(picking, 20, seed=0) == expected


def test_colour_in_effect_is_observed_and_rendered(make):
    env = make(PICKING, render_mode="rgb_array", observation=["color"], obs_size=32, seed=0)
    before = env.render()
    env.scene["cube"].set_properties(colour=GREEN)
    changed = env.observe()["color"].reshape(3, -1).T == np.rint(255 * np.array(GREEN[:3]))
    assert changed.all(axis=1).any() and (env.render() != before).any()


def test_property_out_of_range_is_rejected(make):
    env = make("BulletArm/CloseLoopCornerPicking-v0", seed=0)
    before = env.get_state()
    wrong = [("mass", 0.0), ("friction", "1"), ("restitution", math.nan), ("colour", (0.1, 0.2, 0.3, 1.1))]
    for slot, name, value in [*(("cube", *pair) for pair in wrong), ("corner", "mass", 1.0)]:
        with pytest.raises(ValueError, match=rf"^{name} must be .*, got "):
            env.scene[slot].set_properties(**{name: value})
    with pytest.raises(TypeError, match="weight"):
        env.scene["cube"].set_properties(weight=1.0)
    for value in (-1.0, "1"):
        with pytest.raises(ValueError, match=r"^friction must be .*, got "):
            env.scene.set_surface_properties(friction=value)
    assert env.get_state() == before


def test_factors_change_the_properties_of_bodies(make):
    env = make(DRAWER, randomization={**FACTORS, "gripper_force": 1.5, "colour": 0.5}, seed=0)
    world, robot = env.scene.world, env.scene.robot
    for obj in env.scene.objects:
        assert obj.properties.friction == pytest.approx(0.8 * obj.spec.friction)
        assert obj.properties.mass == pytest.approx(0.5 * obj.spec.mass)
        assert obj.properties.colour != obj.spec.colour
    assert world.get_properties(world.ground).friction == pytest.approx(1.2 * world.ground.spec.friction)
    assert robot._fingers.forces == (1.5 * robot.model.gripper.force,) * 2


def test_resistance_of_joints_changes_motions(make):
    found = []
    for ranges in (None, {"joint_resistance": 1.0}, {"joint_resistance": 10.0}):
        env = make(DRAWER, randomization=ranges)
        advance(env, 0, 5)
        found.append(env.scene["drawer"].joints)
    assert found[0] == found[1] != found[2]


def test_calibration_error_moves_images(make):
    above = {"name": "above", "sensor": "depth", "position": [0.45, 0, 1], "target": [0.45, 0, 0]}
    exact, shifted, rotated = (
        make(PICKING, observation=["heightmap", above, "point_cloud"], randomization=error)
        for error in (None, {"camera_position": [0.02, 0.02]}, {"camera_rotation": [0.1, 0.1]})
    )
    images = {env: env.reset(seed=0)[0] for env in (exact, shifted, rotated)}
    heights = images[exact]["heightmap"][0]
    pixels = round(0.02 / (0.45 / 128))
    moved = np.roll(heights, (pixels, pixels), (0, 1)) - 0.02
    assert np.isclose(images[shifted]["heightmap"][0], moved, atol=2e-3).mean() > 0.97
    assert not np.allclose(images[rotated]["heightmap"][0], heights, atol=5e-3)
    for other in (shifted, rotated):
        assert not np.allclose(images[other]["above"], images[exact]["above"], atol=5e-3)
        assert (other.cameras["above"].extrinsics == exact.cameras["above"].extrinsics).all()
    clouds = [images[env]["point_cloud"].mean(axis=0) for env in (exact, shifted)]
    assert 1e-3 < np.abs(clouds[0] - clouds[1]).max() < 0.06, "computed with the nominal camera"


def test_light_changes_rendered_images(make):
    plain, dark, other = (
        make(PICKING, render_mode="rgb_array", render_size=64, randomization=ranges, seed=0).render()
        for ranges in (None, {"light_brightness": 0.5}, {"light_direction": [-0.5, -0.5]})
    )
    assert dark.mean() < 0.95 * plain.mean() and (other != plain).any()


FLAT = np.full((64, 64), 0.8, np.float32)
EDGE = np.where(np.arange(64) < 32, 0.8, 0.9).astype(np.float32) * np.ones((64, 1), np.float32)


def test_depth_noise_grows_with_the_square_of_the_distance():
    noise = partial(measured_depths, {"depth_noise": 0.002}, 0)
    for distance in (0.5, 1.0, 2.0):
        errors = noise(np.full((128, 128), distance, np.float32)) - distance
        assert errors.std() == pytest.approx(0.002 * distance**2, rel=0.05)
        assert abs(errors.mean()) < 1e-4


def test_depth_step_and_missing_pixels():
    """Depths are multiples of a step of disparity; a missing pixel has the depth to its left."""
    depths = measured_depths({"depth_step": 0.01}, 0, np.linspace(0.9, 1.1, 64, dtype=np.float32)[None])
    found = np.unique(depths)
    assert 15 < len(found) < 25 and np.diff(found).min() == pytest.approx(0.0085, abs=1e-3)
    ramp = np.arange(64, dtype=np.float32) * np.ones((64, 1), np.float32) + 1.0
    depths = measured_depths({"depth_missing": 0.2}, 0, ramp)
    assert 0.1 < (depths != ramp).mean() < 0.25
    assert (depths <= ramp).all() and (depths[:, 0] == 1.0).all()


def test_edges_are_ragged_and_planes_are_not():
    noise = partial(measured_depths, {"depth_edges": 0.5}, 0)
    assert (noise(FLAT) == FLAT).all()
    changed = (noise(EDGE) != EDGE).any(axis=0)
    assert changed[31:33].all() and not changed[:31].any() and not changed[33:].any()


def test_delayed_actions_are_executed_one_step_later(make):
    env, late = make(PICKING, seed=0), make(PICKING, randomization={"action_delay": 1.0}, seed=0)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 5)).astype(np.float32)
    actions[:, 0] = 1.0
    for number, action in enumerate(actions):
        late.step(action)
        np.testing.assert_allclose(late.scene.robot.pose[0], env.scene.robot.pose[0], atol=1e-3)
        env.step(actions[number])


def test_action_noise_spares_the_opening(make):
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


def test_a_randomized_state_continues_without_the_parameter(make, typical_id):
    env, plain = make(typical_id, obs_size=32, randomization="real"), make(typical_id, obs_size=32)
    check_env(env, skip_render_check=True)
    plain.set_state(advance(env, 5, 1))
    assert digest(plain.observe()) == digest(env.observe())
    assert transcript(plain, 1)[0] == transcript(env, 1)[0]


def test_resets_with_random_ranges(typical_id):
    rng = np.random.default_rng(TYPICAL.index(typical_id))
    chosen = [entry for entry in fields(Randomization) if rng.random() < 0.5 and entry.name != "action_delay"]
    ranges = {entry.name: sorted(rng.uniform(*entry.metadata["limits"], 2).tolist()) for entry in chosen}
    with closing(make_env(typical_id, obs_size=32, randomization=ranges)) as env:
        for seed in range(10):
            observation, info = env.reset(seed=seed)
            assert env.observation_space.contains(observation)
            assert all(np.isfinite(list(values_of(info).values())))
        env.step(env.action_space.sample())


PAGE = Path(__file__).parents[2] / "docs" / "guides" / "randomization.md"
ROW = re.compile(r"^\| `(\w+)` \|.*\| ([-\d.]+) to ([-\d.]+) \| ([-\d.]+) to ([-\d.]+) \|$", re.MULTILINE)


def test_the_page_has_the_ranges_of_the_presets():
    rows = {name: list(map(float, ends)) for name, *ends in ROW.findall(PAGE.read_text(encoding="utf-8"))}
    ends = {name: [*getattr(PRESETS["light"], name), *getattr(PRESETS["real"], name)] for name in NAMES}
    assert list(rows) == list(NAMES)
    for name, values in ends.items():
        assert rows[name] == pytest.approx(values, rel=0.01, abs=1e-9), name
