"""The programs ``python -m bulletarm_gym.check`` and ``python -m bulletarm_gym.play``."""

import io
import itertools
import math
import sys
import textwrap
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image
from rollouts import PICKING, REACHING, STACKING
from small_arm import FLANGE, JAW, PARAMETERS, SMALL, bare_arm

from bulletarm_gym import demonstrations
from bulletarm_gym.check import environments
from bulletarm_gym.check.__main__ import main
from bulletarm_gym.check.robot import check_robot
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.play.__main__ import Teleoperation
from bulletarm_gym.play.__main__ import main as main_of_play
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.robots.editing import LIGHT, box
from bulletarm_gym.simulation.urdf import find


def test_check_of_the_machine_needs_no_learners(capsys, monkeypatch):
    for name in ("torch", "stable_baselines3", "rl_zoo3", "zoo_configs", "sb3_extensions"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["--seconds", "0.1"]) == 0
    out = capsys.readouterr().out
    subjects = [line.split(":")[0].split()[-1] for line in out.splitlines() if "->" not in line]
    names = [env_id.rpartition("/")[2] for env_id in environments.MAX_RATIO]
    assert subjects == ["versions", "processor", "threads", "display", *ROBOTS, "cache", *names]
    assert out.count("picked a block in") == len(ROBOTS)


def test_missing_robot_and_slow_steps_are_reported():
    finding = environments.robot("octopus")
    assert finding.fails and finding.advice and "octopus" in finding.value
    finding = environments.speed(environments.CLOSE_LOOP, seconds=0.0, step_us=1e-3)
    assert "steps/s" in finding.value and finding.advice


TASKS = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockPicking, BlockReaching

    class NoPlan(BlockReaching):
        def plan(self, scene, rng):
            raise RuntimeError("no plan")
            yield

    def changed(name, change):
        class Changed(BlockPicking):
            def arrange(self, scene, rng):
                super().arrange(scene, rng)
                change(scene["cube"], scene.world.client)

        Changed.__qualname__ = Changed.__name__ = name
        globals()[name] = Changed
        bulletarm_gym.register_task(name, Changed)

    bulletarm_gym.register_task("NoPlan", NoPlan)
    changed("Properties", lambda item, _: item.set_properties(mass=0.08, friction=0.8))
    changed("Mass", lambda item, client: client.changeDynamics(item.body.id, -1, mass=0.08))
    changed("Friction", lambda item, client: client.changeDynamics(item.body.id, -1, lateralFriction=0.1))
    changed("Gravity", lambda _, client: client.setGravity(0.0, 0.0, -5.0))
"""


def test_environment_passes_unless_the_expert_is_below_the_minimum_success_rate(tmp_path, capsys):
    image = tmp_path / "reaching.png"
    small = ["--env-kwargs", 'observation:["point_cloud"]', "obs_size:16"]
    assert main([REACHING, "-n", "2", *small, "--image", str(image)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("passed") == 4 and "success in 2 of 2 episodes" in printed
    assert len(Image.open(image).getcolors(1 << 20)) > 100
    assert main([REACHING, "-n", "1", "--env-kwargs", "max_steps:2", "obs_size:16"]) == 2
    out, err = capsys.readouterr()
    assert out.count("FAILED") == 1 and "0 of 1 episodes" in out and REACHING in err


@pytest.mark.usefixtures("own_registrations")
def test_faults_of_a_users_task_are_found(tmp_path, monkeypatch, capsys):
    """An error is reported with its place. Changes that are missing in the state make steps differ."""
    (tmp_path / "my_checked_tasks.py").write_text(textwrap.dedent(TASKS))
    monkeypatch.syspath_prepend(str(tmp_path))
    names = ("NoPlan", "Properties", "Mass", "Friction", "Gravity")
    ids = [f"BulletArm/CloseLoop{name}-v0" for name in names]
    own = ["--gym-packages", "json,my_checked_tasks", "-n", "1", "--env-kwargs", "obs_size:16"]
    assert main([*ids, *own]) == 2
    out, err = capsys.readouterr()
    reports = dict(zip(names, out.split("BulletArm/CloseLoop")[1:], strict=True))
    assert reports["NoPlan"].count(f"no plan ({tmp_path / 'my_checked_tasks.py'}, line ") == 3
    assert "success in 1 of 1" in reports["Properties"] and "FAILED" not in reports["Properties"]
    for name in names[2:]:
        assert reports[name].count("FAILED") == 1 and "equal states: the pose of 'cube" in reports[name]
    assert err == f"failed: {', '.join([ids[0], *ids[2:]])}\n"


WORKSPACE = PARAMETERS["workspace"]


def flipped():
    """Return the small arm with its jaw rotated, so that the fingers point back to the arm."""
    flange = FLANGE.compose(euler_pose((0.0, 0.0, 0.0), (math.pi, 0.0, 0.0)))
    return replace(SMALL, load=partial(JAW.fitted, bare_arm, "roll", flange), tool=JAW.tool(flange))


def bulky():
    """Return the URDF of the small arm with a box on the gripper that reaches the upper arm."""
    root = SMALL.load()
    box((0.4, 0.4, 0.2), (0.0, 0.0, -0.1), LIGHT).add_to(find(root, "link", "roll"))
    return root


BROKEN = {
    "model": replace(SMALL, joints=(*SMALL.joints[:-1], "tilt_joint")),
    "reach, workspace": replace(SMALL, base=Pose((-0.2, 0.0, 0.05))),
    "environment": flipped(),
    "self-collision": replace(SMALL, load=bulky),
    "fingertips": replace(SMALL, tool=SMALL.tool.compose(Pose((0.0, 0.0, 0.01)))),
    "fingers": replace(SMALL, tool=SMALL.tool.compose(Pose.planar(0.0, 0.0, 0.0, 0.3))),
    "torques": replace(SMALL, force=1.0),
    "tracking, fast, 0.2 kg": replace(SMALL, gripper=replace(SMALL.gripper, force=0.2)),
}


@pytest.mark.parametrize("model", ROBOTS.values(), ids=lambda model: model.name)
def test_built_in_arm_passes(model):
    assert [finding for finding in check_robot(model) if finding.fails] == []


def test_small_arm_passes_in_its_workspace(tmp_path, capsys):
    """The image shows the axes of the tool frame."""
    limits, image = [str(limit) for side in WORKSPACE for limit in side], tmp_path / "arm.png"
    assert main(["--robot", "small_arm:SMALL", "--workspace", *limits, "--image", str(image)]) == 0
    assert len(capsys.readouterr().out.splitlines()) >= 12
    colours = {colour for _, colour in Image.open(image).getcolors(1 << 20)}
    assert {(255, 0, 0), (0, 128, 0), (0, 0, 255)} <= colours
    assert main(["--robot", "small_arm:SMALL"]) == 2
    assert "largest workspace" in capsys.readouterr().out


@pytest.mark.parametrize(("what", "model"), BROKEN.items())
def test_broken_arm_is_recognised(what, model):
    (finding,) = (finding for finding in check_robot(model, WORKSPACE) if finding.what == what)
    assert finding.fails and finding.advice


TWO = ["--env-kwargs", "num_objects:2", "obs_size:48"]


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Play with letters in an empty working directory, without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    def run(letters, *arguments):
        monkeypatch.setattr("sys.stdin", io.StringIO(letters))
        return main_of_play(arguments)

    return run


def test_letters_move_the_gripper_and_images_are_written(play, tmp_path):
    assert play("w d\ng?n.q", PICKING) == 0
    images = sorted(tmp_path.rglob("*.png"))
    first = [f"play/episode_01/{number:03d}.png" for number in range(4)]
    assert [str(path.relative_to(tmp_path)) for path in images] == [*first, "play/episode_02/000.png"]
    arrays = [np.asarray(Image.open(path)) for path in images]
    assert all((one != other).any() for one, other in itertools.pairwise(arrays))


def test_episodes_and_observations_without_a_heightmap(play, tmp_path):
    arguments = ["-n", "2", "--folder", "images", "--env-kwargs", 'observation:["state"]']
    assert play("wnnnn", PICKING, *arguments) == 0
    assert len(list((tmp_path / "images").rglob("*.png"))) == 3


def test_successful_episodes_are_recorded(play, capsys):
    assert play("xxn", STACKING, "--record", "own.h5", *TWO) == 0
    assert play("wxx", STACKING, "--record", "own.h5", "--seed", "5", *TWO) == 0
    found = demonstrations.load("own.h5")
    assert [episode.seed for episode in found] == [0, 5] and found.about["planner"] == "human"
    assert found[0].observations["heightmap"].shape == (3, 1, 48, 48)
    with pytest.raises(SystemExit, match="2"):
        play("", PICKING, "--record", "own.h5")
    assert "env_id" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("program", "line", "word"),
    [
        (main, f"{REACHING} --env-kwargs obs_size:-1", "obs_size"),
        (main, f"{REACHING} --robot kuka", "--robot"),
        (main, f"{REACHING} --seed -1", "--seed"),
        (main, "--image arm.png", "--image"),
        (main, "--robot kuka --env-kwargs obs_size:64", "--env-kwargs"),
        (main, "-n 3", "--episodes"),
        (main, f"{REACHING} --seconds 5", "--seconds"),
        (main, "--robot kuka --image missing/arm.png", "missing/arm.png"),
        (main_of_play, "CartPole-v1", "CartPole-v1"),
        (main_of_play, "BulletArm/CloseLoopBlockPiking-v0", "CloseLoopBlockPicking"),
        (main_of_play, f"{PICKING} --env-kwargs obs_size", "KEY:VALUE"),
        (main_of_play, f"{PICKING} --env-kwargs robot:octopus", "octopus"),
        (main_of_play, f"{PICKING} --gym-packages missing_module", "missing_module"),
        (main_of_play, f"{PICKING} -n 0", "--episodes"),
    ],
)
def test_invalid_argument_is_rejected_first(program, line, word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        program(line.split())
    out, err = capsys.readouterr()
    assert not out and word in err.splitlines()[-1] and not list(tmp_path.iterdir())


def test_open_loop_keys_move_a_target(make):
    env = make("BulletArm/OpenLoopRampBlockStacking-v0", num_objects=2, seed=0)
    keys = Teleoperation(env)
    assert [keys.press(key) for key in "ssdi"] == [None] * 4
    target = [0.1, 0.05, -0.8, 0, 0.25, 0]
    np.testing.assert_allclose(keys.press("g"), [-1, *target], atol=1e-6)
    assert keys.pixel(100) == (55, 52)
    env.step(env.expert_action())
    np.testing.assert_allclose(keys.press("g"), [1, *target], atol=1e-6)
    for _ in range(50):
        keys.press("w")
    assert keys.pixel(100)[0] == 0
