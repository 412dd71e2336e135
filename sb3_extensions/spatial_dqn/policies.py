"""Policies of spatial Q algorithms: the paper's networks for its Open-Loop 2D, 3D and 6D benchmarks."""

from __future__ import annotations

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
    DeicticLevel,
    EquivariantRotations,
    Level,
    PlainLevel,
    PlainRotations,
    Widths,
)
from sb3_extensions.spatial_dqn.codec import DEFAULT_SEQUENCE, SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import (
    EquivariantPixelMaps,
    PixelMaps,
    PlainPixelMaps,
    RotatedPixelMaps,
    Shapes,
)
from sb3_extensions.spatial_dqn.q_network import SpatialQNetwork

# Channels and fields of the authors' code, for 128 x 128 pixels.
CHANNELS = (32, 64, 128, 256, 256)
FIELDS = (16, 32, 64, 128, 128)
PATCH_FIELDS = (8, 16, 32, 32, 16)
PATCH_MAP_CHANNELS = (64, 128, 256)
IN_HAND_CHANNELS = (32, 64, 128, 256)
HIDDEN = (1024, 512)


class SpatialPolicy(BasePolicy):
    """
    Greedy policy of a Q function over the grid of a
    :class:`~sb3_extensions.spatial_dqn.codec.SpatialActionCodec`, and its target network.

    A subclass makes the levels of the network.

    :param observation_space: Observation space, see :class:`~sb3_extensions.encoders.observation.SceneView`
    :param action_space: Action space, one number for each character of ``action_sequence``
    :param lr_schedule: Learning rate schedule (could be constant)
    :param action_sequence: see :class:`~sb3_extensions.spatial_dqn.codec.SpatialActionCodec`
    :param codec_kwargs: its other arguments: numbers and ranges of the grid
    :param network_kwargs: channels, fields and the like, see the policy's class
    :param quantise: see :class:`~sb3_extensions.encoders.observation.SceneView`
    :param standardise: see :class:`~sb3_extensions.encoders.observation.SceneView`
    :param autocast: see :class:`~sb3_extensions.spatial_dqn.q_network.SpatialQNetwork`
    :param channels_last: see :class:`~sb3_extensions.spatial_dqn.q_network.SpatialQNetwork`
    :param image_key: of the heightmap, as ``in_hand_key`` and ``holding_key`` see
        :class:`~sb3_extensions.encoders.observation.SceneView`
    :param in_hand_key: of the in-hand image
    :param holding_key: of whether the gripper holds something
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate
    :raises ValueError: if the action space is not of the sequence or has no ranges, or the networks do not
        fit the images or the sequence
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
        channels_last: bool = True,
        image_key: str = "heightmap",
        in_hand_key: str = "in_hand",
        holding_key: str = "holding",
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,  # actions are in [-1, 1], predict() gives them in the environment's units
        )
        if action_space.shape != (len(action_sequence),):
            raise ValueError(
                f"action_sequence={action_sequence!r} names {len(action_sequence)} numbers, "
                f"the action space is {action_space}"
            )
        if not action_space.is_bounded():
            raise ValueError(f"a grid needs an action space with finite ranges, got {action_space}")
        self.action_sequence = action_sequence
        self.codec_kwargs, self.network_kwargs = codec_kwargs or {}, network_kwargs or {}
        self.quantise, self.standardise = quantise, standardise
        self.autocast, self.channels_last = autocast, channels_last
        self.keys = {"image_key": image_key, "in_hand_key": in_hand_key, "holding_key": holding_key}
        view = self._make_view()
        self.codec = SpatialActionCodec(view.size, action_sequence, **self.codec_kwargs)
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

    def _make_view(self) -> SceneView:
        return SceneView(self.observation_space, self.quantise, self.standardise, **self.keys)

    def make_q_net(self) -> SpatialQNetwork:
        """Make the Q network."""
        view = self._make_view()
        pixel_maps, levels = self.make_levels(
            view, Shapes(view.size, view.in_hand_shape), **self.network_kwargs
        )
        network = SpatialQNetwork(self.codec, view, pixel_maps, levels, self.autocast, self.channels_last)
        return network.to(self.device)

    def make_levels(self, view: SceneView, shapes: Shapes, **kwargs: Any) -> tuple[PixelMaps, list[Level]]:
        """
        Make the networks.

        :param view: what they see
        :param shapes: of the images
        :param kwargs: ``network_kwargs`` of the constructor
        :return: the first level, and those that follow
        """
        raise NotImplementedError

    @property
    def rotations(self) -> int:
        """Number of yaws of the grid, 1 where actions have none."""
        return len(self.codec.grids.get("theta", [0.0]))

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """
        Greedy actions.

        :param obs: a batch
        :param deterministic: exploration is the algorithm's: without effect
        :return: in [-1, 1], (batch, numbers)
        """
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        assert isinstance(observation, dict)
        indices, _ = self.q_net.greedy(observation)
        places = self.q_net.scene_view(observation).places
        return self.codec.decode_tensor(indices, places)

    def parameters_to_vector(self) -> npt.NDArray[Any]:
        """
        Convert the parameters to a 1D vector.

        Unlike SB3's method it works for any memory layout, such as ``channels_last``.
        """
        flat = [parameter.detach().reshape(-1) for parameter in self.parameters()]
        vector: npt.NDArray[Any] = th.cat(flat).cpu().numpy()
        return vector

    @th.no_grad()
    def load_from_vector(self, vector: npt.NDArray[Any]) -> None:
        """
        Load parameters from a 1D vector.

        :param vector: as returned by :meth:`parameters_to_vector`
        """
        sizes = [parameter.numel() for parameter in self.parameters()]
        parts = th.as_tensor(vector, dtype=th.float32, device=self.device).split(sizes)
        for parameter, part in zip(self.parameters(), parts, strict=True):
            parameter.copy_(part.view(parameter.shape))

    def value_map(
        self, observation: dict[str, npt.NDArray[Any]]
    ) -> tuple[npt.NDArray[np.float32], tuple[int, ...]]:
        """
        What the agent thinks of the places in one observation, for a picture.

        :param observation: of the environment, not a batch
        :return: value of every pixel with its best yaw, (size, size), and the indices of the greedy action
        """
        batch, _ = self.obs_to_tensor(observation)
        assert isinstance(batch, dict)
        with th.no_grad():
            values = self.q_net.maps(batch)[0].amax(dim=0)
            indices, _ = self.q_net.greedy(batch)
        return values.cpu().numpy(), tuple(indices[0].tolist())

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the policy in either training or evaluation mode.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        self.q_net.train(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["normalize_images"]  # what is seen are heights
        data.update(
            lr_schedule=self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            action_sequence=self.action_sequence,
            codec_kwargs=self.codec_kwargs,
            network_kwargs=self.network_kwargs,
            quantise=self.quantise,
            standardise=self.standardise,
            autocast=self.autocast,
            channels_last=self.channels_last,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            **self.keys,
        )
        return data


class FCNPolicy(SpatialPolicy):
    """
    One plain U-Net that values every pixel and yaw (FCN).

    ``network_kwargs``: ``channels`` of its levels, ``in_hand_channels`` of the three convolutions on the
    in-hand image. All other arguments see :class:`SpatialPolicy`.
    """

    maps_class: ClassVar[type[PlainPixelMaps | RotatedPixelMaps]] = PlainPixelMaps

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        shapes: Shapes,
        channels: Sequence[int] = CHANNELS,
        in_hand_channels: Sequence[int] = PATCH_MAP_CHANNELS,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: the only level"""
        return self.maps_class(shapes, channels, in_hand_channels, self.rotations), []


class RotFCNPolicy(FCNPolicy):
    """
    One plain U-Net that values every pixel, on the heightmap turned by each yaw (Rot FCN).

    ``network_kwargs`` as those of :class:`FCNPolicy`.
    """

    maps_class: ClassVar[type[PlainPixelMaps | RotatedPixelMaps]] = RotatedPixelMaps


class EquivariantFCNPolicy(SpatialPolicy):
    """
    One equivariant U-Net that values every pixel and yaw (Equivariant FCN): of the dihedral group of four
    rotations where actions have no yaw, of the cyclic group of twice as many rotations as there are yaws.

    ``network_kwargs``: regular ``fields`` of its levels, ``in_hand_channels`` of the convolutions on the
    in-hand image, ``hidden`` units of the linear layer behind them, ``dynamic_fields`` see
    :class:`~sb3_extensions.spatial_dqn.pixel_maps.EquivariantPixelMaps`.
    """

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        shapes: Shapes,
        fields: Sequence[int] = FIELDS,
        in_hand_channels: Sequence[int] = IN_HAND_CHANNELS,
        hidden: int = HIDDEN[0],
        dynamic_fields: int | None = None,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: the only level"""
        rotations = self.rotations
        group = Group("dihedral", 4) if rotations == 1 else Group("cyclic", 2 * rotations)
        return EquivariantPixelMaps(
            shapes, group, fields, in_hand_channels, hidden, rotations, dynamic_fields
        ), []


class ASRPolicy(SpatialPolicy):
    """
    Plain networks that choose one after the other (ASR): the pixel, the yaw, and in 6D the height and the two
    tilts.

    ``network_kwargs``: ``channels`` of the U-Net's levels, ``in_hand_channels`` of the three convolutions on
    the in-hand image and on the patch around the pixel, ``hidden`` units of the layer behind them; in 6D
    ``patch_channels`` and ``patch_hidden`` of each level behind the pixel.
    """

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        shapes: Shapes,
        channels: Sequence[int] = CHANNELS,
        in_hand_channels: Sequence[int] = PATCH_MAP_CHANNELS,
        hidden: int = HIDDEN[0],
        patch_channels: Sequence[int] = Widths().channels,
        patch_hidden: Sequence[int] = Widths().hidden,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: the level of the pixel, and those that follow"""
        pixels = PlainPixelMaps(shapes, channels, in_hand_channels)
        names = list(self.codec.grids)
        if names == ["theta"]:
            encoding = pixels.encoding_shape
            return pixels, [PlainRotations(self.codec, shapes, encoding, in_hand_channels, hidden)]
        widths = Widths(tuple(patch_channels), tuple(patch_hidden))
        return pixels, [
            PlainLevel(self.codec, name, shapes, pixels.encoding_shape, widths, view) for name in names
        ]


class EquivariantASRPolicy(SpatialPolicy):
    """
    Equivariant networks that choose one after the other: the pixel by one of the dihedral group of four
    rotations, the yaw by one of the cyclic group of twice as many rotations as there are yaws (Equivariant
    ASR); in 6D the height and the tilts by what would be around the gripper (Equivariant Deictic ASR).

    ``network_kwargs``: the symmetry of the first level (``group``, ``n``), ``fields`` of the U-Net's levels,
    ``patch_fields`` of the convolutions on the patch around the pixel, ``in_hand_channels`` of those on the
    in-hand image, ``hidden`` units of the two linear layers behind them, ``dynamic_fields`` see
    :class:`~sb3_extensions.spatial_dqn.pixel_maps.EquivariantPixelMaps`, ``pool_encoding`` see
    :class:`~sb3_extensions.spatial_dqn.asr_heads.EquivariantRotations`; in 6D ``patch_channels`` and
    ``patch_hidden`` of the levels behind the yaw.
    """

    def make_levels(  # type: ignore[override]
        self,
        view: SceneView,
        shapes: Shapes,
        group: str = "dihedral",
        n: int = 4,
        fields: Sequence[int] = FIELDS,
        patch_fields: Sequence[int] = PATCH_FIELDS,
        in_hand_channels: Sequence[int] = IN_HAND_CHANNELS,
        hidden: Sequence[int] = HIDDEN,
        dynamic_fields: int | None = None,
        pool_encoding: bool = False,
        patch_channels: Sequence[int] = Widths().channels,
        patch_hidden: Sequence[int] = Widths().hidden,
    ) -> tuple[PixelMaps, list[Level]]:
        """:return: the level of the pixel, and those that follow"""
        pixels = EquivariantPixelMaps(
            shapes, Group(group, n), fields, in_hand_channels, hidden[0], dynamic_fields=dynamic_fields
        )
        widths = Widths(tuple(patch_channels), tuple(patch_hidden))

        def make_level(name: str) -> Level:
            if name != "theta":
                return DeicticLevel(self.codec, name, shapes, widths, view)
            encoding, conditioned = pixels.encoding_shape, (in_hand_channels, hidden, pool_encoding)
            return EquivariantRotations(self.codec, shapes, encoding, patch_fields, *conditioned)

        return pixels, [make_level(name) for name in self.codec.grids]
