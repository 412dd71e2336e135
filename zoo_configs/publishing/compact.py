"""Small model files that ``load()`` of the algorithm reads."""

import copy
import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import save_to_zip_file
from torch import nn

from zoo_configs.files import whole_file

ACTOR, AVERAGE = "actor", "actor_average"  # submodules of an SACfDPolicy
SMALLER = {th.float16: "float16", th.bfloat16: "bfloat16"}
BLANKS: dict[str, Any] = {
    "_last_obs": None,
    "_last_original_obs": None,
    "_last_episode_starts": None,
    "ep_info_buffer": None,
    "ep_success_buffer": None,
    "action_noise": None,
    "tensorboard_log": None,
    "expert_data": None,
    "start_time": 0,
    "verbose": 0,
}
"""Values that replace the state of the training and paths of its machine."""
CONSTANTS = ("learning_rate", "clip_range")
"""Schedules that are stored by their first value, because a function can contain paths of the machine."""
SCHEDULES = ("lr_schedule", "exploration_schedule")  # created by load()
TARGETS = {"critic_target": "critic", "q_net_target": "q_net", "actor_target": "actor"}
"""Target networks, stored as the networks that they follow."""
STEPS = 8
"""Steps in the root mean square of a rounded weight. They halve the file, which LZMA compresses."""


def save_compact(model: BaseAlgorithm, path: Path, half: bool = True) -> str:
    """
    Write a model without the states of its optimizers. The loaded model acts and can be trained further.

    Target networks are stored as the networks that they follow, an actor with an average as its average.

    :param half: Whether to round weights and store them in bfloat16, if the network computes in it, or
        else in float16
    :return: Data type of the stored weights
    """
    params = model.get_parameters()
    for name, state in params.items():
        if set(state) == {"state", "param_groups"}:  # an optimizer, as before its first step
            params[name] = {**state, "state": {}}
    params["policy"] = weights = stored_weights(model.policy, half)
    names, variables = model._get_torch_save_params()
    left_out = {*model._excluded_save_params(), *names, *variables, *SCHEDULES}
    roots = {name.partition(".")[0] for name in left_out}
    data = {name: value for name, value in vars(model).items() if name not in roots}
    data.update({name: value for name, value in BLANKS.items() if name in data})
    data.update({name: float(data[name](1.0)) for name in CONSTANTS if callable(data.get(name))})
    data.update({name: _unseeded(data[name]) for name in ("observation_space", "action_space")})
    if not type(model).__module__.startswith("sb3_extensions.") and "buffer_size" in data:
        data["buffer_size"] = 1  # our buffers allocate no memory before the first transition
    file = io.BytesIO()
    save_to_zip_file(file, data, params, {name: getattr(model, name) for name in variables})
    _pack(file, path)
    return ", ".join(sorted({SMALLER[t.dtype] for t in weights.values() if t.dtype in SMALLER})) or "float32"


def stored_weights(policy: nn.Module, half: bool) -> dict[str, th.Tensor]:
    """
    Return the parameters and buffers of a policy under all their names.

    Shared parameters and target networks share their storage. With ``half``, tensors of two and more
    dimensions are rounded to multiples of at most 1 / ``STEPS`` of their root mean square, in a smaller type.
    """
    state = _with_average(policy)
    computed_in_bf16 = {id(weight) for weight in _bf16_weights(policy)}
    known: dict[int, th.Tensor] = {}
    for tensor in state.values():
        dtype = th.bfloat16 if id(tensor) in computed_in_bf16 else th.float16
        if id(tensor) not in known:
            known[id(tensor)] = _shrunk(tensor.detach(), dtype, half)
    return {name: known[id(tensor)] for name, tensor in state.items()}


def _with_average(policy: nn.Module) -> dict[str, th.Tensor]:
    """Return the state of a policy with the average for the actor, and online for target networks."""
    state: dict[str, th.Tensor] = policy.state_dict(keep_vars=True)
    for target, online in TARGETS.items():
        names = [name for name in state if name.startswith(f"{target}.")]
        state.update({name: state[online + name.removeprefix(target)] for name in names})
    if getattr(policy, AVERAGE, None) is None:
        return state
    own, averaged = (
        policy.get_submodule(name).state_dict(keep_vars=True).values()
        for name in (ACTOR, f"{AVERAGE}.module")
    )
    in_its_place = {id(tensor): other for tensor, other in zip(own, averaged, strict=True)}
    return {name: in_its_place.get(id(tensor), tensor) for name, tensor in state.items()}


def _bf16_weights(policy: nn.Module) -> Iterator[th.Tensor]:
    """Yield weights that are rounded to bfloat16 whenever they are used."""
    for part in policy.modules():
        if getattr(part, "autocast", None) == "bf16":
            yield from (m.weight for m in part.modules() if isinstance(m, nn.Linear | nn.Conv2d))


def _shrunk(tensor: th.Tensor, dtype: th.dtype, half: bool) -> th.Tensor:
    """Return a tensor in a smaller type, unchanged if it is a vector or its values do not fit."""
    if not half or not tensor.is_floating_point() or tensor.ndim < 2:
        return tensor
    scale = tensor.square().mean().sqrt().clamp(min=th.finfo(tensor.dtype).tiny)
    step = th.exp2(th.floor(th.log2(scale / STEPS)))
    smaller = (th.round(tensor / step) * step).to(dtype)
    return smaller if smaller.isfinite().all() else tensor


def _unseeded(space: Any) -> Any:
    """Return a copy without a random generator, which other versions of NumPy may not read."""
    fresh = copy.deepcopy(space)
    fresh._np_random = None
    for part in getattr(fresh, "spaces", {}).values():
        part._np_random = None
    return fresh


def _pack(stored: io.BytesIO, path: Path) -> None:
    """Write the archive compressed and without times, so that equal agents give equal files."""
    with (
        zipfile.ZipFile(stored) as source,
        whole_file(path) as partial,
        zipfile.ZipFile(partial, "w") as target,
    ):
        for name in source.namelist():
            target.writestr(zipfile.ZipInfo(name), source.read(name), zipfile.ZIP_LZMA)
