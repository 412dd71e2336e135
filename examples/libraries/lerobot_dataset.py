"""Demonstrations as a dataset of LeRobot, loaded by its own loader."""

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

from bulletarm_gym import demonstrations

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
REPO_ID, ROOT = "bulletarm/block-reaching", "block-reaching"

expert = demonstrations.collect(ENV_ID, 3, seed=0, env_kwargs={"obs_size": 64})
demonstrations.export_lerobot(expert, REPO_ID, ROOT, heightmaps=True)

next_actions = {"action": [0.0, 0.2]}  # s; at 5 frames a second the action and the one after it
dataset = LeRobotDataset(REPO_ID, root=ROOT, delta_timestamps=next_actions)
print(dataset.num_episodes, "episodes,", dataset.meta.robot_type, dataset.meta.tasks.index.tolist())
batch = next(iter(DataLoader(dataset, batch_size=dataset.num_frames)))
for name in ("observation.images.front", "observation.heightmap", "observation.state", "action"):
    print(name, *batch[name].shape[1:])
