"""Fingers of a linkage on slides of their own."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pybullet_data
import pytest

from bulletarm_gym.robots import on_slides, read_urdf
from bulletarm_gym.simulation.urdf import find_joint, frame_of

URDF = Path(pybullet_data.getDataPath(), "xarm", "xarm6_with_gripper.urdf")
BASE, FINGERS = "xarm_gripper_base_link", ("left_finger_joint", "right_finger_joint")
CLOSED = 0.8655


def _fitted() -> Element:
    return on_slides(read_urdf(URDF), BASE, FINGERS, CLOSED)


def test_the_linkage_is_left_out_and_the_arm_is_not() -> None:
    before, after = read_urdf(URDF), _fitted()
    gone = {"outer_knuckle", "inner_knuckle"}
    links = [str(link.get("name")) for link in before.findall("link")]
    kept = [link.get("name") for link in after.findall("link")]
    assert kept == [name for name in links if not any(name.endswith(part) for part in gone)]
    assert len(after.findall("joint")) == len(kept) - 1


def test_fingers_meet_at_0_and_open_straight_as_far_as_the_linkage() -> None:
    root = _fitted()
    left, right = (find_joint(root, name) for name in FINGERS)
    for joint, sign in ((left, 1.0), (right, -1.0)):
        # By the parallelogram: the knuckle (35.5, 42.0) mm long hangs at (35.0, 59.1) mm and turns by -angle.
        cosine, sine = np.cos(CLOSED), np.sin(CLOSED)
        y = 0.035 + 0.035465 * cosine - 0.042039 * sine
        z = 0.059098 + 0.035465 * sine + 0.042039 * cosine
        assert np.allclose(frame_of(joint).position, (0.0, sign * y, z), atol=1e-6)
        axis, limit = joint.find("axis"), joint.find("limit")
        assert axis is not None and limit is not None and joint.get("type") == "prismatic"
        assert np.allclose([float(part) for part in axis.get("xyz", "").split()], (0.0, sign, 0.0), atol=1e-6)
        assert float(limit.get("upper", "")) == pytest.approx(0.070465 - y, abs=1e-6)


@pytest.mark.parametrize(
    ("carrier", "fingers", "reason"),
    [
        (BASE, ("left_finger_joint", "thumb"), "no joint 'thumb'"),
        ("palm", FINGERS, "no link 'palm'"),
        (
            "left_inner_knuckle",
            FINGERS,
            "'left_finger_joint' is not attached to the link 'left_inner_knuckle'",
        ),
    ],
)
def test_what_is_missing_is_named(carrier: str, fingers: tuple[str, str], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        on_slides(read_urdf(URDF), carrier, fingers, CLOSED)
