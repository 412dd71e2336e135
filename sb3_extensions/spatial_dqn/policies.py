"""Policies of spatial Q algorithms: the paper's networks for its Open-Loop 2D, 3D and 6D benchmarks."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.spatial_dqn.asr_heads import (
    PATCH_CHANNELS,
    PATCH_HIDDEN,
    DeicticLevel,
    EquivariantRotations,
    Level,
    PlainLevel,
    PlainRotations,
)
from sb3_extensions.spatial_dqn.codec import ANGLES, DEFAULT_SEQUENCE, SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import (
    CHANNELS,
    FIELDS,
    IN_HAND_CHANNELS,
    PATCH_MAP_CHANNELS,
    EquivariantPixelMaps,
    PixelMaps,
    PlainPixelMaps,
    RotatedPixelMaps,
)
from sb3_extensions.spatial_dqn.q_network import SpatialQNetwork

PATCH_FIELDS = (8, 16, 32, 32, 16)
"""Regular fields of the convolutions on the patch (the authors' code)."""
HIDDEN = (1024, 512)
"""Units of the linear layers of :class:`EquivariantASRPolicy` (the authors' code)."""
TILTED_PATCH_SCALE = 300.0
"""Factor (1/m) of patches, projections and in-hand images in 6D: the authors' code multiplies patches by 300,
and counts voxels of 3 mm in the others."""
WEIGHT_DECAY = 1e-5
"""Weight decay of Adam (paper, appendix "Benchmark Details")."""


class SpatialPolicy(BasePolicy):
    """
    Base class of the policies: greedy actions of a Q function over an action grid, and its target network.

    See :class:`~sb3_extensions.encoders.observation.SceneView` for the parameters ``quantise``,
    ``standardise``, ``image_key``, ``in_hand_key`` and ``holding_key``.

    :param observation_space: Observation space, see :class:`~sb3_extensions.encoders.observation.SceneView`
    :param action_space: Action space, one number for each character of ``action_sequence``
    :param lr_schedule: Learning rate schedule (could be constant)
    :param action_sequence: see :class:`~sb3_extensions.spatial_dqn.codec.SpatialActionCodec`
    :param codec_kwargs: further parameters of :class:`~sb3_extensions.spatial_dqn.codec.SpatialActionCodec`
    :param network_kwargs: channels and fields of the networks, see the subclass
    :param autocast: see :class:`~sb3_extensions.spatial_dqn.q_network.SpatialQNetwork`
    :param patch_scale: see :class:`~sb3_extensions.encoders.observation.SceneView`. None for the value of the
        authors' code: 300 for sequences with tilts, otherwise 1
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate. ``weight_decay`` is
        1e-5 by default for Adam (paper)
    :raises ValueError: if the action space does not match the sequence or is not bounded, or the networks do
        not match the images or the sequence
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        action_sequence: str = DEFAULT_SEQUENCE,
        codec_kwargs: dict[str, Any] | None = None,
        network_kwargs: dict[str, Any] | None = None,
        quantise: str | None = "uint8",
        standardise: Sequence[float] = (0.0, 1.0),
        autocast: str | None = None,
        image_key: str = "heightmap",
        in_hand_key: str = "in_hand",
        holding_key: str = "holding",
        patch_scale: float | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        decay = {"weight_decay": WEIGHT_DECAY} if optimizer_class is th.optim.Adam else {}
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs={**decay, **(optimizer_kwargs or {})},
            squash_output=True,  # actions are in [-1, 1], predict() returns them in the environment's units
        )
        if action_space.shape != (len(action_sequence),) or not action_space.is_bounded():
            raise ValueError(
                f"action_space must be a bounded Box of {len(action_sequence)} numbers for "
                f"action_sequence={action_sequence!r}, got {action_space}"
            )
        self.action_sequence = action_sequence
        self.codec_kwargs, self.network_kwargs = codec_kwargs or {}, network_kwargs or {}
        self.autocast = autocast
        if patch_scale is None:
            patch_scale = TILTED_PATCH_SCALE if action_sequence.count("r") == len(ANGLES) else 1.0
        self.view_kwargs: dict[str, Any] = {
            "quantise": quantise,
            "standardise": standardise,
            "image_key": image_key,
            "in_hand_key": in_hand_key,
            "holding_key": holding_key,
            "patch_scale": patch_scale,
        }
        size = SceneView(observation_space, **self.view_kwargs).size
        self.codec = SpatialActionCodec(size, action_sequence, **self.codec_kwargs)
        self.rotations = len(self.codec.grids.get("theta", [0.0]))
        """Number of yaws of the grid, 1 if actions have none."""
        self.q_net = self.make_q_net()
        self.q_net_target = self.make_q_net()
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        self.q_net_target.requires_grad_(False)
        self.q_net_target.train(False)
        self.optimizer = self.optimizer_class(
            self.q_net.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def make_q_net(self) -> SpatialQNetwork:
        """Make the Q network."""
        view = SceneView(self.observation_space, **self.view_kwargs)
        pixel_maps, levels = self.make_levels(view, **self.network_kwargs)
        network = SpatialQNetwork(self.codec, view, pixel_maps, levels, self.autocast)
        return network.to(self.device)

    def make_levels(self, view: SceneView, **kwargs: Any) -> tuple[PixelMaps, list[Level]]:
        """Make the first level and the further levels; ``kwargs`` are the ``network_kwargs``."""
        raise NotImplementedError

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """Return the greedy actions of a batch, in [-1, 1]; ``deterministic`` has no effect."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        assert isinstance(observation, dict)
        indices, _ = self.q_net.greedy(observation)
        places = self.q_net.scene_view(observation).places
        return self.codec.decode_tensor(indices, places)

    def parameters_to_vector(self) -> npt.NDArray[Any]:
        """Convert the parameters to a 1D vector. SB3's method does not support ``channels_last``."""
        vector: npt.NDArray[Any] = th.cat([p.detach().flatten() for p in self.parameters()]).cpu().numpy()
        return vector

    def load_from_vector(self, vector: npt.NDArray[Any]) -> None:
        """Load parameters from a 1D vector, as returned by :meth:`parameters_to_vector`."""
        super().load_from_vector(vector)
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def value_map(
        self, observation: dict[str, npt.NDArray[Any]]
    ) -> tuple[npt.NDArray[np.float32], tuple[int, ...]]:
        """
        Return the value of every pixel with its best yaw, (size, size), and the indices of the greedy action.

        :param observation: observation of the environment, not a batch
        """
        batch, _ = self.obs_to_tensor(observation)
        assert isinstance(batch, dict)
        with th.no_grad():
            indices, _ = self.q_net.greedy(batch)
            values = self.q_net.values(batch, indices)[0].view(-1, self.codec.size, self.codec.size)
        return values.amax(dim=0).cpu().numpy(), tuple(indices[0].tolist())

    def set_training_mode(self, mode: bool) -> None:
        """Set the training mode of the Q network; its target is always in evaluation mode."""
        self.q_net.train(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["normalize_images"]  # images are heights
        data.update(
            lr_schedule=self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            action_sequence=self.action_sequence,
            codec_kwargs=self.codec_kwargs,
            network_kwargs=self.network_kwargs,
            autocast=self.autocast,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            **self.view_kwargs,
        )
        return data


class FCNPolicy(SpatialPolicy):
    """
    Plain U-Net that values every pixel and yaw (FCN).

    Parameters of ``network_kwargs``: ``channels`` of the levels, ``in_hand_channels`` of the three
    convolutions on the in-hand image, ``output_gain`` of the last layer. See :class:`SpatialPolicy` for the
    other parameters.
    """

    maps_class: ClassVar[type[PlainPixelMaps | RotatedPixelMaps]] = PlainPixelMaps

    def make_levels(self, view: SceneView, **kwargs: Any) -> tuple[PixelMaps, list[Level]]:
        """:return: first level, no further levels"""
        return self.maps_class(view.size, view.in_hand_shape, rotations=self.rotations, **kwargs), []


class RotFCNPolicy(FCNPolicy):
    """
    Plain U-Net that values every pixel, on the heightmap rotated by each yaw (Rot FCN).

    See :class:`FCNPolicy` for the parameters.
    """

    maps_class: ClassVar[type[PlainPixelMaps | RotatedPixelMaps]] = RotatedPixelMaps


class EquivariantFCNPolicy(SpatialPolicy):
    """
    Equivariant U-Net that values every pixel and yaw (Equivariant FCN).

    The group is D_4 if actions have no yaw, otherwise C_2n for n yaws. Parameters of ``network_kwargs``:
    ``fields``, ``in_hand_channels``, ``hidden``, ``dynamic_fields``, ``output_gain`` and ``skip_kernel`` of
    :class:`~sb3_extensions.spatial_dqn.pixel_maps.EquivariantPixelMaps`.
    """

    def make_levels(self, view: SceneView, **kwargs: Any) -> tuple[PixelMaps, list[Level]]:
        """:return: first level, no further levels"""
        n_yaws = self.rotations
        group = Group("dihedral", 4) if n_yaws == 1 else Group("cyclic", 2 * n_yaws)
        return EquivariantPixelMaps(view.size, view.in_hand_shape, group, rotations=n_yaws, **kwargs), []


class ASRPolicy(SpatialPolicy):
    """
    Plain networks that choose the pixel, the yaw, and in 6D the height and the two tilts in order (ASR).

    Parameters of ``network_kwargs``: ``channels`` of the levels of the U-Net, ``in_hand_channels`` of the
    three convolutions on the in-hand image and on the patch around the pixel, and ``hidden`` units of the
    layer on the patch, and ``output_gain`` of the last layers. In 6D also ``patch_channels`` and
    ``patch_hidden`` of each level after the pixel.
    """

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        channels: Sequence[int] = CHANNELS,
        in_hand_channels: Sequence[int] = PATCH_MAP_CHANNELS,
        hidden: int = 1024,
        patch_channels: Sequence[int] = PATCH_CHANNELS,
        patch_hidden: Sequence[int] = PATCH_HIDDEN,
        output_gain: float = 1.0,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: level of the pixel, further levels"""
        images = (view.size, view.in_hand_shape)
        pixels = PlainPixelMaps(*images, channels, in_hand_channels, output_gain=output_gain)
        names, encoding = list(self.codec.grids), pixels.encoding_shape
        if names == ["theta"]:
            return pixels, [PlainRotations(self.codec, view, encoding, in_hand_channels, hidden, output_gain)]
        widths = (patch_channels, patch_hidden, output_gain)
        return pixels, [PlainLevel(self.codec, name, view, encoding, *widths) for name in names]


class EquivariantASRPolicy(SpatialPolicy):
    """
    Equivariant networks that choose the numbers of an action in order (ASR; in 6D Deictic ASR).

    The network of the pixel is equivariant to D_4, the network of n yaws to C_2n. Height and tilts are valued
    from projections around the gripper. Parameters of ``network_kwargs``:

    - ``fields``, ``dynamic_fields``, ``skip_kernel``, ``output_gain`` (of the last layers): see
      :class:`~sb3_extensions.spatial_dqn.pixel_maps.EquivariantPixelMaps`
    - ``patch_fields`` (the ``fields``), ``in_hand_channels``, ``hidden`` and ``pool_encoding``: see
      :class:`~sb3_extensions.spatial_dqn.asr_heads.EquivariantRotations`
    - ``patch_channels``, ``patch_hidden``: channels and units of the levels after the yaw (6D)
    """

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        fields: Sequence[int] = FIELDS,
        patch_fields: Sequence[int] = PATCH_FIELDS,
        in_hand_channels: Sequence[int] = IN_HAND_CHANNELS,
        hidden: Sequence[int] = HIDDEN,
        dynamic_fields: int | None = None,
        pool_encoding: bool = False,
        patch_channels: Sequence[int] = PATCH_CHANNELS,
        patch_hidden: Sequence[int] = PATCH_HIDDEN,
        output_gain: float = 1.0,
        skip_kernel: int = 3,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: level of the pixel, further levels"""
        pixel_widths = (fields, in_hand_channels, hidden[0], 1, dynamic_fields, output_gain, skip_kernel)
        pixels = EquivariantPixelMaps(view.size, view.in_hand_shape, Group("dihedral", 4), *pixel_widths)
        yaw_widths = (patch_fields, in_hand_channels, hidden, pool_encoding, output_gain)

        def make_level(name: str) -> Level:
            if name == "theta":
                return EquivariantRotations(self.codec, view, pixels.encoding_shape, *yaw_widths)
            return DeicticLevel(self.codec, name, view, patch_channels, patch_hidden, output_gain)

        return pixels, [make_level(name) for name in self.codec.grids]
