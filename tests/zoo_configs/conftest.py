"""A quick environment with the interface of the close-loop ids: a finger that must come near a block."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sweeps
import yaml
from gymnasium import spaces

from zoo_configs.cli import main

TOY_ID = "BulletArm/CloseLoopToy-v0"
STEP = 0.05  # m an action of 1 moves
REACH = 0.06  # m at which the block is reached
MAX_STEPS = 6


RUN_NAME = "BulletArm-CloseLoopToy-v0_1"
# A run of two seconds; -params stands last, so that more of them can follow.
TINY = (
    *("-n", "12", "--eval-freq", "6", "--eval-episodes", "2", "--save-freq", "6"),
    *("--seed", "0", "--device", "cpu", "--num-threads", "1", "--no-progress"),
    *("--env-kwargs", "obs_size:48"),
    *("-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4", "buffer_size:100"),
)

Train = Callable[..., int]
Refuse = Callable[..., str]
Bench = Callable[..., int]


class ToyEnv(gym.Env[dict[str, Any], np.ndarray]):
    """The block lies at ``self.offset`` from the finger; the heightmap, 0.45 m wide, shows it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    made: list[ToyEnv] = []  # noqa: RUF012

    def __init__(
        self, obs_size: int = 128, action_sequence: str = "pxyzr", render_mode: str | None = None
    ) -> None:
        if obs_size < 48:
            raise ValueError(f"obs_size must be at least 48, got {obs_size}")
        self.obs_size, self.action_sequence, self.render_mode = obs_size, action_sequence, render_mode
        image = spaces.Box(0, 0.4, (1, obs_size, obs_size), np.float32)
        self.observation_space = spaces.Dict(
            {"heightmap": image, "holding": spaces.Box(0, 1, (1,), np.float32)}
        )
        self.action_space = spaces.Box(-1, 1, (len(action_sequence),), np.float32)
        self.seeds: list[int | None] = []
        ToyEnv.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.offset = self.np_random.uniform(-0.15, 0.15, 2)
        self.steps = 0
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> Any:
        x = self.action_sequence.index("x")
        self.offset = self.offset - STEP * np.asarray(action)[x : x + 2]
        self.steps += 1
        success = self._info()["is_success"]
        return self._observe(), float(success), success, self.steps >= MAX_STEPS, self._info()

    def expert_action(self) -> np.ndarray:
        action = np.zeros(len(self.action_sequence), np.float32)
        x = self.action_sequence.index("x")
        action[x : x + 2] = np.clip(self.offset / STEP, -1, 1)
        return action

    def get_state(self) -> Any:
        return self.offset, self.steps, self.np_random.bit_generator.state

    def set_state(self, state: Any) -> None:
        self.offset, self.steps, self.np_random.bit_generator.state = state

    def render(self) -> Any:
        return np.full((60, 80, 3), 90, np.uint8)

    def _info(self) -> dict[str, Any]:
        return {"is_success": bool(np.linalg.norm(self.offset) < REACH)}

    def _observe(self) -> dict[str, Any]:
        image = np.full((1, self.obs_size, self.obs_size), 0.2, np.float32)
        row, column = ((self.offset / 0.45 + 0.5) * self.obs_size).astype(int).clip(2, self.obs_size - 3)
        image[0, row - 2 : row + 3, column - 2 : column + 3] = 0.1
        return {"heightmap": image, "holding": np.zeros(1, np.float32)}


@pytest.fixture(scope="session")
def toy_id() -> Iterator[str]:
    """An id that the close-loop baselines serve."""
    gym.register(TOY_ID, entry_point=ToyEnv)
    yield TOY_ID
    del gym.registry[TOY_ID]


@pytest.fixture
def toy_envs() -> list[ToyEnv]:
    """Environments made since the test began, in order."""
    ToyEnv.made.clear()
    return ToyEnv.made


@pytest.fixture(scope="session")
def train_tiny(toy_id: str) -> Train:
    """Trains Equivariant SACfD for a few steps: ``train_tiny(folder, *more)`` returns the exit code."""

    def train(folder: Path, *more: str) -> int:
        names = ["--baseline", "equi_sacfd", "--preset", "cpu", "--env", toy_id, "-f", str(folder)]
        return main(["train", *names, *TINY, *more])

    return train


@pytest.fixture(scope="session")
def trained(train_tiny: Train, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log folder with one run, not to be changed."""
    folder = tmp_path_factory.mktemp("logs")
    assert train_tiny(folder, "n_envs:1", "--preset", "quick") == 0
    return folder


@pytest.fixture(scope="session")
def run_folder(trained: Path) -> Path:
    """That run, not to be changed."""
    return trained / "sacfd" / RUN_NAME


@pytest.fixture
def refuse(
    toy_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Refuse:
    """
    Runs a command line that cannot be followed, with ``TOY`` for the toy's id, in an empty folder: checks
    exit code and that nothing is left behind, and returns the one line that it says.
    """

    def run(*words: str) -> str:
        monkeypatch.chdir(tmp_path)
        before = set(tmp_path.rglob("*"))
        capsys.readouterr()
        assert main([toy_id if word == "TOY" else word for word in words]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith(f"bulletarm-zoo {words[0]}: error: ")
        assert set(tmp_path.rglob("*")) == before
        return line

    return run


@pytest.fixture
def toys(toy_id: str) -> Iterator[None]:
    """Toys of ``--gym-packages toy_tasks`` are known during a test alone."""
    yield
    for env_id in list(gym.registry):
        if env_id.startswith("BulletArm/CloseLoopToy") and env_id != toy_id:
            del gym.registry[env_id]
    sys.modules.pop("toy_tasks", None)


@pytest.fixture
def bench(toys: None, tmp_path: Path) -> Bench:
    """Runs a benchmark like TINY but for some keys: ``bench(*flags, key=value)`` returns the exit code."""

    def run(*flags: str, **keys: Any) -> int:
        (tmp_path / "tiny.yml").write_text(yaml.safe_dump({**sweeps.TINY, **keys}))
        where = ["-f", str(tmp_path / "out"), *sweeps.FLAGS]
        return main(["benchmark", str(tmp_path / "tiny.yml"), *where, *flags])

    return run
