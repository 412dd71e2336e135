"""Tasks that pack, palletise, present and sort objects, and Object Grasping, whose clutter stays."""

import itertools
import math
import pickle
from collections import Counter
from unittest.mock import patch

import numpy as np
import pytest
from rollouts import GRASPING, PICKING, finish, make_env, transcript

from bulletarm_gym.config import LIFT_HEIGHT
from bulletarm_gym.geometry import PlacementError, Pose
from bulletarm_gym.objects.containers import PALLET
from bulletarm_gym.scene.predicates import inside, loose_objects
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.simulation.shapes import BLUE, RED
from bulletarm_gym.tasks.palletizing import layer_yaw, places

PACKING, BOTTLES = "BulletArm/OpenLoopBinPacking-v0", "BulletArm/OpenLoopBottleArrangement-v0"
PALLETIZING, BUMP = "BulletArm/OpenLoopBoxPalletizing-v0", "BulletArm/OpenLoopBumpBoxPalletizing-v0"
COVID = "BulletArm/OpenLoopCovidTest-v0"
SORTING = ("BulletArm/CloseLoopBlockSorting-v0", "BulletArm/OpenLoopBlockSorting-v0")
WIDTH, LENGTH, HEIGHT = 0.045, 0.072, 0.045


def place_while_empty(env):
    """Act without effect on the robot; return whether that terminated the episode, and the info."""
    *_, terminated, _, info = env.step(np.ones(env.action_space.shape, np.float32))
    return terminated, info


def place(env, frame, **poses):
    """Place objects, named with underscores, at poses in the frame of another object."""
    for name, pose in poses.items():
        env.scene[name.replace("_", " ")].place(env.scene[frame].pose.compose(pose))


# Bin and bottles


def test_blocks_are_packed_below_the_rim(make):
    env = make(PACKING, num_objects=1, seed=0)
    outside = ((0.0, 0.0, 0.081), (0.09, 0.0, 0.03), (0.0, 0.074, 0.03))
    for local in ((0.08, 0.06, 0.079), *outside):
        place(env, "bin", block_0=Pose(local))
        assert env.task.evaluate(env.scene)["is_packed"] is (local not in outside)


def test_spinning_block_comes_to_rest(make):
    env = make(PACKING, num_objects=1, seed=0)
    block = env.scene["block 0"]
    block.park()
    block.variant = 6  # Bullet never slows this shape
    pose = env.scene["bin"].pose.compose(Pose.planar(0.0, 0.0, 0.0134, 1.0))
    block.place(pose, ((0.0,) * 3, (0.0, 0.0, 20.0)))
    _, info = place_while_empty(env)
    assert info["is_at_rest"] and inside(block, env.scene["bin"])


def test_bottles_are_upright_in_the_tray(make):
    env = make(BOTTLES, num_objects=1, seed=0)
    half = env.scene["bottle 0"].spec.extents[2] / 2.0
    for local, arranged in (((0.05, 0.03, 0.005 + half), True), ((0.15, 0.0, half), False)):
        place(env, "tray", bottle_0=Pose(local))
        assert env.task.evaluate(env.scene)["is_arranged"] == arranged and env.task.is_valid(env.scene)
    place(env, "tray", bottle_0=Pose((0.05, 0.03, 0.1), (0.7071, 0.0, 0.0, 0.7071)))
    assert not env.task.is_valid(env.scene) and not env.task.evaluate(env.scene)["success"]


# Pallet


def stack(env, count, yaw=0.0):
    """Put boxes in the first places, all rotated by an angle (rad)."""
    for number, box in enumerate(env.scene.objects[1 : 1 + count]):
        layer, place = divmod(number, 6)
        height = PALLET[2] + (layer + 0.5) * HEIGHT
        frame = places(layer, WIDTH, LENGTH)[place].compose(Pose.planar(0.0, 0.0, height, yaw))
        box.place(env.scene["pallet"].pose.compose(frame))


def test_next_box_appears_when_all_are_correct(make):
    one = [(1, 0.35, 1), (1, -0.45, 0), (1, math.pi / 2.0, 0)]
    for count, yaw, correct in [*one, (6, 0.0, 1), (7, math.pi, 1), (17, 0.0, 1)]:
        pallet = make(PALLETIZING, max_steps=100, seed=0)
        stack(pallet, count, yaw)
        for _ in range(2):
            place_while_empty(pallet)
            assert len(loose_objects(pallet.scene)) == count + correct
        assert not pallet.task.evaluate(pallet.scene)["success"]


def test_next_box_waits_for_full_layers_below(make):
    pallet = make(PALLETIZING, max_steps=100, seed=0)
    stack(pallet, 8)
    pallet.scene["box 2"].park()
    place_while_empty(pallet)
    assert len(loose_objects(pallet.scene)) == 7
    stack(pallet, 18)
    assert place_while_empty(pallet)[1]["is_success"]


@pytest.mark.parametrize(("env_id", "is_random"), [(PALLETIZING, False), (BUMP, True)])
def test_boxes_appear_inside_and_apart(make, env_id, is_random):
    env = make(env_id, max_steps=100, random_orientation=is_random)
    for seed in range(15):
        layer = seed % 3
        env.reset(seed=seed)
        stack(env, 6 * layer)
        _, info = place_while_empty(env)
        box, base = env.scene[f"box {6 * layer}"], env.scene["pallet"]
        assert info["is_valid"] and info["is_at_rest"]
        assert footprint(box).is_inside(env.config.workspace) and footprint(box).gap(footprint(base)) > 0.0
        if not is_random:
            yaw = box.pose.yaw - base.pose.yaw - layer_yaw(layer)
            assert math.sin(yaw) == pytest.approx(0.0, abs=1e-3)


def test_boxes_of_an_episode_have_one_size(make):
    env, sizes = make(PALLETIZING, num_objects=6, object_scale_range=[0.6, 0.8]), set()
    for seed in range(3):
        env.reset(seed=seed)
        heights = {box.spec.extents[2] for box in env.scene.objects[1:]}
        assert len(heights) == 1 and finish(env)[0]
        sizes |= heights
    assert len(sizes) > 1


def test_episode_ends_if_the_next_box_has_no_free_pose(make):
    pallet = make(PALLETIZING, max_steps=100, seed=0)
    stack(pallet, 1)
    with patch("bulletarm_gym.tasks.palletizing.sample_until", side_effect=PlacementError("no room")):
        _, reward, terminated, _, info = pallet.step(np.ones(pallet.action_space.shape, np.float32))
    assert (reward, terminated, info["is_valid"]) == (0.0, True, False)
    assert pallet.reset(seed=0)[1]["is_valid"]


# Covid tests


def test_containers_touch_and_are_inside(make):
    env = make(COVID)
    for seed in range(20):
        env.reset(seed=seed)
        containers = [env.scene[name] for name in ("new box", "test area", "used box")]
        assert all(footprint(place).is_inside(env.config.workspace) for place in containers)
        local = containers[1].pose.inverse()  # gaps are exact in this frame
        bases = [footprint(place, local.compose(place.pose)) for place in containers]
        assert min(one.gap(other) for one, other in itertools.combinations(bases, 2)) > -1e-6
        loose = loose_objects(env.scene)
        assert len(loose) == 6 and all(inside(obj, containers[0]) for obj in loose)


def test_pair_becomes_a_used_tube_at_a_random_pose(make):
    env, poses = make(COVID, max_steps=100), []
    for seed in range(12):
        env.reset(seed=seed)
        place(env, "test area", swab_1=Pose((0.0, 0.06, 0.012)))
        assert not place_while_empty(env)[0] and env.scene["swab 1"].is_present
        place(env, "test area", tube_2=Pose((0.0, -0.06, 0.012)))
        assert not place_while_empty(env)[0]
        names = {item.slot.name for item in loose_objects(env.scene)}
        assert names == {"swab 0", "swab 2", "tube 0", "tube 1", "used tube 0"}
        used = env.scene["used tube 0"]
        assert inside(used, env.scene["test area"])
        frame = env.scene["test area"].pose.inverse().compose(used.pose)
        poses.append((frame.y, frame.yaw))
    assert (np.ptp(poses, axis=0) > (0.08, 2.0)).all()


@pytest.mark.parametrize("names", [("swab_0", "swab_1"), ("tube_0", "tube_1"), ("tube_0", "used_tube_0")])
def test_two_of_a_kind_in_the_test_area_are_invalid(make, names):
    covid = make(COVID, max_steps=100, seed=0)
    place(covid, "test area", **{names[0]: Pose((0.0, -0.06, 0.012)), names[1]: Pose((0.0, 0.06, 0.012))})
    terminated, info = place_while_empty(covid)
    assert terminated and not info["is_valid"] and not info["is_success"]


def test_three_used_tubes_in_their_box_are_the_goal(make):
    covid = make(COVID, max_steps=100, seed=0)
    for number in range(3):
        assert not covid.task.evaluate(covid.scene)["success"]
        place(covid, "used box", **{f"used_tube_{number}": Pose((0.0, 0.025 * (number - 1), 0.012))})
    assert covid.task.evaluate(covid.scene)["success"]


# Sorting


def fill_bowls(env, swapped):
    """Place two cubes in each bowl, of its colour or of the other."""
    env.reset(seed=0)
    x, y = env.config.centre
    sites = {"red": (x, y - 0.08), "blue": (x, y + 0.08)}
    for name, site in sites.items():
        env.scene[f"{name} bowl"].place(Pose.planar(*site, 0.028))
    for name, other in (("red", "blue"), ("blue", "red")):
        site = sites[other if swapped else name]
        for number, aside in enumerate((-0.0157, 0.0157)):
            env.scene[f"{name} cube {number}"].place(Pose.planar(site[0] + aside, site[1], 0.021))


@pytest.mark.parametrize("env_id", SORTING)
def test_only_colours_show_which_cubes_are_sorted(make, env_id):
    env, observed = make(env_id), []
    for swapped in (False, True):
        fill_bowls(env, swapped)
        observed.append(env.observe())
        assert env.task.is_valid(env.scene)
        assert env.task.evaluate(env.scene)["success"] is not swapped
        for colour in (RED, BLUE):
            code = np.array([round(255 * part) for part in colour[:3]])[:, None, None]
            assert (observed[-1]["color"] == code).all(axis=0).sum() > 100
    assert np.array_equal(observed[0]["heightmap"], observed[1]["heightmap"])
    assert not np.array_equal(observed[0]["color"], observed[1]["color"])
    fill_bowls(env, swapped=False)
    env.scene["red cube 0"].place(Pose.planar(env.config.centre[0] + 0.1, 0.0, 0.015))
    assert not env.task.evaluate(env.scene)["is_sorted"]
    env.scene["red bowl"].place(Pose(env.scene["red bowl"].pose.position, (1.0, 0.0, 0.0, 0.0)))
    assert not env.task.is_valid(env.scene), "a bowl upside down"


# Object Grasping


def _poses(env):
    return {item.slot.name: item.pose for item in env.scene}


def test_grasped_object_is_removed_at_reset_and_the_others_stay(make):
    """Also in the state."""
    env = make(GRASPING)
    _, info = env.reset(seed=1)
    before = set(_poses(env))
    assert len(before) == 5 and info["is_valid"] and not info["is_held"]
    assert finish(env)[0]
    held = env.scene.held
    assert held is not None and env.scene.robot.pose.z > LIFT_HEIGHT  # still observed
    env.reset()
    assert set(_poses(env)) == before - {held.slot.name}
    assert env.scene.robot.held is None and env.scene.robot.opening_ratio == 1.0
    other = make(GRASPING, 1, seed=6)
    other.set_state(pickle.loads(pickle.dumps(env.get_state())))
    assert _poses(other) == _poses(env)
    assert transcript(other, 8) == transcript(env, 8)


def test_scene_is_new_only_with_a_seed_an_option_or_an_invalid_scene(make):
    env = make(GRASPING, seed=2)
    before = _poses(env)
    for arguments in ({}, {"options": {"new_scene": False}}):
        env.reset(**arguments)
        assert _poses(env) == before
    env.reset(options={"new_scene": True})
    assert _poses(env).keys() != before.keys()
    before = _poses(env)
    next(iter(env.scene)).place(Pose((0.45, 0.3, 0.02)))
    env.reset()
    assert _poses(env).keys() != before.keys() and len(_poses(env)) == 5


def test_new_objects_appear_when_all_are_grasped(make):
    env, names = make(GRASPING, num_objects=1), set()
    env.reset(seed=0)
    for _ in range(4):
        assert len(_poses(env)) == 1
        names |= set(_poses(env))
        assert finish(env)[0]
        env.reset()
    assert len(names) > 2


@pytest.mark.parametrize("parameters", [{}, {"random_orientation": False, "action_sequence": "pxyz"}])
def test_expert_clears_the_tray(make, parameters):
    env, outcomes = make(GRASPING, **parameters), []
    env.reset(seed=0)
    for _ in range(6):
        outcomes.append(finish(env)[0])
        env.reset()
    assert sum(outcomes) >= 5


def test_tray_is_possible_in_other_tasks(make):
    env = make(PICKING, close_loop_tray=True)
    observation, _ = env.reset(seed=0)
    assert env.scene["cube"].pose.z == pytest.approx(0.027, abs=1e-3)
    assert observation["heightmap"][0, 0, 0] < observation["heightmap"].max() - 0.05  # the wall
    assert finish(env)[0]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
def test_every_object_alone_is_lifted(robot):
    env, lifted = make_env(GRASPING, robot=robot, num_objects=1), Counter()
    for index, item in enumerate(env.scene.objects):
        for seed in range(5):
            env.reset(seed=seed)
            rng = np.random.default_rng((index, seed))
            env.scene.clear(rng)
            env.task.drop(env.scene, [item], rng)
            lifted[item.slot.name] += finish(env)[0]
    assert min(lifted.values()) >= 4, lifted
