"""The environments of bulletarm-gym in LeRobot: ``lerobot-eval --env.type=bulletarm``.

Observations have the names, shapes and types of ``bulletarm_gym.demonstrations.export_lerobot``.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.demonstrations.exports import CAMERAS
from bulletarm_gym.observations import Rgb, State
from bulletarm_gym.observations.sensor import GRIPPER_SIZE

Observation = dict[str, Any]


class LeRobotObservation(gymnasium.ObservationWrapper[Observation, Any, Observation]):
    """Observe images, gripper and, if wanted, object poses under the names that LeRobot expects.

    :param env: environment of bulletarm-gym
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param object_poses: observe the poses of the objects
    """

    def __init__(
        self,
        env: gymnasium.Env[Observation, Any],
        cameras: Mapping[str, Mapping[str, Any]],
        object_poses: bool,
    ) -> None:
        super().__init__(env)
        core: Any = env.unwrapped
        self.task, self.task_description = core.spec.id, core.task_description
        self._cameras = {name: Rgb(core.scene, **parameters) for name, parameters in cameras.items()}
        self._state, self._object_poses = State(core.scene), object_poses
        images = {name: np.moveaxis(camera.space.low, 0, -1).shape for name, camera in self._cameras.items()}
        pixels = {name: spaces.Box(0, 255, shape, np.uint8) for name, shape in images.items()}
        poses = self._state.space.shape[0] - GRIPPER_SIZE
        known = {"agent_pos": GRIPPER_SIZE + 1, **({"environment_state": poses} if object_poses else {})}
        vectors = {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in known.items()}
        self.observation_space = spaces.Dict({"pixels": spaces.Dict(pixels), **vectors})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode, without the options that LeRobot passes to its own wrappers."""
        known = {name: value for name, value in (options or {}).items() if not name.startswith("lerobot_")}
        return super().reset(seed=seed, options=known)

    def observation(self, observation: Observation) -> Observation:
        """Return the observation of LeRobot in the current state."""
        view = self.unwrapped.look()
        poses = self._state.read(view)
        return {
            "pixels": {name: camera.read(view).transpose(1, 2, 0) for name, camera in self._cameras.items()},
            "agent_pos": np.append(poses[:GRIPPER_SIZE], np.float32(view.is_holding)),
            **({"environment_state": poses[GRIPPER_SIZE:]} if self._object_poses else {}),
        }


def make_env(
    env_id: str,
    cameras: Mapping[str, Mapping[str, Any]],
    object_poses: bool,
    env_kwargs: Mapping[str, Any],
) -> gymnasium.Env[Observation, Any]:
    """Make the wrapped environment of an id."""
    kwargs = {"render_mode": "rgb_array", "render_size": [240, 240], **env_kwargs}
    return LeRobotObservation(gymnasium.make(env_id, **kwargs), cameras, object_poses)


@EnvConfig.register_subclass("bulletarm")
@dataclass
class BulletArmEnv(EnvConfig):
    """Configuration of ``--env.type=bulletarm``.

    :param task: id without its namespace, for a task of your own after its module and a colon
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param object_poses: observe the poses of the objects as ``observation.environment_state``
    :param env_kwargs: parameters of the environment
    """

    task: str | None = "CloseLoopBlockPicking-v0"
    fps: int = 5
    cameras: dict[str, dict[str, Any]] = field(default_factory=lambda: {**CAMERAS})
    object_poses: bool = False
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Import the module of the task, and fill in the features of the environment."""
        if module := str(self.task).rpartition(":")[0]:
            importlib.import_module(module)
            register_all()
        env = gymnasium.make(self.gym_id, **self.gym_kwargs)
        observations: Any = env.observation_space
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, env.action_space.shape)}
        self.features_map = {ACTION: ACTION}
        kinds = {
            "agent_pos": (FeatureType.STATE, OBS_STATE),
            "environment_state": (FeatureType.ENV, OBS_ENV_STATE),
        }
        for name, (kind, key) in kinds.items():
            if name in observations.keys():
                self.features[name] = PolicyFeature(kind, observations[name].shape)
                self.features_map[name] = key
        for name, box in observations["pixels"].items():
            self.features[f"pixels/{name}"] = PolicyFeature(FeatureType.VISUAL, box.shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"
        env.close()

    @property
    def package_name(self) -> str:
        """Name of this package, the namespace of its ids."""
        return __name__

    @property
    def gym_id(self) -> str:
        """Id that LeRobot makes."""
        return f"{__name__}/{str(self.task).rpartition(':')[2]}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of :func:`make_env`."""
        return {"cameras": self.cameras, "object_poses": self.object_poses, "env_kwargs": self.env_kwargs}


def register_all() -> None:
    """Register all present ids of the namespace BulletArm, also of users, for LeRobot."""
    for env_id in [name for name in gymnasium.registry if name.startswith("BulletArm/")]:
        own_id = f"{__name__}/{env_id.partition('/')[2]}"
        if own_id not in gymnasium.registry:
            gymnasium.register(
                id=own_id,
                entry_point=f"{__name__}:make_env",
                kwargs={"env_id": env_id},
                order_enforce=False,  # LeRobot reads task_description from the outermost wrapper only
                disable_env_checker=True,
            )


register_all()
