"""The examples run, for some steps."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize(
    "command",
    [
        "train_ppo.py --steps 64 --rollout 16",
        "train_ppo.py --steps 64 --rollout 16 --equivariant",
        "train_crossq.py --steps 104",  # after 100 random steps
        "train_curriculum.py --steps 110",
        "her_reaching.py --steps 304",  # after 300 random steps
        "progress_reward.py --steps 104",  # after 100 random steps
    ],
)
def test_training_examples(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [script, *arguments, "--episodes", "1"])
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    assert re.search(r"^success rate [01]\.\d\d$", capsys.readouterr().out, re.MULTILINE)


def test_multi_task_example(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    budget = "--steps 6 --pretrain 2 --expert-episodes 3 --episodes 1"
    monkeypatch.setattr(sys, "argv", ["train_multi_task.py", *budget.split()])
    runpy.run_path(str(EXAMPLES / "train_multi_task.py"), run_name="__main__")
    rates = re.findall(
        r"^BulletArm/CloseLoop(\w+)-v0: success rate [01]\.\d\d$", capsys.readouterr().out, re.M
    )
    assert rates == ["BlockReaching", "BlockPicking", "BlockPushing"]


def test_asymmetric_example(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The actor's actions do not depend on the poses, the critic's values not on the images."""
    budget = "--steps 3 --expert-episodes 1 --episodes 1"
    monkeypatch.setattr(sys, "argv", ["train_asymmetric.py", *budget.split()])
    names = runpy.run_path(str(EXAMPLES / "train_asymmetric.py"), run_name="__main__")
    assert re.search(r"^success rate [01]\.\d\d$", capsys.readouterr().out, re.MULTILINE)
    model, observation = names["model"], names["env"].reset(seed=0)[0]
    for key, actor_differs in (("state", False), ("front", True), ("wrist", True)):
        changed = {**observation, key: observation[key] // 2}
        first, second = (model.policy.obs_to_tensor(entry)[0] for entry in (observation, changed))
        actions = [model.actor(entry, deterministic=True) for entry in (first, second)]
        values = [model.critic(entry, actions[0])[0] for entry in (first, second)]
        assert bool((actions[0] != actions[1]).any()) == actor_differs
        assert bool((values[0] != values[1]).any()) != actor_differs


def test_small_arm(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "small_arm.py"), run_name="__main__")
    assert re.findall(r"rate (\d\.\d\d)", capsys.readouterr().out) == ["1.00"] * 4


@pytest.mark.parametrize(
    "command",
    [
        "CloseLoopDoorOpening-v0 --gym-packages door",
        "CloseLoopBlockPicking-v0 --gym-packages step_surface --env-kwargs surface:step",
        "CloseLoopBlockPicking-v0 --gym-packages six_dof --env-kwargs control:six_dof",
    ],
)
def test_examples_of_components_pass_the_check(command: str) -> None:
    env_id, *flags = command.split()
    check = [sys.executable, "-m", "bulletarm_gym.check", f"BulletArm/{env_id}", "-n", "3", *flags]
    env = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    result = subprocess.run(check, cwd=EXAMPLES, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
