"""The environments as Gymnasium, Stable-Baselines3 and their users meet them."""

import dataclasses
import functools
import itertools
import json
import math
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeAwareObservation
from rollouts import advance, digest, idle, is_open_loop, make_env, mixed_action, step_on, transcript

import bulletarm_gym
from bulletarm_gym.control import DeltaMove
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import KUKA, RobotModel
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.state import EnvState
from bulletarm_gym.wrappers import UNLIMITED

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PULLING = "BulletArm/CloseLoopBlockPulling-v0"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
SB3_IMAGE_WARNINGS = (
    "whereas it has to be `np.uint8`",
    "are not in [0, 255]",
    "The minimal resolution for an image is 36x36",
)
"""What Stable-Baselines3 says of images that are depths in metres: their type, their bounds, their size."""


def with_pose(env: ManipulationEnv, state: EnvState, role: str, pose: Pose) -> EnvState:
    """The state with a role's body elsewhere."""
    poses = list(state.world.poses)
    poses[env.scene[role].body.index] = pose
    return dataclasses.replace(state, world=dataclasses.replace(state.world, poses=tuple(poses)))


def loose_role(env: ManipulationEnv) -> str:
    """The role of something that can leave the workspace."""
    roles = [item.slot.name for item in env.scene if item.spec.mass > 0.0]
    return roles[0] if roles else pytest.skip("nothing here is loose")


# Checkers


def test_gymnasium_finds_no_fault(env: ManipulationEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)  # that of a kind is enough, see below


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a display is looked for on Linux only")
def test_gymnasium_finds_no_fault_in_pictures(typical_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = make_env(typical_id, render_mode="rgb_array", obs_size=16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)
    env.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a display is looked for on Linux only")
@pytest.mark.parametrize("display", ["", ":0"])
def test_a_window_is_offered_where_there_is_a_display(display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = make_env(PICKING, obs_size=16)
    modes = ["rgb_array", "depth_array", "human"]
    assert env.metadata["render_modes"] == modes[: 3 if display else 2]
    assert type(env).metadata["render_modes"] == modes
    env.close()


def test_default_wrappers_find_no_fault(typical_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(typical_id)
        env.reset(seed=0)
        for _ in range(3):
            if any(env.step(env.action_space.sample())[2:4]):
                env.reset()
        env.close()


@pytest.mark.parametrize("obs_size", [32, 128])
def test_stable_baselines_warns_of_images_only(make: Make, env_id: str, obs_size: int) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(make(env_id, obs_size=obs_size))
    texts = [str(warning.message) for warning in caught]
    others = [text for text in texts if not any(known in text for known in SB3_IMAGE_WARNINGS)]
    assert not others
    images = [
        space for space in make(env_id, obs_size=obs_size).observation_space.values() if len(space.shape) == 3
    ]
    assert len(texts) == sum(2 * (space.dtype != np.uint8) + (space.shape[-1] < 36) for space in images)


# Observations and information


def test_observations_are_sound(env: ManipulationEnv) -> None:
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    for _ in range(25):
        previous = observation
        action = mixed_action(env, rng)
        observation, _, terminated, truncated, _ = env.step(action)
        assert env.observation_space.contains(observation)
        for key, array in observation.items():
            assert array.dtype == (np.uint8 if key == "color" else np.float32)
            assert np.isfinite(array).all() and array.flags.c_contiguous
            assert array.flags.writeable and not np.may_share_memory(array, previous[key])
        if terminated or truncated:
            observation, _ = env.reset()
            assert env.observation_space.contains(observation)


@pytest.mark.parametrize("obs_size", [16, 64, 129])
def test_observation_size(make: Make, obs_size: int) -> None:
    env = make(PICKING, obs_size=obs_size)
    assert env.reset(seed=0)[0]["heightmap"].shape == (1, obs_size, obs_size)
    assert env.observation_space["heightmap"].shape == (1, obs_size, obs_size)


def test_later_steps_leave_earlier_observations_alone(typical_env: ManipulationEnv) -> None:
    observation, info = typical_env.reset(seed=0)
    before = digest(observation, info)
    for _ in range(2):
        step_on(typical_env, typical_env.expert_action())
    assert digest(observation, info) == before


def test_a_caller_may_write_into_what_it_got(typical_env: ManipulationEnv) -> None:
    expected = transcript(typical_env, 5, seed=3)
    observation, info = typical_env.reset(seed=3)
    observation["heightmap"][:] = 7.0
    info.clear()
    assert transcript(typical_env, 5) == expected[1:]


def test_info_keeps_its_keys(env: ManipulationEnv) -> None:
    _, at_reset = env.reset(seed=0)
    *_, at_step = env.step(env.expert_action())
    assert at_reset.keys() == at_step.keys() >= {"is_success", "is_valid", "ignored"}
    assert "success" not in at_step
    assert {type(value) for info in (at_reset, at_step) for value in info.values()} == {bool}
    assert json.loads(json.dumps(at_step)) == at_step


@pytest.mark.parametrize(
    "facts", [None, {}, {"is_success": True}, {"success": True, "ignored": False}], ids=str
)
def test_facts_of_a_task_are_checked(facts: Any) -> None:
    env = make_env(PICKING, obs_size=16)
    env.task.evaluate = lambda scene: facts  # type: ignore[method-assign]
    with pytest.raises(
        ValueError, match=r"^evaluate\(\) of BlockPicking must return a dict with 'success' and"
    ):
        env.reset(seed=0)
    env.close()


def succeeded(scene: Scene, outcome: Mapping[str, bool]) -> float:
    assert outcome.keys() >= {"is_success", "is_valid", "ignored"} and "success" not in outcome
    return 2.0 * outcome["is_success"]


def test_rewards_get_the_info() -> None:
    env = make_env(REACHING, obs_size=16, reward=succeeded)
    env.reset(seed=0)
    rewards = [0.0]
    while not rewards[-1]:
        rewards.append(env.step(env.expert_action())[1])
    assert rewards[-1] == 2.0
    env.close()


# Reward and end


def test_success_ends_the_episode_with_reward_one(env: ManipulationEnv) -> None:
    for seed in range(3):  # the expert may fail once
        env.reset(seed=seed)
        terminated = truncated = False
        while not (terminated or truncated):
            _, reward, terminated, truncated, info = env.step(env.expert_action())
            assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
            assert reward == float(info["is_success"]) and info["is_success"] == (
                terminated and info["is_valid"]
            )
        if terminated:
            break
    assert info["is_success"] and info["is_valid"]


@pytest.mark.parametrize("max_steps", [1, 4])
def test_time_limit_truncates(make: Make, typical_id: str, max_steps: int) -> None:
    env = make(typical_id, max_steps=max_steps)
    for seed in range(2):
        env.reset(seed=seed)
        if env.task.single_step:
            assert env.step(idle(env))[1:4] == (0.0, True, False)
            continue
        ends = [env.step(idle(env))[1:4] for _ in range(max_steps)]
        assert ends == [(0.0, False, False)] * (max_steps - 1) + [(0.0, False, True)]


@pytest.mark.parametrize("name", ["max_steps", "max_episode_steps"])
def test_success_at_the_time_limit_terminates(make: Make, name: str) -> None:
    length = _expert_length(make(REACHING), 0)
    limited = gymnasium.make(REACHING, **{name: length})
    for env in (limited, gymnasium.make(EnvSpec.from_json(limited.spec.to_json()))):
        env.reset(seed=0)
        for _ in range(length):
            result = env.step(env.unwrapped.expert_action())
        assert result[1:4] == (1.0, True, False)
        env.close()


def _expert_length(env: ManipulationEnv, seed: int) -> int:
    env.reset(seed=seed)
    return next(number for number in itertools.count(1) if env.step(env.expert_action())[2])


@pytest.mark.parametrize(
    ("sides", "height"),
    [((-0.7, 0.0), 0.025), ((0.0, 0.8), 0.025), ((0.0, -0.504), 0.025), ((0.0, 0.0), -0.2)],
    ids=["before x", "beyond y", "just below y", "below the floor"],
)
def test_invalid_scene_terminates_without_reward(
    env: ManipulationEnv, sides: tuple[float, float], height: float
) -> None:
    env.reset(seed=0)
    role = loose_role(env)
    side = env.config.workspace_size
    x, y = (middle + side * offset for middle, offset in zip(env.config.centre, sides, strict=True))
    env.set_state(with_pose(env, env.get_state(), role, Pose((x, y, height))))
    assert env.expert_action() in env.action_space
    _, reward, terminated, truncated, info = env.step(idle(env))
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["is_valid"] is False and info["is_success"] is False


def test_border_belongs_to_the_workspace(env: ManipulationEnv) -> None:
    env.reset(seed=0)
    role = loose_role(env)
    end = env.config.workspace[0][1] - 1e-4
    env.set_state(with_pose(env, env.get_state(), role, Pose((end, 0.1, 0.025))))
    *_, info = env.step(idle(env))
    assert info["is_valid"]


def test_bounding_box_is_stricter_than_point(make: Make) -> None:
    for check, valid in (("point", True), ("bounding_box", False)):
        env = make(PICKING, workspace_check=check)
        _, info = env.reset(seed=0)
        assert info["is_valid"]
        env.set_state(with_pose(env, env.get_state(), "cube", Pose((0.59, 0.1, 0.025))))
        assert env.step(idle(env))[4]["is_valid"] is valid


@pytest.mark.parametrize(("x", "valid"), [(0.595, True), (0.605, False)])
def test_success_counts_only_in_a_valid_scene(make: Make, x: float, valid: bool) -> None:
    env = make(REACHING)
    env.reset(seed=0)
    env.set_state(with_pose(env, env.get_state(), "cube", Pose((0.35, 0.1, 0.025))))
    for _ in range(8):
        env.step(env.encode_action(_towards(env, (0.6, 0.0, 0.04))))
    env.set_state(with_pose(env, env.get_state(), "cube", Pose((x, 0.0, 0.025))))
    _, reward, terminated, truncated, info = env.step([1.0, 0.0, 0.0, 0.0, 0.0])
    assert env.task.evaluate(env.scene)["success"] and terminated and not truncated
    assert (reward, info["is_success"], info["is_valid"]) == (float(valid), valid, valid)


def _towards(env: ManipulationEnv, point: tuple[float, float, float]) -> DeltaMove:
    hand = env.scene.robot.pose.position
    x, y, z = (goal - now for goal, now in zip(point, hand, strict=True))
    return DeltaMove(1.0, (x, y, z))


def test_custom_reward(typical_id: str) -> None:
    env = make_env(typical_id, reward="math:dist")
    env._reward = lambda scene, outcome: 0.25  # type: ignore[assignment]
    env.reset(seed=0)
    assert env.step(idle(env))[1] == 0.25
    env.close()
    with pytest.raises(ValueError, match="nowhere"):
        make_env(typical_id, reward="nowhere:nothing")


def paid(scene: Scene, outcome: Mapping[str, bool]) -> float:
    return 0.25


@pytest.mark.parametrize("given", ["path", "function", "lambda", "object"])
def test_a_reward_may_be_a_function(given: str) -> None:
    path = f"{paid.__module__}:paid"
    bonus = functools.partial(paid)
    kinds = {"path": path, "function": paid, "lambda": lambda scene, outcome: 0.25, "object": bonus}
    env = gymnasium.make(PICKING, obs_size=16, reward=kinds[given])
    env.reset(seed=0)
    assert env.step(idle(env.unwrapped))[1] == 0.25
    again = gymnasium.make(env.spec)
    again.reset(seed=0)
    assert again.step(idle(env.unwrapped))[1] == 0.25
    if given in ("path", "function"):
        assert env.unwrapped.config.reward == path and path in env.spec.to_json()
    if given != "lambda":
        assert pickle.loads(pickle.dumps(env)).step(idle(env.unwrapped))[1] == 0.25


@pytest.mark.parametrize("value", [None, math.nan, math.inf, "much"], ids=str)
def test_a_reward_that_is_no_number_is_named_at_once(value: Any) -> None:
    def mine(scene: Scene, outcome: Mapping[str, bool]) -> Any:
        return value

    env = make_env(PICKING, obs_size=16, reward=mine)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"^reward must be .*, got {value!r} from .*:.*mine"):
        env.step(idle(env))
    env.close()
    with pytest.raises(ValueError, match=r"^reward must be .*, got 'no:where': .*No module"):
        gymnasium.make(PICKING, reward="no:where")
    with pytest.raises(ValueError, match=r"reward must be a function.*, got 'math:pi'"):
        make_env(PICKING, reward="math:pi")


def narrow_kuka() -> RobotModel:
    gripper = dataclasses.replace(KUKA.gripper, stroke=0.08)
    return dataclasses.replace(KUKA, name="narrow_kuka", gripper=gripper)


@pytest.mark.parametrize("given", ["path", "function", "lambda", "model", "known model"])
def test_a_robot_may_be_a_model_or_a_function(given: str) -> None:
    path = f"{narrow_kuka.__module__}:narrow_kuka"
    model = narrow_kuka()
    kinds: dict[str, Any] = {"path": path, "function": narrow_kuka, "lambda": lambda: model, "model": model}
    env = make_env(PICKING, obs_size=16, robot=kinds.get(given, KUKA))
    expected = "kuka" if given == "known model" else "narrow_kuka"
    assert env.scene.robot.model.name == expected
    state = advance(env, 0, 4)
    if given != "lambda":
        copy = pickle.loads(pickle.dumps(env))
        assert copy.scene.robot.model.gripper == env.scene.robot.model.gripper
        assert transcript(copy, 3) == transcript(env, 3)
    other = make_env(PICKING, obs_size=16, robot="kuka" if given == "known model" else narrow_kuka)
    other.set_state(state)
    env.close()
    other.close()
    with pytest.raises(ValueError, match="robot must be a RobotModel"):
        make_env(PICKING, robot=dict)


# Actions


def test_actions_outside_the_box_are_clipped(typical_env: ManipulationEnv) -> None:
    action = np.array([3.0, -2.0, 1.5, -7.0, 1.01, 2.0, -1.5], np.float32)[
        : typical_env.action_space.shape[0]
    ]
    typical_env.reset(seed=0)
    far = digest(*typical_env.step(action))
    typical_env.reset(seed=0)
    assert digest(*typical_env.step(action.clip(-1.0, 1.0))) == far


@pytest.mark.parametrize(
    "action",
    [
        math.nan,
        -math.inf,
        np.zeros(3, np.float32),
        np.zeros((1, 5), np.float32),
        np.float32(0.0),
        "open",
        None,
        [0, 0, [1, 2], 0, 0],
    ],
    ids=str,
)
def test_bad_actions_are_refused_and_do_nothing(typical_env: ManipulationEnv, action: Any) -> None:
    typical_env.reset(seed=0)
    state = typical_env.get_state()
    if isinstance(action, float):
        action = np.where(np.arange(len(idle(typical_env))) == 2, action, 0.0)
    with pytest.raises(ValueError, match="action"):
        typical_env.step(action)
    assert typical_env.get_state() == state


def test_a_move_out_of_reach_is_ignored() -> None:
    env = make_env(PICKING, obs_size=16)
    env.control._workspace = [[0.0, 2.0], [-1.0, 1.0], [0.01, 0.25]]  # wider than could be made
    env.reset(seed=0)
    outcomes = [env.step(env.encode_action(DeltaMove(1.0, (0.05, 0.0, 0.0))))[4] for _ in range(12)]
    assert not outcomes[0]["ignored"] and outcomes[-1]["ignored"]
    assert 0.6 < env.scene.robot.pose.x < 1.0
    env.close()


def test_no_pick_or_place_at_the_limits_raises() -> None:
    """Simulated all the way, over the corners of a workspace that is as far away as it may be."""
    workspace = [[0.3, 0.7], [-0.2, 0.2], [0.0, 1.0]]
    env = make_env("BulletArm/OpenLoopBlockStacking-v0", obs_size=16, workspace=workspace, fast_mode=False)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for number in range(12):
        *_, terminated, truncated, _ = env.step(
            rng.choice([-1.0, 1.0], 4) if number % 2 else env.expert_action()
        )
        if terminated or truncated:
            env.reset()
    env.close()


def test_decode_gives_physical_units(picking: ManipulationEnv) -> None:
    move = picking.decode_action([-1.0, 1.0, -1.0, 0.5, 1.0])
    assert move.opening == 0.0
    assert move.translation == pytest.approx((0.05, -0.05, 0.025))
    assert move.rotation == pytest.approx(math.pi / 4)


SEQUENCES = ["".join(order) for word in ("pxyz", "pxyzr") for order in itertools.permutations(word)]


def test_encode_inverts_decode_for_every_sequence(picking: ManipulationEnv) -> None:
    rng = np.random.default_rng(0)
    control = picking.control
    for sequence in SEQUENCES:
        config = dataclasses.replace(picking.config, action_sequence=sequence)
        control_of = type(control)(config, control.robot, picking.task.grasp_params)
        action = rng.uniform(-1, 1, len(sequence)).astype(np.float32)
        assert control_of.action_space.shape == (len(sequence),)
        np.testing.assert_allclose(
            control_of.encode_action(control_of.decode_action(action, picking.look())), action, atol=1e-6
        )
        unit = np.zeros(len(sequence))
        unit[sequence.index("y")] = 1.0
        assert control_of.decode_action(unit, picking.look()).translation == pytest.approx((0.0, 0.05, 0.0))


def test_encode_clips(picking: ManipulationEnv) -> None:
    action = picking.encode_action(DeltaMove(2.0, (1.0, -1.0, 0.0), 9.0))
    assert action.tolist() == [1.0, 1.0, -1.0, 0.0, 1.0]


@pytest.mark.parametrize("sequence", ["pxyz", "rzyxp", "xyzp"])
def test_order_of_the_sequence_changes_names_only(make: Make, sequence: str) -> None:
    env, plain = make(PICKING, action_sequence=sequence), make(PICKING)
    move = DeltaMove(0.5, (0.03, -0.02, -0.04), 0.3 if "r" in sequence else 0.0)
    assert digest(env.reset(seed=4)[0]) == digest(plain.reset(seed=4)[0])
    moved, expected = (e.step(e.encode_action(move))[0] for e in (env, plain))
    np.testing.assert_allclose(moved["heightmap"], expected["heightmap"], atol=1e-5)


# Pictures


def test_pictures(make: Make, env_id: str) -> None:
    shots = {}
    for mode in ("rgb_array", "depth_array"):
        env = make(env_id, render_mode=mode)
        env.reset(seed=0)
        shots[mode] = env.render()
        assert np.array_equal(env.render(), shots[mode])
    color, depth = shots["rgb_array"], shots["depth_array"]
    assert color.shape == (480, 480, 3) and color.dtype == np.uint8 and color.std() > 10
    assert depth.shape == (480, 480) and depth.dtype == np.float32
    assert 0.5 < depth.min() < depth.max() <= 4.0


def test_pictures_show_the_scene(make: Make) -> None:
    env = make(PICKING, render_mode="rgb_array")
    env.reset(seed=0)
    state, before = env.get_state(), env.render()
    env.set_state(with_pose(env, state, "cube", Pose((0.33, -0.1, 0.025))))
    assert (env.render() != before).any(axis=-1).sum() > 500


def test_render_without_a_mode_warns(typical_env: ManipulationEnv) -> None:
    typical_env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"render_mode must be set for render\(\), got None"):
        assert typical_env.render() is None


HUMAN = """
import gymnasium, bulletarm_gym
try:
    gymnasium.make(bulletarm_gym.ENV_IDS[0], render_mode="human")
except RuntimeError as error:
    print("refused", error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a display is looked for on Linux only")
def test_window_without_a_display_is_refused_and_the_process_lives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    child = subprocess.run([sys.executable, "-c", HUMAN], capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    assert "refused" in child.stdout and "DISPLAY" in child.stdout and "rgb_array" in child.stdout


# Life


def test_many_environments_at_once() -> None:
    env_ids = [*bulletarm_gym.ENV_IDS, *[PICKING] * 54]
    envs = [make_env(env_id) for env_id in env_ids]
    first = [digest(*env.reset(seed=1)) for env in envs]
    assert len(set(first)) == len(bulletarm_gym.ENV_IDS)
    for env in envs:
        env.step(env.expert_action())
        env.close()


# Making


def test_ids_are_registered_without_a_time_limit(env_id: str) -> None:
    spec = gymnasium.spec(env_id)
    assert spec.max_episode_steps is None
    assert isinstance(spec.entry_point, str)
    assert json.loads(json.dumps(spec.kwargs)) == spec.kwargs


def test_make_with_module_prefix_in_a_fresh_interpreter() -> None:
    make = "gymnasium.make(f'bulletarm_gym:{name}').close(); print(name)"
    code = f"import gymnasium, sys\nfor name in sys.argv[1:]: {make}"
    command = [sys.executable, "-c", code, *bulletarm_gym.ENV_IDS]
    child = subprocess.run(command, capture_output=True, text=True, check=False)
    assert child.stdout.split() == list(bulletarm_gym.ENV_IDS), child.stderr


def test_spec_round_trip(typical_id: str) -> None:
    small, shifted = [[0.32, 0.6], [-0.14, 0.14], [0.01, 0.25]], [[0.26, 0.66], [-0.19, 0.21], [0.01, 0.9]]
    workspace = np.array(shifted if is_open_loop(typical_id) else small)
    env = gymnasium.make(
        typical_id,
        workspace=workspace,
        object_scale_range=(0.8, 0.8),
        max_steps=np.int64(7),
        fast_mode=np.True_,
    )
    text = env.spec.to_json()
    assert env.unwrapped.spec.kwargs["workspace"] == workspace.tolist()
    assert env.unwrapped.spec.kwargs["object_scale_range"] == [0.8, 0.8]
    again = gymnasium.make(EnvSpec.from_json(text))
    assert again.unwrapped.config == env.unwrapped.config
    assert digest(*again.reset(seed=2)) == digest(*env.reset(seed=2))
    env.close()
    again.close()


@pytest.mark.parametrize(
    ("first", "then", "steps"),
    [
        ({}, {}, 50),
        ({"max_steps": 7}, {}, 7),
        ({"max_episode_steps": 60}, {}, 60),
        ({"max_episode_steps": 5}, {}, 5),
        ({"max_steps": 7, "max_episode_steps": 60}, {}, 60),
        ({}, {"max_steps": 60}, 60),
        ({}, {"max_episode_steps": 60}, 60),
        ({"max_steps": 60}, {"max_episode_steps": 7}, 7),
        ({"max_episode_steps": 60}, {"max_steps": 7}, 7),
    ],
    ids=str,
)
def test_the_spec_says_where_episodes_are_truncated(
    first: dict[str, int], then: dict[str, int], steps: int
) -> None:
    """Made with some parameters, and again from its spec with others."""
    made = gymnasium.make(PICKING, obs_size=16, **first)
    again = gymnasium.make(EnvSpec.from_json(made.spec.to_json()), **then)
    if not then:
        assert again.spec == made.spec and again.unwrapped.config == made.unwrapped.config
    for env in (again, pickle.loads(pickle.dumps(again))):
        limits = {env.spec.max_episode_steps, env.unwrapped.spec.max_episode_steps}
        assert limits == {TimeAwareObservation(env).max_timesteps} == {steps}
        env.reset(seed=0)
        ends = [env.step(idle(env.unwrapped))[2:4] for _ in range(steps)]
        assert ends == [(False, False)] * (steps - 1) + [(False, True)]
        env.close()
    made.close()


@pytest.mark.parametrize("then", [False, True])
def test_no_limit_with_max_episode_steps_of_minus_one(then: bool) -> None:
    env = gymnasium.make(PICKING, obs_size=16, **({} if then else {"max_episode_steps": -1}))
    if then:
        env = gymnasium.make(env.spec, max_episode_steps=-1)
    for each in (env, gymnasium.make(env.spec), pickle.loads(pickle.dumps(env))):
        each.reset(seed=0)
        assert not any(each.step(idle(each.unwrapped))[3] for _ in range(60))
        each.close()
    vector = gymnasium.make_vec(PICKING, num_envs=1, max_episode_steps=-1, obs_size=16)
    assert vector.get_attr("spec")[0].max_episode_steps == UNLIMITED
    vector.close()


def test_vectors_take_the_time_limit() -> None:
    vector = gymnasium.make_vec(PICKING, num_envs=1, max_episode_steps=60, obs_size=16)
    assert [spec.max_episode_steps for spec in vector.get_attr("spec")] == [60]
    vector.close()


def test_making_leaves_the_registry_alone(env_id: str) -> None:
    before = gymnasium.spec(env_id).to_json()
    gymnasium.make(env_id, max_steps=3).close()
    gymnasium.make(env_id, max_episode_steps=3).close()
    assert gymnasium.spec(env_id).to_json() == before


def test_vector_in_one_process(typical_id: str, make: Make) -> None:
    vector = gymnasium.make_vec(typical_id, num_envs=2, vectorization_mode="sync")
    observation, _ = vector.reset(seed=[3, 4])
    for index, seed in enumerate((3, 4)):
        alone, _ = make(typical_id).reset(seed=seed)
        assert np.array_equal(observation["heightmap"][index], alone["heightmap"])
    actions = np.stack(vector.call("expert_action"))
    assert vector.step(actions)[0] in vector.observation_space
    vector.close()


def _solve(vec_env: Any) -> None:
    """The experts of a stable-baselines3 vector of environments solve an episode each."""
    vec_env.seed(0)
    vec_env.reset()
    solved = np.zeros(vec_env.num_envs, bool)
    for _ in range(40):
        _, _, dones, infos = vec_env.step(np.stack(vec_env.env_method("expert_action")))
        solved |= dones & np.array([info["is_success"] for info in infos])
    vec_env.close()
    assert solved.all()


def test_stable_baselines_dummy_vector(typical_id: str) -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv

    _solve(DummyVecEnv([lambda: gymnasium.make(typical_id)] * 2))


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_stable_baselines_worker_processes(method: str) -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import SubprocVecEnv

    _solve(SubprocVecEnv([lambda: gymnasium.make(f"bulletarm_gym:{PICKING}")] * 2, start_method=method))


def test_measure_adds_up_seconds(picking: ManipulationEnv) -> None:
    env = make_env(picking.spec.id)
    env.reset(seed=0)
    seconds = env.measure()
    assert set(seconds.values()) == {0.0}
    env.step(env.expert_action())
    first = dict(seconds)
    assert first["rendering"] > 0.0
    while not env.step(env.expert_action())[2]:
        pass
    assert all(seconds[part] > first[part] for part in first)
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        env.scene.world.step()
