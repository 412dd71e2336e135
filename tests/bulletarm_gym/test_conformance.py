"""``python -m bulletarm_gym.check ID`` checks environments and their experts."""

import textwrap
from pathlib import Path

import pytest
from PIL import Image

from bulletarm_gym.check import conformance
from bulletarm_gym.check.__main__ import main

REACHING = "BulletArm/CloseLoopBlockReaching-v0"
TASK = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockReaching

    class SlowReaching(BlockReaching):
        def plan(self, scene, rng):
            raise RuntimeError("no plan")
            yield

    bulletarm_gym.register_task("SlowReaching", SlowReaching)
"""
CHANGED = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockPicking

    class {name}(BlockPicking):
        def arrange(self, scene, rng):
            super().arrange(scene, rng)
            item = scene["cube"]
            {change}

    bulletarm_gym.register_task("{name}", {name})
"""


def test_built_in_environment_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = tmp_path / "reaching.png"
    assert main([REACHING, "-n", "2", "--env-kwargs", "obs_size:32", "--image", str(image)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("passed") == 4 and "success in 2 of 2 episodes" in printed
    assert len(Image.open(image).getcolors(1 << 20)) > 100


def test_expert_below_the_minimum_success_rate_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([REACHING, "-n", "1", "--env-kwargs", "max_steps:2"]) == 2
    out, err = capsys.readouterr()
    assert out.count("FAILED") == 1 and "success in 0 of 1 episodes" in out and REACHING in err


@pytest.mark.parametrize("observation", ["state", "point_cloud"])
def test_observations_without_limits_pass(observation: str) -> None:
    assert main([REACHING, "-n", "1", "--env-kwargs", f'observation:["{observation}"]']) == 0


def test_stable_baselines3_is_not_required(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(conformance, "SB3_CHECKER", "missing_library.env_checker")
    assert main([REACHING, "-n", "1"]) == 0
    assert "Stable-Baselines3 is not installed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["CartPole-v1"], "ID must be an environment of this package"),
        ([REACHING, "--env-kwargs", "obs_size:-1"], "obs_size"),
        ([REACHING, "--robot", "kuka"], "--robot must be passed without ids"),
        (["--image", "arm.png"], "--robot or one id must be passed"),
    ],
)
def test_invalid_argument_is_rejected_before_the_checks(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    out, err = capsys.readouterr()
    assert not out and reason in err.splitlines()[-1]


@pytest.mark.usefixtures("own_registrations")
def test_error_of_a_users_task_is_reported_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_slow_tasks.py").write_text(textwrap.dedent(TASK))
    monkeypatch.syspath_prepend(str(tmp_path))
    slow = "BulletArm/CloseLoopSlowReaching-v0"
    assert main([slow, REACHING, "--gym-packages", "my_slow_tasks", "-n", "1"]) == 2
    out, err = capsys.readouterr()
    assert out.count(f"RuntimeError: no plan ({tmp_path / 'my_slow_tasks.py'}, line ") == 3
    assert "success in 1 of 1 episodes" in out and err == f"failed: {slow}\n"


@pytest.mark.usefixtures("own_registrations")
@pytest.mark.parametrize(
    ("change", "passes"),
    [
        ("item.set_properties(mass=0.08, friction=0.8, colour=(0.0, 1.0, 0.0, 1.0))", True),
        ("scene.world.client.changeDynamics(item.body.id, -1, mass=0.08)", False),
        ("scene.world.client.changeDynamics(item.body.id, -1, lateralFriction=0.1)", False),
        ("scene.world.client.setGravity(0.0, 0.0, -5.0)", False),
    ],
    ids=["properties", "mass", "friction", "gravity"],
)
def test_change_that_is_missing_in_the_state_is_found(
    change: str,
    passes: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = f"Changed{len(change)}"
    (tmp_path / f"my_{name}.py").write_text(textwrap.dedent(CHANGED.format(name=name, change=change)))
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = ["--gym-packages", f"my_{name}", "-n", "1"]
    assert main([f"BulletArm/CloseLoop{name}-v0", *arguments]) == (0 if passes else 2)
    printed = capsys.readouterr().out
    assert printed.count("FAILED") == (not passes)
    if not passes:
        assert "FAILED  equal steps from equal states: the pose of 'cube 1' differs" in printed
