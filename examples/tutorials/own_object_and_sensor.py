"""Tutorial 5: grasp the object of my_objects.py, and observe it with the sensor of my_sensors.py."""

import gymnasium
import imageio.v3 as imageio
import my_objects
import my_sensors

hammer = my_objects.hammer("hammer", 0.8)
print(f"a {hammer.name} of {hammer.mass} kg, {100 * hammer.extents[1]:.1f} cm long")

env = gymnasium.make(
    "BulletArm/CloseLoopObjectGrasping-v0",
    obs_size=64,
    object_set=["hammer", "hammer", "cube"],
    num_objects=3,
    object_scale_range=0.8,
    observation=["heightmap", "rangefinder", "holding"],
)
print(my_sensors.Rangefinder.__name__, env.observation_space["rangefinder"])
observation, _ = env.reset(seed=0)
imageio.imwrite("hammers.png", env.unwrapped.viewer.close_up(320))

# The distance decreases while the fingers move down, and changes abruptly when they close on the object.
steps, over = 0, False
while not over:
    left, right = 100 * observation["rangefinder"]
    print(f"step {steps}: {left:.1f} and {right:.1f} cm under the fingertips")
    observation, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
    steps, over = steps + 1, terminated or truncated
print(f"{'lifted something' if info['is_success'] else 'failed'} in {steps} steps")
env.close()
