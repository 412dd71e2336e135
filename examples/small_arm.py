"""A five-joint arm of the size of a desktop kit: reach 0.37 m, jaw of 5 cm, torques of hobby servos.

python examples/small_arm.py    five episodes of the expert on each of four closed-loop tasks
"""

import math
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element

import gymnasium

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ParallelJaw, RobotModel
from bulletarm_gym.robots.editing import DARK, LIGHT, add_link, box, cylinder
from bulletarm_gym.simulation.urdf import add_joint

TORQUE = 2.9
"""Maximum torque (N m) of a servo of 30 kg cm."""
UP, ACROSS = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
SHOULDER, UPPER_ARM, FOREARM, WRIST = 0.06, 0.116, 0.135, 0.04
"""Distances (m) between the joints, from the second joint to the last."""
SEGMENTS = (
    ("pan", Pose((0.0, 0.0, 0.055)), UP, 1.92, 0.1, (0.05, 0.045, SHOULDER)),
    ("lift", Pose((0.0, 0.0, SHOULDER)), ACROSS, 1.75, 0.1, (0.035, 0.03, UPPER_ARM)),
    ("elbow", Pose((0.0, 0.0, UPPER_ARM)), ACROSS, 2.8, 0.1, (0.03, 0.03, FOREARM)),
    ("wrist", Pose((0.0, 0.0, FOREARM)), ACROSS, 1.75, 0.08, (0.03, 0.03, WRIST)),
    ("roll", Pose((0.0, 0.0, WRIST)), UP, 2.74, 0.05, (0.03, 0.03, 0.01)),
)
"""Name, pose in the parent link, axis, limit (rad), mass (kg) and box (m) of each joint and its link."""
JAW = ParallelJaw(stroke=0.05, palm=(0.06, 0.03, 0.03), finger=(0.008, 0.015, 0.05), force=10.0)
FLANGE = Pose((0.0, 0.0, 0.01))


def bare_arm() -> Element:
    """Return the URDF of the arm without its jaw."""
    root = Element("robot", name="small")
    add_link(root, "base", 0.15, [cylinder(0.04, 0.05, (0.0, 0.0, 0.025), DARK)])
    parent = "base"
    for name, origin, axis, limit, mass, size in SEGMENTS:
        add_link(root, name, mass, [box(size, (0.0, 0.0, size[2] / 2.0), LIGHT)])
        links, limits = (parent, name), (-limit, limit)
        add_joint(root, "revolute", f"{name}_joint", links, origin, axis, limits)
        parent = name
    return root


LIFT, ELBOW = 0.33, 1.43
SMALL = RobotModel(
    name="small",
    load=partial(JAW.fitted, bare_arm, "roll", FLANGE),
    joints=tuple(f"{name}_joint" for name, *_ in SEGMENTS),
    tool=JAW.tool(FLANGE).compose(Pose.planar(0.0, 0.0, 0.0, math.pi)),
    gripper=JAW,
    base=Pose((0.0, 0.0, 0.05)),
    posture=(0.0, LIFT, ELBOW, math.pi - LIFT - ELBOW, 0.0),
    force=TORQUE,
)
PARAMETERS: dict[str, Any] = {
    "workspace": [[0.1, 0.22], [-0.06, 0.06], [0.005, 0.12]],
    "home_height": 0.1,
    "object_scale_range": 0.5,
}
"""Parameters of environments for this arm: all of the workspace is in reach, cubes have 2.5 cm."""
TASKS: dict[str, dict[str, Any]] = {
    "BlockReaching": {},
    "BlockPicking": {"lift_height": 0.08},
    "BlockPushing": {},
    "BlockStacking": {"num_objects": 2},
}
"""Closed-loop tasks with the parameters that they need in addition."""


def success_rate(task: str, episodes: int) -> float:
    """Return the success rate of the expert on a closed-loop task."""
    env = gymnasium.make(f"BulletArm/CloseLoop{task}-v0", robot=SMALL, **PARAMETERS, **TASKS[task])
    solved = 0
    for seed in range(episodes):
        env.reset(seed=seed)
        is_over = False
        while not is_over:
            *_, terminated, truncated, info = env.step(env.unwrapped.expert_action())
            is_over = terminated or truncated
        solved += info["is_success"]
    env.close()
    return solved / episodes


if __name__ == "__main__":
    for name in TASKS:
        print(f"{name}: success rate {success_rate(name, 5):.2f}")
