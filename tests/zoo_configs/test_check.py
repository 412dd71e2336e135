"""``bulletarm-zoo check`` on one of our environments and on a user's."""

import textwrap
from pathlib import Path

import pytest

from zoo_configs.cli import main

TASK = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockReaching

    class SlowReaching(BlockReaching):
        def plan(self, scene, rng):
            raise RuntimeError("no plan")
            yield

    bulletarm_gym.register_task("SlowReaching", SlowReaching)
"""


def test_environment_of_ours_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["-n", "2", "-f", str(tmp_path), "--env-kwargs", "obs_size:32"]
    assert main(["check", "BulletArm/CloseLoopBlockReaching-v0", *arguments]) == 0
    printed = capsys.readouterr().out
    assert printed.count("passed") == 4
    assert "success_rate=1.000 episodes=2 mean_length=3.00" in printed
    assert (tmp_path / "CloseLoopBlockReaching-v0.png").stat().st_size > 10_000


def test_the_expert_can_act_on_a_grid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Four cubes of 3 cm seldom stand on each other with pixels of 2.5 cm."""
    stacking, arguments = "BulletArm/OpenLoopBlockStacking-v0", ["-n", "2", "-f", str(tmp_path), "--snap"]
    fine = ["--env-kwargs", "obs_size:64"]
    assert main(["check", stacking, *arguments, *fine]) == 0
    assert "success_rate=1.000" in capsys.readouterr().out
    coarse = ["--env-kwargs", "obs_size:16", "in_hand_size:12"]
    assert main(["check", stacking, *arguments, *coarse]) == 2
    assert "success_rate=1.000" not in capsys.readouterr().out


def test_close_loop_has_no_grid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "BulletArm/CloseLoopBlockReaching-v0", "--snap"]) == 2
    assert "only open-loop actions are places on a grid" in capsys.readouterr().err


def test_least_success_rate_decides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["-n", "1", "-f", str(tmp_path), "--env-kwargs", "max_steps:1"]
    assert main(["check", "BulletArm/CloseLoopBlockReaching-v0", *arguments]) == 2
    assert "failed: BulletArm/CloseLoopBlockReaching-v0" in capsys.readouterr().err


@pytest.mark.parametrize("observation", ["state", "point_cloud"])
def test_observations_without_bounds_pass(
    observation: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["-n", "1", "-f", str(tmp_path), "--env-kwargs", f"observation:['{observation}']"]
    assert main(["check", "BulletArm/CloseLoopBlockReaching-v0", *arguments]) == 0
    assert "FAILED" not in capsys.readouterr().out


@pytest.mark.usefixtures("own_registrations")
def test_fault_of_a_users_task_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_slow_tasks.py").write_text(textwrap.dedent(TASK))
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = ["--gym-packages", "my_slow_tasks", "-n", "1", "-f", str(tmp_path)]
    ids = ["BulletArm/CloseLoopSlowReaching-v0", "BulletArm/CloseLoopBlockReaching-v0"]
    assert main(["check", *ids, *arguments]) == 2
    out, err = capsys.readouterr()
    place = f"RuntimeError: no plan ({tmp_path / 'my_slow_tasks.py'}, line "
    assert f"equal episodes from equal seeds: FAILED, {place}" in out and f"expert: FAILED, {place}" in out
    assert "success_rate=1.000" in out and err.splitlines() == [
        f"bulletarm-zoo check: error: failed: {ids[0]}"
    ]


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
STATES = "equal steps from equal states"


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
def test_change_that_the_state_lacks_is_found(
    change: str,
    passes: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = f"Changed{len(change)}"
    (tmp_path / f"my_{name}.py").write_text(textwrap.dedent(CHANGED.format(name=name, change=change)))
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = ["--gym-packages", f"my_{name}", "-n", "1", "-f", str(tmp_path)]
    assert main(["check", f"BulletArm/CloseLoop{name}-v0", *arguments]) == (0 if passes else 2)
    printed = capsys.readouterr().out
    if passes:
        assert f"{STATES}: passed" in printed
    else:
        assert f"{STATES}: FAILED, AssertionError: the pose of 'cube 1' differs after set_state()" in printed
        assert printed.count("FAILED") == 1
