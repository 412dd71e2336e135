"""The examples that train run as their users run them, for some steps."""

import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from sb3_contrib import CrossQ
from stable_baselines3 import PPO

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize(
    ("algorithm", "command", "updates"),
    [
        (PPO, "train_ppo.py --steps 64 --rollout 16", 1),
        (PPO, "train_ppo.py --steps 64 --rollout 16 --equivariant", 1),
        (CrossQ, "train_crossq.py --steps 104", 3),  # the first 100 steps are taken at random
    ],
)
def test_training_examples(
    algorithm: Any,
    command: str,
    updates: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trained = []
    train = algorithm.train

    def count(model: Any, *args: Any, **kwargs: Any) -> None:
        trained.append(model)
        train(model, *args, **kwargs)

    monkeypatch.setattr(algorithm, "train", count)
    script, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [script, *arguments, "--episodes", "1"])
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    assert len(trained) >= updates
    assert re.search(r"^success rate [01]\.\d\d$", capsys.readouterr().out, re.MULTILINE)
