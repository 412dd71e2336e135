"""``python -m bulletarm_gym.play`` converts keys to actions and records demonstrations."""

import io
import itertools

import numpy as np
import pytest
from PIL import Image
from rollouts import PICKING

from bulletarm_gym import demonstrations
from bulletarm_gym.play.__main__ import Teleoperation, main

STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TWO = ["--env-kwargs", "num_objects:2", "obs_size:48"]


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Play with letters in an empty working directory, without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    def run(letters, *arguments):
        monkeypatch.setattr("sys.stdin", io.StringIO(letters))
        return main(arguments)

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


def test_invalid_argument_is_rejected(play, tmp_path, capsys):
    for arguments, word in (
        (["CartPole-v1"], "CartPole-v1"),
        (["BulletArm/CloseLoopBlockPiking-v0"], "CloseLoopBlockPicking"),
        ([PICKING, "--env-kwargs", "obs_size"], "KEY:VALUE"),
        ([PICKING, "--env-kwargs", "robot:octopus"], "octopus"),
        ([PICKING, "--gym-packages", "missing_module"], "missing_module"),
        ([PICKING, "-n", "0"], "--episodes"),
        ([PICKING, "--seed", "-1"], "--seed"),
    ):
        with pytest.raises(SystemExit, match="2"):
            play("", *arguments)
        assert word in capsys.readouterr().err.splitlines()[-1]
        assert not list(tmp_path.iterdir())


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
