"""Tutorial 1: make an environment, print its spaces, solve it with its expert and restore a state."""

import gymnasium
import imageio.v3 as imageio

import bulletarm_gym  # noqa: F401 (registers the environments)

env = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", obs_size=64, render_mode="rgb_array")
print("observation:", env.observation_space)
print("action:", env.action_space, env.unwrapped.action_sequence)

# The same seed gives the same episode, also in another process.
observation, info = env.reset(seed=0)
imageio.imwrite("reset.png", env.unwrapped.viewer.close_up(320))

# An action in metres and radians: 3 cm up with an open gripper.
move = env.unwrapped.decode_action([1.0, 0.0, 0.0, 0.6, 0.0])
print(move)
env.step(env.unwrapped.encode_action(move))

# The expert plans from the current state, also after other actions.
steps, over = 1, False
while not over:
    observation, reward, terminated, truncated, info = env.step(env.unwrapped.expert_action())
    steps, over = steps + 1, terminated or truncated
imageio.imwrite("solved.png", env.render())
print(f"{steps} steps, reward {reward}, {info}")

# A state can be saved and restored exactly.
env.reset(seed=1)
state = env.unwrapped.get_state()
first = env.step(env.unwrapped.expert_action())[0]
env.unwrapped.set_state(state)
again = env.step(env.unwrapped.expert_action())[0]
print("equal after set_state():", bool((first["heightmap"] == again["heightmap"]).all()))
env.close()
