#!/usr/bin/env bash
# RLlib 2.60.0: EpisodeReplayBuffer forgets the termination of n-step windows that are shorter than n.
# A window that begins less than n steps before the end has terminated=False and the terminal observation, so that a
# target adds its value, discounted by n steps. PrioritizedEpisodeReplayBuffer samples no such windows.
# Seen for an episode of 4 steps and n_step=3: terminated for the start 1, but not for the starts 2 and 3.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    "ray[rllib]==2.60.0" torch==2.13.0 gymnasium==1.2.2 numpy==2.4.6
"$folder/venv/bin/python" - 2> "$folder/log" <<'PYTHON' || { cat "$folder/log"; exit 1; }
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.replay_buffers import EpisodeReplayBuffer, PrioritizedEpisodeReplayBuffer

seen = {}
for cls, arguments in ((EpisodeReplayBuffer, {"sample_episodes": True}), (PrioritizedEpisodeReplayBuffer, {})):
    episode = SingleAgentEpisode(
        observations=[0, 1, 2, 3, 4],
        actions=[0] * 4,
        rewards=[0.0, 0.0, 0.0, 1.0],
        terminated=True,
        len_lookback_buffer=0,
    )
    buffer = cls(capacity=10)
    buffer.add([episode])
    samples = buffer.sample(num_items=200, n_step=3, gamma=0.9, **arguments)
    windows = {(*(int(o) for o in sample.get_observations()), sample.is_terminated) for sample in samples}
    print(cls.__name__, "first and last observation, terminated:", *sorted(windows))
    seen[cls] = {first: terminated for first, _, terminated in windows}
assert seen[EpisodeReplayBuffer] == {0: False, 1: True, 2: False, 3: False}
assert seen[PrioritizedEpisodeReplayBuffer] == {0: False, 1: True}
PYTHON
