"""Arguments of wrong types: each raises an error that names the parameter and the value."""

import dataclasses
from functools import partial

import gymnasium
import numpy as np
import pytest
from rollouts import PICKING

import bulletarm_gym
from bulletarm_gym.config import TaskDefaults
from bulletarm_gym.control import DeltaMove, GraspParams, PickPlace
from bulletarm_gym.demonstrations import Demonstrations, export_lerobot, export_minari, export_rlds
from bulletarm_gym.demonstrations.robomimic import export_robomimic
from bulletarm_gym.geometry import Mesh, Pose, Rectangle
from bulletarm_gym.observations import Overlay
from bulletarm_gym.real_arm import close_loop_heightmap, elevation_map, in_hand_image, open_loop_heightmap
from bulletarm_gym.robots import KUKA, OutOfReachError, ParallelJaw, attach
from bulletarm_gym.robots.editing import LIGHT, box
from bulletarm_gym.scene import ObjectSlot
from bulletarm_gym.simulation import BodySpec, Box, Convex, Hinge, Piece, Slide
from bulletarm_gym.tasks import Waypoint
from bulletarm_gym.tasks.picking import BlockPicking
from bulletarm_gym.vector import reset_to_states
from bulletarm_gym.wrappers import GoalObservation

BOX = Piece(Box((0.1, 0.1, 0.1)))
SPEC = BodySpec("brick", (BOX,), 0.1)
BOLT = Slide("bolt", (BOX,), 0.1, (1, 0, 0), (0, 1))
PART = box((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), LIGHT)
OVERLAY = Overlay(Rectangle(0.0, 0.0, 1.0, 1.0, 0.0), 0.02)
JAW = KUKA.gripper
RECORDS = [
    (KUKA, "base", (0.1, 0.0, 0.0), r"got \(0\.1"),
    (KUKA, "base", Pose((0.0, 0.0, "1")), "got Pose.*'1'"),
    (KUKA, "tool", Pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 2.0)), "unit quaternion.*got Pose"),
    (KUKA, "load", "arm.urdf", "got 'arm.urdf'"),
    (KUKA, "gripper", "jaw", "got 'jaw'"),
    (KUKA, "joints", "lbr_joint", "got 'lbr_joint'"),
    (KUKA, "force", 0, "a positive number, got 0"),
    (KUKA, "posture", (0.0, 1.0), "7 finite numbers, got"),
    (JAW, "stroke", "0.1", "a positive number, got '0.1'"),
    (JAW, "speed", np.nan, "a positive number, got nan"),
    (JAW, "force", -1.0, "a positive number, got -1"),
    (JAW, "finger", 0.1, "3 non-negative numbers, got 0.1"),
    (JAW, "joints", "ab", "two joints, got 'ab'"),
    (SPEC, "mass", "1", "got '1'"),
    (SPEC, "friction", -1, "got -1"),
    (SPEC, "pieces", BOX, "got Piece"),
    (SPEC, "colour", (1, 0, 0, 255), "got .*255"),
    (BOX, "shape", (0.1, 0.1, 0.1), r"got \(0\.1"),
    (BOX, "pose", (0.1, 0.1, 0.1), r"got \(0\.1"),
    (Box((1.0, 1.0, 1.0)), "extents", (1, 1), r"got \(1, 1\)"),
    (BOLT, "resistance", "1", "got '1'"),
    (BOLT, "axis", (0.0, 0.0, 2.0), r"a unit vector, got \(0\.0"),
    (BOLT, "limits", (0.1, 0.0), r"ascending order, got \(0\.1"),
    (Hinge("lid", (BOX,), 0.1, (1, 0, 0), (0, 1)), "pivot", (0.0, 0.0), r"got \(0\.0"),
    (Convex(Mesh.box((0.1, 0.1, 0.1))), "mesh", "cube.obj", "got 'cube.obj'"),
    (PART, "kind", "sphere", "got 'sphere'"),
    (PART, "extents", (0.1, 0.0, 0.1), r"positive numbers, got \(0\.1"),
    (OVERLAY, "rise", np.nan, "got nan"),
    (OVERLAY, "rectangle", (0.0, 0.0, 1.0, 1.0, 0.0), r"got \(0\.0"),
    (ObjectSlot("cube", (SPEC,)), "variants", SPEC, "got BodySpec"),
    (GraspParams(0.1), "pick_offset", None, "got None"),
    (DeltaMove(1.0, (0.0, 0.0, 0.0)), "opening", "1", "got '1'"),
    (DeltaMove(1.0, (0.0, 0.0, 0.0)), "translation", (0.0, np.nan, 0.0), r"got \(0\.0, nan"),
    (PickPlace("pick", (0.4, 0.0, 0.1)), "rotation", 0.5, "3 finite numbers, got 0.5"),
    (Waypoint(Pose((0.0, 0.0, 0.1)), 1.0), "pose", (0.0, 0.0, 0.1), r"got \(0\.0"),
    (Waypoint(Pose((0.0, 0.0, 0.1)), 1.0), "gripper", 85.0, "from 0 to 1, got 85"),
    (Waypoint(Pose((0.0, 0.0, 0.1)), 1.0), "finish", -1.0, "from 0 to 1, got -1"),
    (TaskDefaults(1), "allowed_objects", 3, "got 3"),
    (TaskDefaults(1), "sensors", "color", "got 'color'"),
]
FLAT = [[0.2, 0.6], [-0.1, 0.1], [0.0, 1.0]]
"""Limits (m) of a workspace that is not square."""
EXPORTS = [export_lerobot, export_minari, export_rlds, export_robomimic]


@pytest.mark.parametrize(("record", "name", "value", "reason"), RECORDS)
def test_fields_of_components_are_checked(record, name, value, reason):
    with pytest.raises(ValueError, match=rf"^{name}\b.* must be .*{reason}"):
        dataclasses.replace(record, **{name: value})


@pytest.mark.parametrize("export", EXPORTS)
def test_exports_need_demonstrations(picked, export, tmp_path):
    if export is not export_robomimic:
        pytest.importorskip(export.__name__.removeprefix("export_").replace("rlds", "tensorflow"))
    path = tmp_path / "new"
    for wrong in (picked[:0], tmp_path, list(picked)):
        with pytest.raises(ValueError, match=r"^demonstrations must be .*, got "):
            export(wrong, path)
    if export is not export_minari:
        with pytest.raises(ValueError, match=r"^cameras must be .*, got \['front'\]"):
            export(picked, path, cameras=["front"])
    assert not path.exists()


def test_demonstrations_are_indexed_as_arrays(picked):
    last = picked[-1].actions.tolist()
    for index in ([1], np.array([-1]), np.array([False, True]), slice(1, None)):
        part = picked[index]
        assert isinstance(part, Demonstrations) and [e.actions.tolist() for e in part] == [last]
    assert picked[np.int64(1)].actions.tolist() == last and len(picked[[]]) == 0
    for wrong in (2, [2], "a", 0.5, None, [[0]]):
        with pytest.raises(IndexError):
            picked[wrong]


def test_methods_name_the_argument(picking):
    picking.reset(seed=0)
    cube, envs = picking.scene["cube"], gymnasium.make_vec(PICKING, 2, obs_size=16)
    calls = {
        ("move", "None"): partial(picking.encode_action, None),
        ("points", "'cloud'"): partial(open_loop_heightmap, "cloud"),
        ("workspace", r"\[\[0\.2"): partial(open_loop_heightmap, np.zeros((1, 3)), FLAT),
        ("workspace", r"\[\[0\.2.*"): partial(close_loop_heightmap, np.zeros((1, 3)), cube.pose, 0.0, FLAT),
        ("heightmap", "array"): partial(elevation_map, np.zeros((8, 8))),
        ("heightmap", "array.*nan"): partial(elevation_map, np.full((1, 8, 8), np.nan)),
        ("size", "8.5"): partial(in_hand_image, np.zeros((1, 8, 8)), cube.pose, size=8.5),
        ("ratio", "nan"): partial(picking.control.robot.set_opening, np.nan),
        ("ratio", "5"): partial(picking.control.robot.set_opening, 5),
        ("faces", "0 to 3"): partial(Mesh.of, np.eye(3), [[0, 1, 3]]),
        ("faces", "-1 to 1"): partial(Mesh.of, np.eye(3), [[0, 1, -1]]),
        ("vertices", "NaN"): partial(Mesh.of, np.full((3, 3), np.inf), [[0, 1, 2]]),
        ("image", "'demos.h5'"): partial(Demonstrations, "demos.h5"),
        ("env", "<.*CartPole"): partial(GoalObservation, gymnasium.make("CartPole-v1")),
        ("pose", r"\(0\.4"): partial(cube.place, (0.4, 0.0, 0.1)),
        ("twist", r"\(0\.0"): partial(cube.place, cube.pose, (0.0, 0.0, 1.0)),
        ("positions", r"\[0\.1\]"): partial(cube.set_joints, [0.1]),
        ("states", "None"): partial(reset_to_states, envs, None),
        ("root", "None"): partial(attach, None, "link", KUKA.load(), cube.pose),
        ("mount", r"\(0\.0"): partial(attach, KUKA.load(), "link", KUKA.load(), (0.0, 0.0, 0.0)),
        ("flange", r"\(0\.0"): partial(ParallelJaw.tool, JAW, (0.0, 0.0, 0.0)),
        ("robot", "<function"): partial(gymnasium.make, PICKING, robot=lambda: 3),
        ("component", "3"): partial(bulletarm_gym.register_sensor, "number", 3),
    }
    for (name, value), call in calls.items():
        with pytest.raises(ValueError, match=f"^{name} must be .*, got {value}"):
            call()
    with pytest.raises(OutOfReachError, match="nan"):
        picking.control.robot.move_to(Pose((np.nan, 0.0, 0.2)))
    picking.reset(seed=0)
    reset_to_states(envs, iter([picking.get_state()] * 2))
    envs.close()


def bad_class(**attributes):
    """Return a task of this module, whose name is registered."""
    kind = type("Picking", (BlockPicking,), {"__module__": __name__, **attributes})
    globals()["Picking"] = kind
    return kind


@pytest.mark.parametrize(
    ("attributes", "place", "reason"),
    [
        ({"defaults": TaskDefaults(1, level_ground="balls roll")}, "ramp", "surface must be .*, got 'ramp'"),
        ({}, "open_loop", "control must be .*close_loop.*, got 'open_loop'"),
        ({"controls": "close_loop"}, "close_loop", "controls of Picking must be .*, got 'close_loop'"),
        ({"controls": ("closed_loop",)}, "close_loop", "controls of Picking must be .*'closed_loop'"),
        ({"defaults": TaskDefaults(1, max_steps="9")}, "close_loop", "max_steps must be .*, got '9'"),
        ({"defaults": TaskDefaults(1, close_loop={"obs_size": 3})}, "close_loop", "obs_size must .*got 3"),
        ({"defaults": {"max_steps": 3}}, "close_loop", "defaults of Picking must be .*, got {"),
    ],
)
def test_a_task_that_cannot_be_combined_is_not_registered(attributes, place, reason):
    known = set(gymnasium.registry)
    with pytest.raises(ValueError, match=f"^{reason}"):
        name = "surface" if place == "ramp" else "control"
        bulletarm_gym.register_task("Picking", bad_class(**attributes), **{name: place})
    assert set(gymnasium.registry) == known
