"""Spatial Q algorithms small enough for tests."""

import pytest
import torch as th

from sb3_extensions.spatial_dqn import SDQfD, SpatialDQN

PLAIN = {"channels": [4, 8, 8], "in_hand_channels": [4, 4, 8], "output_gain": 0.01}
EQUIVARIANT = {"fields": [4, 4, 6], "in_hand_channels": [4, 4, 8, 8], "output_gain": 0.01}
PATCHES = {"patch_channels": [4, 4, 8, 8], "patch_hidden": [16, 8]}
NETWORKS = {
    "FCNPolicy": PLAIN,
    "RotFCNPolicy": PLAIN,
    "EquivariantFCNPolicy": {**EQUIVARIANT, "hidden": 16},
    "ASRPolicy": {**PLAIN, **PATCHES, "hidden": 16},
    "EquivariantASRPolicy": {**EQUIVARIANT, **PATCHES, "hidden": [16, 16], "patch_fields": [4, 4, 8, 4]},
}
# The paper's networks for its three action spaces
CASES = [
    *[(name, "pxyr") for name in NETWORKS],
    *[(name, "pxy") for name in ("FCNPolicy", "EquivariantFCNPolicy")],
    *[(name, "pxyzrrr") for name in ("ASRPolicy", "EquivariantASRPolicy")],
]


@pytest.fixture(params=CASES, ids="-".join)
def case(request):
    """A policy and an action sequence that fits."""
    return request.param


def small_kwargs(name, sequence, kwargs):
    """Return the arguments of a small policy."""
    grid = {"num_rotations": 4, "num_heights": 4, "num_tilts": 3}
    own = {"action_sequence": sequence, "codec_kwargs": grid, "network_kwargs": NETWORKS[name]}
    return {**own, "standardise": (0.0, 0.03), "patch_scale": 1.0, **(kwargs or {})}


@pytest.fixture
def make_policy(make_picking):
    """Makes a policy: ``make_policy(name, sequence, env, network_kwargs, **kwargs)``."""

    def make(name, sequence="pxyr", env=None, network_kwargs=None, **kwargs):
        th.manual_seed(0)
        env = make_picking(action_sequence=sequence) if env is None else env
        spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
        networks = {"network_kwargs": {**NETWORKS[name], **(network_kwargs or {})}}
        arguments = small_kwargs(name, sequence, {**spaces, **networks, **kwargs})
        return SpatialDQN.policy_aliases[name](lr_schedule=lambda _: 1e-3, **arguments)

    return make


@pytest.fixture
def policy(case, make_policy):
    """Small policy of each case."""
    return make_policy(*case)


@pytest.fixture
def scenes(case):
    """Twenty observations of blocks; every other gripper holds something."""
    generator = th.Generator().manual_seed(0)
    heightmap = 0.1 * th.rand(20, 1, 32, 32, generator=generator)
    heightmap[:, :, 6:26, 6:26] += 0.05
    in_hand = 0.1 * th.rand(20, 3 if "rrr" in case[1] else 1, 12, 12, generator=generator)
    holding = (th.arange(20) % 2).float()[:, None]
    return {"heightmap": heightmap, "in_hand": in_hand, "holding": holding}


@pytest.fixture
def make_model(make_picking):
    """Makes an algorithm: ``make_model(case, algorithm, env, policy_kwargs, **kwargs)``."""

    def make(case=("ASRPolicy", "pxyr"), algorithm=SDQfD, env=None, policy_kwargs=None, **kwargs):
        policy, sequence = case
        kwargs = {"expert_episodes": 3, "batch_size": 4, "buffer_size": 200, "seed": 0, **kwargs}
        env = make_picking(action_sequence=sequence, size=24) if env is None else env
        kwargs["policy_kwargs"] = small_kwargs(policy, sequence, policy_kwargs)
        return algorithm(policy, env, device="cpu", **kwargs)

    return make
