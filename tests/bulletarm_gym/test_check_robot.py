"""The check of an arm names what is wrong with it."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from PIL import Image
from small_arm import PARAMETERS, SMALL

from bulletarm_gym.check.__main__ import main
from bulletarm_gym.check.robot import check_robot
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.robots import KUKA, ROBOTS, ParallelJaw, RobotModel
from bulletarm_gym.robots.kuka import FLANGE, JAW
from bulletarm_gym.robots.reach import grid, largest_workspace, study_reach
from bulletarm_gym.simulation.urdf import load_model


def fitted(jaw: ParallelJaw, flange: Pose) -> RobotModel:
    """The KUKA with a jaw mounted on another flange."""
    arm = partial(load_model, "kuka_iiwa/model.urdf")
    tool = jaw.tool(flange).compose(Pose.planar(0.0, 0.0, 0.0, math.pi))
    return replace(KUKA, gripper=jaw, load=partial(jaw.fitted, arm, "lbr_iiwa_link_7", flange), tool=tool)


def turned(model: RobotModel, angle: float) -> RobotModel:
    """An arm whose tool frame is rotated about the approach."""
    return replace(model, tool=model.tool.compose(Pose.planar(0.0, 0.0, 0.0, angle)))


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


WORKSPACE = PARAMETERS["workspace"]
BROKEN_SMALL = {
    "model": replace(SMALL, joints=(*SMALL.joints[:-1], "tilt_joint")),
    "reach, workspace": replace(SMALL, base=Pose((-0.2, 0.0, 0.05))),
    "fingertips": replace(SMALL, tool=SMALL.tool.compose(Pose((0.0, 0.0, 0.01)))),
    "fingers": turned(SMALL, 0.3),
    "torques": replace(SMALL, force=1.0),
    "tracking, fast, 0.2 kg": replace(SMALL, gripper=replace(SMALL.gripper, force=0.2)),
}


def test_a_small_arm_passes_in_its_workspace() -> None:
    findings = list(check_robot(SMALL, WORKSPACE))
    assert [finding for finding in findings if finding.fails] == []
    assert len({finding.what for finding in findings}) == len(findings) == 12
    assert [finding for finding in check_robot(SMALL) if finding.fails]


@pytest.mark.parametrize("what", BROKEN_SMALL)
def test_a_broken_small_arm_is_recognised(what: str) -> None:
    (finding,) = (one for one in check_robot(BROKEN_SMALL[what], WORKSPACE) if one.what == what)
    assert finding.fails and finding.advice


def test_the_largest_workspace_is_in_reach() -> None:
    for model in (*ROBOTS.values(), SMALL):
        limits = largest_workspace(model)
        (x0, x1), (y0, y1), (low, high) = limits
        assert x1 - x0 >= 0.1 and y1 - y0 >= 0.1
        assert study_reach(model, grid(limits, (low, (low + high) / 2.0, high), 3)).share == 1.0


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_model_is_recognised(what: str) -> None:
    (finding,) = (finding for finding in check_robot(BROKEN[what]) if finding.what == what)
    assert finding.fails and finding.advice


def test_command_writes_an_image_with_the_tool_frame(tmp_path: Path) -> None:
    path = tmp_path / "arm.png"
    assert main(["--robot", "kuka", "--image", str(path)]) == 0
    colours = {colour for _, colour in Image.open(path).getcolors(1 << 20)}
    assert {(255, 0, 0), (0, 128, 0), (0, 0, 255)} <= colours


def test_command_checks_a_workspace(capsys: pytest.CaptureFixture[str]) -> None:
    limits = [str(limit) for side in WORKSPACE for limit in side]
    assert main(["--robot", "small_arm:SMALL", "--workspace", *limits]) == 0
    assert main(["--robot", "small_arm:SMALL"]) == 2
    assert "largest workspace" in capsys.readouterr().out


def test_unknown_arm_is_one_line_and_exit_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--robot", "ur10"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "ur10" in line and "kuka" in line


@pytest.mark.parametrize(
    ("image", "must"),
    [("arm.xyz", "a file name with the extension of an image"), ("missing/arm.png", "in an existing folder")],
)
def test_an_image_that_cannot_be_written_is_refused_before_the_check(
    image: str, must: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--robot", "kuka", "--image", str(tmp_path / image)])
    assert stop.value.code == 2
    assert f"--image must be {must}, got" in capsys.readouterr().err
