"""The examples run, for some steps, and their modules are those of the guides."""

import ast
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("env_and_expert.py", r"'is_success': True.*\nequal after set_state\(\): True"),
        ("train.py 4", r"success rate [01]\.\d\d in 4 episodes"),
        ("own_task.py", r"passes Gymnasium's check_env\n5 of 5 attempts"),
        ("own_robot.py", r"(\w+: picked the block in \d+ steps\n){5}"),
        ("own_object_and_sensor.py", r"11\.4 cm long\n(.*\n)+step 0: (.*\n)+lifted something in \d+ steps"),
        ("tune_and_benchmark.py 4 1", r"reaching: 4 complete\n(.*\n)+found: (.*\n)+\s*benchmarks/found"),
        ("offline_imitation.py 4", r"4 episodes, \d+ steps\n(.*\n)*success rate [01]\.\d\d in 4 episodes"),
    ],
    ids=lambda value: value.split(".")[0] if ".py" in value else "",
)
def test_tutorials(command: str, output: str, tmp_path: Path) -> None:
    """In a process and an empty folder of their own, because they register components and write files."""
    script, *arguments = command.split()
    result = subprocess.run(
        [sys.executable, EXAMPLES / "tutorials" / script, *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(EXAMPLES.parent)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert re.search(output, result.stdout), result.stdout


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


@pytest.mark.parametrize("page", ["task", "robot", "object", "sensor"])
def test_tutorials_modules_are_those_of_the_guides(page: str) -> None:
    guide = (EXAMPLES.parent / "docs" / "guides" / f"{page}.md").read_text(encoding="utf-8")
    code = (EXAMPLES / "tutorials" / f"my_{page}s.py").read_text(encoding="utf-8").partition('"""\n\n')[2]
    shown = guide.partition(f"# my_{page}s.py\n")[2].partition("```")[0]
    assert _without_types(code) == _without_types(shown)


def _without_types(code: str) -> list[str]:
    """Return the statements without annotations and imports."""
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
    statements = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
    return [ast.unparse(node) for node in statements]
