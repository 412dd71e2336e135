"""The check of an arm names what is wrong with it."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from bulletarm_gym.check_robot import check_robot, main
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.robots import KUKA, ROBOTS, ParallelJaw, RobotModel
from bulletarm_gym.robots.kuka import FLANGE, JAW
from bulletarm_gym.simulation.assets import load_model


def fitted(jaw: ParallelJaw, flange: Pose) -> RobotModel:
    """The KUKA with a jaw mounted on another flange."""
    arm = partial(load_model, "kuka_iiwa/model.urdf")
    tool = jaw.tool(flange).compose(Pose.planar(0.0, 0.0, 0.0, math.pi))
    return replace(KUKA, gripper=jaw, load=partial(jaw.fitted, arm, "lbr_iiwa_link_7", flange), tool=tool)


BROKEN = {
    "fingertips": replace(KUKA, tool=KUKA.tool.compose(Pose((0.0, 0.0, 0.03)))),
    "torques": replace(KUKA, force=30.0),
    "reach, close_loop": replace(KUKA, base=Pose((-0.3, 0.0, 0.1))),
    "environment": fitted(JAW, FLANGE.compose(euler_pose((0.0, 0.0, 0.0), (math.pi, 0.0, 0.0)))),
    "self-collision": fitted(replace(JAW, palm=(0.3, 0.3, 0.06)), FLANGE.compose(Pose((0.0, 0.0, -0.2)))),
}


@pytest.mark.parametrize("model", ROBOTS.values(), ids=lambda model: model.name)
def test_built_in_arms_pass(model: RobotModel) -> None:
    assert [finding for finding in check_robot(model) if finding.fails] == []


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_model_is_recognised(what: str) -> None:
    (finding,) = (finding for finding in check_robot(BROKEN[what]) if finding.what == what)
    assert finding.fails and finding.advice


def test_command_writes_an_image_with_the_tool_frame(tmp_path: Path) -> None:
    path = tmp_path / "arm.png"
    assert main(["kuka", "--image", str(path)]) == 0
    colours = {colour for _, colour in Image.open(path).getcolors(1 << 20)}
    assert {(255, 0, 0), (0, 128, 0), (0, 0, 255)} <= colours


def test_unknown_arm_is_one_line_and_exit_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ur10"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "ur10" in line and "kuka" in line
