"""What keeps the fingers of a parallel gripper together, and what they hold in place."""

from collections.abc import Sequence

from bulletarm_gym.simulation import Body, World

GEAR_FORCE = 200.0
"""Force (N) that keeps the fingers' motions equal; well above the grip."""
SPINNING_FRICTION = 0.1
"""Of the pads, against turning about a contact's normal; as in the Panda's model in pybullet_data."""


def couple_fingers(world: World, arm: Body, joints: Sequence[int], friction: float) -> None:
    """Make two fingers mirror each other, as the spindle of a real gripper does, and their pads stick.

    Friction alone matches velocities only: on a curved path what is held falls behind by some hundredths
    of a millimetre a step. Friction anchors bring the points of contact back together, and spinning
    friction keeps what is held from pivoting about the line between the pads.

    :param joints: the fingers', indices in Bullet
    :param friction: lateral friction of the pads
    """
    client, (left, right) = world.client, joints
    for joint in (left, right):
        client.changeDynamics(
            arm.id, joint, lateralFriction=friction, spinningFriction=SPINNING_FRICTION, frictionAnchor=1
        )
    gear = client.createConstraint(
        arm.id, left, arm.id, right, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
    )
    client.changeConstraint(gear, gearRatio=-1, erp=0.2, maxForce=GEAR_FORCE)
