"""``bulletarm-zoo play`` and ``gallery``: people look and try."""

from __future__ import annotations

import io
import itertools
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from zoo_configs.cli import main
from zoo_configs.environments import demonstrations, make_env, register_environments
from zoo_configs.playing import HELP, MOVES, CloseLoopPilot, OpenLoopPilot, make_pilot

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"


@pytest.fixture
def type_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty working folder on a machine without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    register_environments()
    return tmp_path


def _play(monkeypatch: pytest.MonkeyPatch, letters: str, *arguments: str) -> int:
    monkeypatch.setattr("sys.stdin", io.StringIO(letters))
    return main(["play", *arguments])


def test_letters_move_and_pictures_are_saved(
    type_in: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _play(monkeypatch, "w d\ng?n.q", PICKING) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{PICKING}\n{HELP}") and "'?' is no key here" in said
    pictures = [str(path.relative_to(type_in)) for path in sorted(type_in.rglob("*.png"))]
    one = [f"play/episode_01/{number:03d}.png" for number in range(4)]
    assert pictures == [*one, "play/episode_02/000.png"]
    images = [iio.imread(path) for path in pictures]
    assert all((first != second).any() for first, second in itertools.pairwise(images))


def test_successful_episodes_are_recorded(
    type_in: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [STACKING, "--record", "own.h5", "--env-kwargs", "num_objects:2", "obs_size:48"]
    assert _play(monkeypatch, "xxn", *arguments) == 0
    assert _play(monkeypatch, "wxx", *arguments, "--seed", "5") == 0
    assert capsys.readouterr().out.endswith("2 episodes recorded\nWritten:\n  own.h5\n")
    found = demonstrations().load("own.h5")
    assert [episode.seed for episode in found] == [0, 5] and found.about["planner"] == "human"
    assert found[0].observations["heightmap"].shape == (3, 1, 48, 48)


def test_a_file_of_another_task_is_refused(
    type_in: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _play(monkeypatch, "xx", STACKING, "--record", "own.h5", "--env-kwargs", "num_objects:2")
    assert _play(monkeypatch, "", PICKING, "--record", "own.h5") == 2
    assert "--record: path must be a file of demonstrations with env_id=" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["CartPole-v1"], "none of our environments"),
        ([PICKING, "--stride", "2"], "greater than 0 and at most 1"),
        ([PICKING, "--record", "own.txt"], "must end in .h5"),
    ],
)
def test_what_cannot_be_played(
    type_in: Path, arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["play", *arguments]) == 2
    assert reason in capsys.readouterr().err
    assert not list(type_in.iterdir())


def test_keys_of_close_loop_move_the_gripper() -> None:
    env = make_env(PICKING, {})
    seen, _ = env.reset(seed=0)
    pilot = make_pilot(env, 0.4)
    assert isinstance(pilot, CloseLoopPilot)
    np.testing.assert_allclose(pilot.press("w", seen), [1, -0.4, 0, 0, 0])
    np.testing.assert_allclose(pilot.press("g", seen), [-1, 0, 0, 0, 0])
    np.testing.assert_allclose(pilot.press("q", seen), [-1, 0, 0, 0, 0.4])
    pilot.follow(np.array([1, 0, 0, 0, 0], np.float32))
    np.testing.assert_allclose(pilot.press("r", seen), [1, 0, 0, 0.4, 0])
    assert not pilot.takes("i") and not pilot.takes("?")
    env.close()


def test_keys_of_open_loop_move_a_target() -> None:
    env = make_env("BulletArm/OpenLoopRampBlockStacking-v0", {"num_objects": 2})
    seen, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    assert isinstance(pilot, OpenLoopPilot) and all(pilot.takes(key) for key in MOVES)
    for key in "ssdi":
        assert pilot.press(key, seen) is None
    target = [-1, 0.1, 0.05, -0.8, 0, 0.25, 0]
    np.testing.assert_allclose(pilot.press("g", seen), target, atol=1e-6)
    holding = {**seen, "holding": np.ones(1, np.float32)}
    np.testing.assert_allclose(pilot.press("g", holding), [1, *target[1:]], atol=1e-6)
    assert pilot.place(100) == (55, 52)
    for _ in range(50):
        pilot.press("w", seen)
    assert pilot.place(100)[0] == 0
    env.close()


def test_gallery_draws_tasks_and_a_page(type_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kwargs = ["--pixels", "64", "--env-kwargs", "obs_size:32"]
    assert main(["gallery", PICKING, STACKING, *kwargs]) == 0
    names = ["CloseLoopBlockPicking-v0.png", "OpenLoopBlockStacking-v0.png", "index.html"]
    assert sorted(path.name for path in Path("gallery").iterdir()) == names
    picture = iio.imread(Path("gallery") / names[0])
    assert picture.shape == (64, 132, 3) and (picture[:, :64] != picture[:, 68:]).any()
    page = Path("gallery/index.html").read_text(encoding="utf-8")
    assert all(f'src="{name}"' in page for name in names[:2]) and "6 steps" in page
    assert capsys.readouterr().out.endswith("  gallery/index.html\n")


def test_gallery_draws_heightmaps(type_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kwargs = ["--pixels", "32", "--env-kwargs", "obs_size:32"]
    assert main(["gallery", STACKING, *kwargs, "--heightmap", "--format", "webp"]) == 0
    names = ["OpenLoopBlockStacking-v0-heightmap.webp", "OpenLoopBlockStacking-v0.webp", "index.html"]
    assert sorted(path.name for path in Path("gallery").iterdir()) == names
    before, after = np.split(
        iio.imread(Path("gallery") / names[0])[:, [*range(32), *range(36, 68)]], 2, axis=1
    )
    # Colours span both: the stack is brighter than a cube.
    assert after.astype(int).sum(axis=2).max() > before.astype(int).sum(axis=2).max() + 100
    assert main(["gallery", PICKING, "--heightmap", "--env-kwargs", "observation:'state'"]) == 2
    assert "--heightmap: BulletArm/CloseLoopBlockPicking-v0 shows " in capsys.readouterr().err


def test_gallery_says_where_an_expert_fails(type_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gallery", PICKING, "--env-kwargs", "max_steps:1"]) == 2
    assert "solved none of 10 episodes" in capsys.readouterr().err
    assert not list(type_in.iterdir())
