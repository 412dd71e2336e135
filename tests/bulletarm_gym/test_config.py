"""Parameters are checked at the door, and errors name what to do."""

import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import make_env

from bulletarm_gym.config import PARAMETERS, Context, EnvConfig, ParameterError, TaskDefaults
from bulletarm_gym.geometry import PlacementError

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PULLING = "BulletArm/CloseLoopBlockPulling-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TASK = TaskDefaults(num_objects=2, max_steps=50, object_scale=0.8, allowed_objects=(2, 3))
WORKSPACE = [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]]
OPEN_WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]]


def config(**parameters: Any) -> EnvConfig:
    return EnvConfig.of(Context("close_loop", TASK), parameters)


def open_loop(surface: str = "flat", **parameters: Any) -> EnvConfig:
    return EnvConfig.of(Context("open_loop", TASK, surface), parameters)


def test_defaults_are_the_papers() -> None:
    made = config()
    assert made.workspace == WORKSPACE
    assert (made.robot, made.action_sequence, made.max_steps, made.obs_size) == ("kuka", "pxyzr", 50, 128)
    assert made.object_scale_range == [0.8, 0.8] and made.num_objects == 2
    assert made.fast_mode and made.random_orientation and made.workspace_check == "point"


@pytest.mark.parametrize(
    ("surface", "sequence", "in_hand"),
    [("flat", "pxyr", 24), ("tray", "pxyr", 24), ("ramp", "pxyzrrr", 24), ("bump", "pxyzrrr", 40)],
)
def test_open_loop_defaults_are_the_papers(surface: str, sequence: str, in_hand: int) -> None:
    made = open_loop(surface)
    assert made.workspace == [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]]
    assert (made.action_sequence, made.in_hand_size, made.obs_size) == (sequence, in_hand, 128)
    assert made.half_rotation and made.fast_mode and made.random_orientation and not made.close_loop_tray
    assert open_loop(surface, **made.parameters()) == made


@pytest.mark.parametrize("sequence", ["yx", "xyr", "rxyp", "rrxpyzr", "pxyzrrr", "xyzrrr"])
def test_open_loop_sequences(sequence: str) -> None:
    assert open_loop(action_sequence=sequence).action_sequence == sequence


OPEN_LOOP_WRONG: dict[str, list[Any]] = {
    "action_sequence": ["pxyzr", "pxyrr", "xyz", "px", "pxyzrrrr", "", None],
    "half_rotation": [1, "yes", None],
    "in_hand_size": [0, 7, 300, 24.0, True],
    "close_loop_tray": [False],
    "view": ["orthographic"],
    "observation": ["state"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(n, v) for n, vs in OPEN_LOOP_WRONG.items() for v in vs], ids=str
)
def test_wrong_open_loop_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=rf"^{name} must .*, got ") as error:
        open_loop(**{name: value})
    assert ("close-loop" in str(error.value)) == (name in ("close_loop_tray", "view"))


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("obs_sise", "'obs_size'"),
        ("workspaces", "'workspace'"),
        ("max_step", "'max_steps'"),
        ("physics", "'physics_mode'"),
        ("surfaces", "'surface'"),
        ("frameskip", "robot, action_sequence, "),
        ("render", 'render_mode="human"'),
        ("half_rotation", "open-loop"),
        ("in_hand_size", "open-loop"),
    ],
)
def test_unknown_parameters(name: str, hint: str) -> None:
    with pytest.raises(ParameterError, match=f"^{name} must ") as error:
        config(**{name: 1})
    assert hint in str(error.value)


@pytest.mark.parametrize(
    ("env_id", "name"), [(PICKING, "frameskip"), (PICKING, "half_rotation"), (STACKING, "view")]
)
def test_an_unknown_parameter_is_a_type_error_too(env_id: str, name: str) -> None:
    """Libraries try out parameters so, and say which environment it was in an error of the same type."""
    for make in (gymnasium.make, make_env):
        with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'") as error:
            make(env_id, **{name: 1})
        assert isinstance(error.value, ValueError) and env_id in str(error.value)


@pytest.mark.parametrize("parameters", [{"frameskip": 4}, {"obs_size": 3}], ids=str)
def test_errors_can_be_sent_to_another_process(parameters: dict[str, Any]) -> None:
    with pytest.raises(ParameterError) as error:
        config(**parameters)
    copy = pickle.loads(pickle.dumps(error.value))
    assert type(copy) is type(error.value) and str(copy) == str(error.value)


WRONG: dict[str, list[Any]] = {
    "robot": [1, None],
    "action_sequence": ["pxy", "pxyzrr", "", "PXYZR", 5, None, ["p", "x", "y", "z", "r"]],
    "workspace": [
        None,
        "large",
        WORKSPACE[:2],
        [[0.3, 0.6], [-0.15, 0.2], [0.01, 0.25]],
        [[0.6, 0.3], [0.15, -0.15], [0.01, 0.25]],
        [[0.3, 0.33], [-0.01, 0.02], [0.01, 0.25]],
        [[0.3, 0.6], [-0.15, 0.15], [0.25, 0.01]],
        [[0.3, 0.6], [-0.15, 0.15], [-0.1, 0.25]],
        [[0.3, float("nan")], [-0.15, 0.15], [0.01, 0.25]],
        [[0.3, float("inf")], [-0.15, float("inf")], [0.01, 0.25]],
        np.zeros((3, 2)),
        np.zeros((2, 3)),
    ],
    "object_scale_range": [0, -1.0, [1.0, 0.5], [1.0], [0.5, 3.0], "big", None, True, [float("nan"), 1.0]],
    "max_steps": [0, -1, 2.5, "50", None, True],
    "num_objects": [1, 4, 2.0, "2", None, True],
    "home_height": [0, -0.1, "high", None, True, [0.2], float("nan"), float("inf")],
    "lift_height": [0, -0.1, "high", None, True, 0.1, float("nan"), float("inf")],
    "obs_size": [0, 15, 1025, 64.0, "64", (64, 64), True],
    "fast_mode": [1, 0, "yes", None],
    "random_orientation": [1, "no", None],
    "workspace_check": ["box", None, 3],
    "close_loop_tray": [1, "yes", None],
    "object_set": [3, "no/such/folder", [], ["cube", 3]],
    "view": ["side", None],
    "observation": ["vec", None],
    "physics_mode": ["quick", None, 1],
    "reward": ["nomodule", "a:b:c", ":f", "m:", 3, len],
    "render_mode": ["rgb", "ansi", 1, True],
    "render_size": [8, 5000, 480.0, "large", [480], [480, 360, 3], [480, 0], None, True],
    "render_camera": [
        "top",
        [1.0, 0.0, 1.0],
        {"eye": [1.0, 0.0, 1.0]},
        {"position": [1.0, 0.0]},
        {"target": [0.0, 0.0, float("nan")]},
        {"fov": 180},
        {"fov": True},
    ],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in WRONG.items() for v in values], ids=str)
def test_wrong_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ParameterError) as error:
        config(**{name: value})
    text = str(error.value)
    assert text.startswith(f"{name} must be ") and ", got " in text


def test_every_parameter_is_tested_with_wrong_values() -> None:
    assert {*WRONG, *OPEN_LOOP_WRONG} == set(PARAMETERS)


def test_errors_come_through_make() -> None:
    for parameters in ({"obs_sise": 64}, {"num_objects": 3}, {"workspace": 1}, {"robot": "nobody"}):
        with pytest.raises(ValueError, match=next(iter(parameters))):
            make_env(PICKING, **parameters)


@pytest.mark.parametrize("name", ["CloseLoopBlockPicking", "OpenLoopBlockStacking"])
def test_a_workspace_out_of_reach_is_refused(name: str) -> None:
    far = [[1.25, 1.55], [-0.15, 0.15], [0.01, 0.25]]
    with pytest.raises(ValueError, match=r"workspace must .*='kuka' reaches.* got \[\[1\.25"):
        make_env(f"BulletArm/{name}-v0", workspace=far)


LOW = [[0.01, 0.02], [0.0, 0.0155]]


@pytest.mark.parametrize("z", LOW, ids=str)
def test_a_workspace_too_low_to_lift_in_is_refused(env_id: str, z: list[float]) -> None:
    workspace = [*(WORKSPACE if "CloseLoop" in env_id else OPEN_WORKSPACE)[:2], z]
    with pytest.raises(ParameterError, match=r"^workspace must be .*high"):
        make_env(env_id, workspace=workspace)


@pytest.mark.parametrize(
    ("z", "reason"),
    [([0.01, 0.15], "above 0.15"), ([0.05, 0.25], "below 0.05"), ([0.01, 0.16], None), ([0.04, 0.25], None)],
    ids=str,
)
def test_the_gripper_must_come_down_and_up(z: list[float], reason: str | None) -> None:
    workspace = [*WORKSPACE[:2], z]
    if reason is None:
        make_env(PICKING, workspace=workspace).close()
        return
    with pytest.raises(ParameterError, match=f"^workspace must be .* {reason}"):
        make_env(PICKING, workspace=workspace)


def test_the_smallest_workspace_is_taken_as_it_is_written() -> None:
    for x in ([0.4, 0.44], [0.3, 0.34], [0.6, 0.64]):
        assert config(workspace=[x, [-0.02, 0.02], [0.01, 0.25]]).workspace[0] == x


PARTLY = [[0.5, 0.9], [-0.2, 0.2], [0.01, 0.25]]


@pytest.mark.parametrize(
    "name", ["CloseLoopBlockReaching", "OpenLoopBlockStacking", "OpenLoopObjectGrasping"]
)
def test_a_workspace_partly_out_of_reach_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match=r"^workspace must be .* reaches.* got \[\[0\.5"):
        make_env(f"BulletArm/{name}-v0", workspace=PARTLY)


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
def test_every_arm_reaches_the_default_workspaces(env_id: str, robot: str) -> None:
    if "ObjectGrasping" not in env_id:  # their hundreds of bodies take long to load, and reach is the same
        make_env(env_id, robot=robot, obs_size=16).close()


NARROW = [[0.36, 0.6], [-0.09, 0.15], [0.01, 0.25]]
ROOM: list[tuple[str, dict[str, Any], str | None]] = [
    ("CloseLoopBlockPulling", {"object_scale_range": [0.8, 0.96]}, None),
    ("CloseLoopBlockPulling", {"object_scale_range": 1.2}, "object_scale_range"),
    ("CloseLoopBlockPulling", {"workspace": NARROW}, None),
    ("CloseLoopBlockStacking", {"num_objects": 4, "object_scale_range": [0.8, 1.1]}, None),
    ("CloseLoopHouseBuilding", {"num_objects": 4, "object_scale_range": 1.2}, "object_scale_range"),
    ("CloseLoopHouseBuilding", {"num_objects": 3, "object_scale_range": 1.2}, None),
    ("CloseLoopBlockInBowl", {"object_scale_range": 1.2}, None),
    ("CloseLoopBlockInBowl", {"workspace": NARROW}, "workspace"),
    ("OpenLoopCovidTest", {"workspace": [[0.35, 0.6], [-0.1, 0.15], [0.0, 1.0]]}, "workspace"),
    (
        "OpenLoopObjectGrasping",
        {"num_objects": 4, "workspace": [[0.4, 0.5], [-0.05, 0.05], [0, 1]]},
        "num_objects",
    ),
    ("OpenLoopRampBlockStacking", {"object_scale_range": [0.6, 1.0]}, None),
]


@pytest.mark.parametrize(("name", "parameters", "refused"), ROOM, ids=str)
def test_reset_finds_room_or_names_the_parameter(
    name: str, parameters: dict[str, Any], refused: str | None
) -> None:
    env = make_env(f"BulletArm/{name}-v0", obs_size=16, **parameters)
    if refused is not None:
        with pytest.raises(PlacementError, match=rf"^.*{refused}.* must leave room .*, got "):
            for seed in range(3):
                env.reset(seed=seed)
        env.close()
        return
    for seed in range(30):
        env.reset(seed=seed)
    env.close()


SPANS: list[tuple[str, float, list[str]]] = [
    ("CloseLoopBlockPicking", 2.0, ["kuka", "panda", "ur5", "ur5_robotiq"]),
    ("CloseLoopBlockPicking", 1.66, ["panda", "ur5"]),
    ("CloseLoopBlockPicking", 1.54, ["ur5"]),
    ("CloseLoopBlockPicking", 1.46, []),
    ("CloseLoopBlockReaching", 2.0, ["kuka", "panda", "ur5", "ur5_robotiq"]),
    ("CloseLoopCornerPicking", 2.0, ["kuka", "panda", "ur5", "ur5_robotiq"]),
    ("OpenLoopBlockStacking", 1.54, ["ur5"]),
    ("OpenLoopBoxPalletizing", 1.6, ["kuka", "panda", "ur5", "ur5_robotiq"]),
    ("CloseLoopBlockPushing", 2.0, []),
    ("CloseLoopDrawerOpening", 2.0, []),
]


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
@pytest.mark.parametrize(("name", "scale", "refused"), SPANS)
def test_what_is_grasped_fits_the_gripper(name: str, scale: float, refused: list[str], robot: str) -> None:
    parameters = {"robot": robot, "object_scale_range": [0.6, scale], "obs_size": 16}
    if robot not in refused:
        make_env(f"BulletArm/{name}-v0", **parameters).close()
        return
    with pytest.raises(ParameterError, match=rf"^object_scale_range must .*robot='{robot}'.*, got "):
        make_env(f"BulletArm/{name}-v0", **parameters)


@pytest.mark.parametrize("scale", [0.86, [0.6, 1.0], 2.0], ids=str)
def test_swabs_and_tubes_that_would_overlap_are_refused(scale: Any) -> None:
    make_env("BulletArm/OpenLoopCovidTest-v0", object_scale_range=0.84, obs_size=16).close()
    with pytest.raises(ParameterError, match=r"^object_scale_range must .* overlap"):
        make_env("BulletArm/OpenLoopCovidTest-v0", object_scale_range=scale)


def test_impossible_number_of_objects() -> None:
    for env_id, wrong in ((PICKING, 2), (PULLING, 1)):
        with pytest.raises(ValueError, match="num_objects"):
            make_env(env_id, num_objects=wrong)


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("workspace", np.array(WORKSPACE), WORKSPACE),
        ("workspace", tuple(map(tuple, WORKSPACE)), WORKSPACE),
        ("object_scale_range", (0.6, 1), [0.6, 1.0]),
        ("object_scale_range", np.array([0.6, 1.0]), [0.6, 1.0]),
        ("object_scale_range", 1, [1.0, 1.0]),
        ("object_scale_range", np.float64(0.5), [0.5, 0.5]),
        ("object_scale_range", np.float32(0.5), [0.5, 0.5]),
        ("object_scale_range", np.int64(1), [1.0, 1.0]),
        ("max_steps", np.int64(9), 9),
        ("obs_size", np.int32(64), 64),
        ("fast_mode", np.bool_(False), False),
        ("reward", "package.module:function", "package.module:function"),
        ("render_mode", None, None),
        ("render_size", 64, [64, 64]),
        ("render_size", np.array([64, 48]), [64, 48]),
        ("render_camera", {"position": np.ones(3)}, {"position": [1.0, 1.0, 1.0]}),
        ("action_sequence", "zyxp", "zyxp"),
    ],
    ids=str,
)
def test_array_likes_are_kept_as_plain_values(name: str, given: Any, kept: Any) -> None:
    value = getattr(config(**{name: given}), name)
    assert value == kept and type(value) is type(kept)


def test_numpy_strings_and_choices_are_plain() -> None:
    assert type(config(robot="panda").robot) is str
    assert config(num_objects=3).num_objects == 3
    assert config(num_objects=np.int64(3)).num_objects == 3


def test_scales_are_a_grid_with_both_ends() -> None:
    assert config(object_scale_range=[0.6, 0.7]).scales == [0.6, 0.62, 0.64, 0.66, 0.68, 0.7]
    assert config(object_scale_range=0.6).scales == [0.6]
    for low, high in ((0.6, 0.63), (0.6, 0.61), (0.5, 0.535)):
        scales = config(object_scale_range=[low, high]).scales
        assert scales[0] == low and scales[-1] == high
        assert scales == sorted(set(scales)), "each once, in order, none beyond the end"


def test_what_was_given_is_neither_kept_nor_changed() -> None:
    workspace = [list(row) for row in WORKSPACE]
    first = config(workspace=workspace)
    first.workspace[0][0] = 9.0
    assert workspace == WORKSPACE
    array = np.array(WORKSPACE)
    second = config(workspace=array)
    array[:] = 0.0
    assert second.workspace == WORKSPACE


def test_defaults_are_not_shared() -> None:
    config().workspace[0][0] = 9.0
    assert config().workspace == WORKSPACE
    first = make_env(PICKING)
    first.config.workspace[0][0] = 9.0
    second = make_env(PICKING)
    assert second.config.workspace == WORKSPACE
    first.close()
    second.close()


def test_parameters_give_the_same_configuration_back() -> None:
    made = config(workspace=np.array(WORKSPACE), object_scale_range=0.7, obs_size=64)
    assert config(**made.parameters()) == made
    assert set(made.parameters()) == set(PARAMETERS) - {"half_rotation", "in_hand_size"}


def test_task_refuses_a_control_it_does_not_know() -> None:
    from bulletarm_gym.env import ManipulationEnv

    with pytest.raises(ValueError, match="control"):
        ManipulationEnv(task="bulletarm_gym.tasks.picking:BlockPicking", control="by_hand")
    with pytest.raises(ValueError, match="nothing_here"):
        ManipulationEnv(task="bulletarm_gym.nothing_here:Task", control="close_loop")


@pytest.mark.parametrize("env_id", [PICKING, PULLING])
def test_scales_change_sizes(env_id: str) -> None:
    env = make_env(env_id, object_scale_range=[0.6, 0.8])
    sizes = set()
    for seed in range(12):
        env.reset(seed=seed)
        sizes |= {round(item.spec.extents[0], 6) for item in env.scene if item.spec.mass > 0.0}
    nominal = 0.1 if "Pulling" in env_id else 0.05
    assert sizes <= {round(nominal * (0.6 + 0.02 * step), 6) for step in range(11)}
    assert len(sizes) > 3
    env.close()
