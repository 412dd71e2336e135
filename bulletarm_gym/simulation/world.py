"""A world whose state is plain arrays.

Bullet keeps more than positions and velocities: contact caches, motor targets, the order of its bodies. Those
make two runs from equal positions differ. Here every body is loaded once, in a fixed order, and a snapshot is
taken of the untouched world. :meth:`World.begin` returns to that snapshot and lays the bodies out anew, so
what follows depends on the poses, velocities and joint positions alone, in this world or in any other built
the same way.
"""

import math
from collections.abc import Sequence
from typing import Any

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_jointed, load_plane, load_rigid, load_urdf
from bulletarm_gym.simulation.physics import REST_SPEED, Physics, surface_speed
from bulletarm_gym.simulation.properties import Properties, set_dynamics
from bulletarm_gym.simulation.shapes import ORIGIN, BodySpec
from bulletarm_gym.simulation.state import STILL, Body, Twist, WorldState

TIME_STEP = 1.0 / 240.0
"""Seconds a simulation step."""
GRAVITY = -10.0
"""Acceleration (m/s^2) along z."""
RESIDUAL_THRESHOLD = 1e-5
"""Squared change of the impulses at which the solver stops before its last iteration."""
SPHERE_GAP = 0.01
"""Gap (m) between two spheres that is enough for what they hold to be apart: the engine adds margins."""
PARKING_HEIGHT = 10.0
"""Where (m) bodies that take no part wait, far from everything, without contacts."""
PARKING_PITCH = 1.0
NEAR = 1e-3
"""Gap (m) within which a body may support another one."""

MOVING, FIXED = 1, 2
"""Collision groups: Bullet would compute contacts between fixed bodies in every step."""


class World:
    """Bodies under gravity.

    :param physics: one of :data:`~bulletarm_gym.simulation.physics.PHYSICS_MODES`
    :param gui: show PyBullet's window
    """

    def __init__(self, physics: Physics, gui: bool = False) -> None:
        self.client = Client(gui)
        self.physics = physics
        self.bodies: list[Body] = []
        self.poses: list[Pose] = []
        self.twists: list[Twist] = []
        self.active: list[bool] = []
        self.joints: list[tuple[float, ...]] = []
        self.joint_rates: list[tuple[float, ...]] = []
        self.unsettled: set[int] = set()
        self._changed: dict[int, Properties] = {}
        self._ground: Body | None = None
        self._near: dict[tuple[int, int, float], tuple[Any, bool]] = {}
        self._solids: list[Body] = []
        self._snapshot: int | None = None
        # The default broad phase reorders its trees by memory address as time goes by, and so the contacts.
        # The simple one keeps the order of loading, and for so few bodies it is as quick.
        self.client.resetSimulation(self.client.RESET_USE_SIMPLE_BROADPHASE)
        self.client.setGravity(0.0, 0.0, GRAVITY)
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=physics.solver_iterations,
            solverResidualThreshold=RESIDUAL_THRESHOLD,
            deterministicOverlappingPairs=1,
        )

    # Loading

    def add(self, spec: BodySpec, pose: Pose | None = None) -> Body:
        """Load a body; without a pose it is parked until :meth:`place` calls it in.

        :raises RuntimeError: the world has been sealed
        """
        self._check_open()
        body_id = (load_jointed if spec.parts else load_rigid)(self.client, spec, self.physics.damping)
        return self._register(Body(len(self.bodies), body_id, spec, tuple(range(len(spec.parts)))), pose)

    def add_plane(self, spec: BodySpec) -> Body:
        """Load the endless ground at z = 0; ``spec`` gives its name, friction and picture."""
        self._check_open()
        body_id = load_plane(self.client, spec)
        self._ground = self._register(Body(len(self.bodies), body_id, spec), Pose((0.0, 0.0, 0.0)))
        return self._ground

    def add_urdf(self, spec: BodySpec, xml: str, pose: Pose) -> Body:
        """Load a jointed body from its URDF, fixed to the world."""
        self._check_open()
        body_id, joints = load_urdf(self.client, spec.name, xml, pose)
        return self._register(Body(len(self.bodies), body_id, spec, joints), pose)

    def seal(self) -> None:
        """Take the snapshot every later move begins from; nothing can be loaded after it."""
        self._check_open()
        self._solids = self.solids
        self._snapshot = self.client.saveState()

    @property
    def ground(self) -> Body:
        """The endless ground, once it is loaded."""
        assert self._ground is not None, "add_plane() loads it"
        return self._ground

    @property
    def free_bodies(self) -> list[Body]:
        """Bodies that take part and can move, joints aside."""
        return [body for body in self.bodies if body.spec.mass > 0.0 and self.active[body.index]]

    @property
    def loose_bodies(self) -> list[Body]:
        """Bodies that take part and move, or have parts that do, by themselves."""
        return [body for body in self.obstacles if body.spec.mass > 0.0 or body.spec.parts]

    @property
    def solids(self) -> list[Body]:
        """All bodies, parked ones too, but the endless ground, marks on it and what moves itself."""
        return self._solids or [body for body in self.visible if not body.spec.is_mark]

    @property
    def visible(self) -> list[Body]:
        """The solids and the marks on the ground."""
        return [body for body in self.bodies if body.spec.pieces and body is not self._ground]

    @property
    def obstacles(self) -> list[Body]:
        """The solids that take part."""
        return [body for body in self.solids if self.active[body.index]]

    @property
    def has_motion(self) -> bool:
        """Return True if a body has speed in the state."""
        return any(twist != STILL for twist in self.twists) or any(any(rates) for rates in self.joint_rates)

    def _check_open(self) -> None:
        if self._snapshot is not None:
            raise RuntimeError("the world is sealed: bodies are loaded once, before the first reset")

    def _register(self, body: Body, pose: Pose | None) -> Body:
        self.bodies.append(body)
        self.poses.append(pose or _parking_place(body.index))
        self.twists.append(STILL)
        self.active.append(pose is not None)
        self.joints.append((0.0,) * len(body.joints))
        self.joint_rates.append((0.0,) * len(body.joints))
        if pose is None:
            self.park(body)
        return body

    # Layout

    def place(self, body: Body, pose: Pose, twist: Twist = STILL) -> None:
        """Put a body somewhere, calling it in if it was parked; it falls if nothing supports it."""
        self._disturb(body)
        if not self.active[body.index]:
            self._set_active(body, True)
        self.carry(body, pose, twist)
        self._disturb(body)

    def carry(self, body: Body, pose: Pose, twist: Twist = STILL) -> None:
        """Put a grasped body somewhere; the arm supports it."""
        self.poses[body.index] = pose
        self.twists[body.index] = twist
        self._send(body)

    def park(self, body: Body) -> None:
        """Take a body out of the scene: no contacts, out of sight, asleep.

        It keeps its mass: taking it would change the order in which Bullet solves contacts, and with it the
        last digits of what happens.
        """
        self._disturb(body)
        self.unsettled.discard(body.index)
        self.poses[body.index] = _parking_place(body.index)
        self.twists[body.index] = STILL
        self._set_active(body, False)
        self._send(body)

    def _disturb(self, body: Body) -> None:
        """Record that a body that takes part, and those that it may support, have to come to rest."""
        others = self.loose_bodies if self.active[body.index] else []
        self.unsettled.update(
            other.index
            for other in others
            if other.index not in self.unsettled and (other is body or self.are_near(body, other, NEAR))
        )

    def rest(self, body: Body) -> None:
        """Take a body's speed from it, and that of its parts."""
        self.twists[body.index] = STILL
        self.joint_rates[body.index] = (0.0,) * len(body.joints)

    def set_joints(self, body: Body, positions: Sequence[float]) -> None:
        """Put a body's movable joints somewhere, at rest."""
        if body.spec.parts:
            self._disturb(body)
        self.joints[body.index] = tuple(positions)
        self.joint_rates[body.index] = (0.0,) * len(body.joints)
        self._send_joints(body)

    def get_properties(self, body: Body) -> Properties:
        """Return the properties of a body that are in effect."""
        return self._changed.get(body.index) or Properties.of(body.spec)

    def set_properties(self, body: Body, properties: Properties) -> None:
        """Give a body other properties until the next reset.

        :raises ValueError: one of them is out of range
        """
        properties.check(body.spec)
        if properties == self.get_properties(body):
            return
        set_dynamics(self.client, body.id, body.spec, properties)
        self.client.changeVisualShape(body.id, -1, rgbaColor=properties.colour)
        self._changed.pop(body.index, None)
        if properties != Properties.of(body.spec):
            self._changed[body.index] = properties
        self._disturb(body)

    def reset_properties(self, changed: Sequence[tuple[int, Properties]] = ()) -> None:
        """Give some bodies properties by their index, and all others those of their specifications."""
        wanted = dict(changed)
        for index in sorted({*self._changed, *wanted}):
            body = self.bodies[index]
            self.set_properties(body, wanted.get(index) or Properties.of(body.spec))

    def show_joints(self, body: Body, positions: Sequence[float]) -> None:
        """Pose a body's joints for a query; :meth:`set_joints` or :meth:`begin` goes back to the state."""
        self.client.resetJointStatesMultiDof(body.id, body.joints, [(position,) for position in positions])

    def _set_active(self, body: Body, active: bool) -> None:
        self.active[body.index] = active
        self._set_colliding(body, active and not body.spec.is_mark)
        if body.spec.mass > 0.0:
            client = self.client
            state = client.ACTIVATION_STATE_DISABLE_SLEEPING if active else client.ACTIVATION_STATE_SLEEP
            client.changeDynamics(body.id, -1, activationState=state)

    def _send(self, body: Body) -> None:
        if body.spec.pieces:
            pose = self.poses[body.index]
            if body.spec.mass_properties[0] is not ORIGIN:
                pose = pose.compose(body.spec.mass_properties[0])
            self.client.resetBasePositionAndOrientation(body.id, pose.position, pose.orientation)
        if body.spec.mass > 0.0:
            linear, angular = self.twists[body.index]
            self.client.resetBaseVelocity(body.id, linear, angular)
        if body.joints:
            self._send_joints(body)

    def _send_joints(self, body: Body) -> None:
        self.client.resetJointStatesMultiDof(
            body.id,
            body.joints,
            [(position,) for position in self.joints[body.index]],
            [(rate,) for rate in self.joint_rates[body.index]],
        )

    # State

    def begin(self) -> None:
        """Return to the canonical world of the present state; every move starts with it."""
        self.client.restoreState(self._snapshot)
        self._forget_contacts()
        for body in self.bodies:
            if self.active[body.index] and body is not self._ground:
                self._send(body)

    def _forget_contacts(self) -> None:
        """Have Bullet forget which bodies were near each other.

        Pairs keep what convex shapes found out about their last contact, and no snapshot holds it. Setting
        its mask enters a body into the broad phase anew, its pairs gone.
        """
        for body in self.bodies:
            if self.active[body.index] and not body.spec.is_mark:
                self._set_colliding(body, True)

    def _set_colliding(self, body: Body, colliding: bool) -> None:
        """Have a body collide or not; what stands fixed does so with what moves only."""
        set_mask = self.client.setCollisionFilterGroupMask
        for link in (-1, *body.joints):
            moves = link >= 0 or body.spec.mass > 0.0
            group, mask = (MOVING, MOVING | FIXED) if moves else (FIXED, MOVING)
            set_mask(body.id, link, group * colliding, mask * colliding)

    def end(self) -> None:
        """Read the world into the state; bodies slower than :data:`REST_SPEED` are at rest."""
        for body in self.bodies:
            if body.joints:
                self._read_joints(body)
            if self.active[body.index] and body.spec.mass > 0.0:
                self._read(body)

    def _read(self, body: Body) -> None:
        position, orientation = self.client.getBasePositionAndOrientation(body.id)
        pose, principal = Pose(position, orientation), body.spec.mass_properties[0]
        self.poses[body.index] = pose if principal is ORIGIN else pose.compose(principal.inverse())
        linear, angular = self.client.getBaseVelocity(body.id)
        at_rest = surface_speed(linear, angular) < REST_SPEED
        self.twists[body.index] = STILL if at_rest else (linear, angular)

    def _read_joints(self, body: Body) -> None:
        states = self.client.getJointStates(body.id, body.joints)
        self.joints[body.index] = tuple(state[0] for state in states)
        self.joint_rates[body.index] = tuple(
            state[1] if abs(state[1]) >= REST_SPEED else 0.0 for state in states
        )

    def get_state(self) -> WorldState:
        """Return the state; it holds no reference into the world."""
        return WorldState(
            tuple(self.poses),
            tuple(self.twists),
            tuple(self.active),
            tuple(self.joints),
            tuple(self.joint_rates),
            tuple(sorted(self.unsettled)),
            tuple(sorted(self._changed.items())),
        )

    def set_state(self, state: WorldState) -> None:
        """Return to a state of this world or of another built the same way."""
        for body in self.bodies:
            if state.active[body.index] != self.active[body.index]:
                self._set_active(body, state.active[body.index])
        self.poses[:], self.twists[:] = state.poses, state.twists
        self.joints[:], self.joint_rates[:] = state.joints, state.joint_rates
        self.reset_properties(state.properties)
        self.unsettled = set(state.unsettled)
        for body in self.bodies:
            self._send(body)

    # Motion

    def step(self, count: int = 1) -> None:
        """Advance by ``count`` steps of :data:`TIME_STEP`."""
        for _ in range(count):
            self.client.stepSimulation()

    def speed(self, body: Body) -> float:
        """Return the speed (m/s) of a body or of its fastest part in the simulation right now."""
        states = self.client.getJointStates(body.id, body.joints) if body.joints else ()
        own = surface_speed(*self.client.getBaseVelocity(body.id)) if body.spec.mass > 0.0 else 0.0
        return float(max(own, *(abs(state[1]) for state in states))) if states else own

    # Queries

    def part_poses(self, body: Body) -> list[Pose]:
        """Return the poses of a body and of each of its parts, in whose frames their meshes are."""
        pose = self.poses[body.index]
        parts = zip(body.spec.parts, self.joints[body.index], strict=True) if body.spec.parts else ()
        return [pose, *(pose.compose(part.moved(position)) for part, position in parts)]

    def distance(self, first: Body, second: Body, limit: float) -> float:
        """Return the gap (m) between two bodies, negative where they overlap, infinite beyond ``limit``."""
        points = self.client.getClosestPoints(first.id, second.id, limit)
        return min((point[8] for point in points), default=math.inf)

    def are_near(self, first: Body, second: Body, limit: float) -> bool:
        """Whether the gap between two bodies that are where the state says is at most ``limit`` (m).

        The answer is kept until one of them moves.
        """
        one, two = first.index, second.index
        now = (self.poses[one], self.poses[two], self.joints[one], self.joints[two])
        known = self._near.get((one, two, limit))
        if known is None or known[0] != now:
            near = self._may_be_near(first, second, limit) and self.distance(first, second, limit) <= limit
            known = self._near[one, two, limit] = (now, near)
        return known[1]

    def _may_be_near(self, first: Body, second: Body, limit: float) -> bool:
        """Whether the spheres that hold two bodies are as near as that, without asking the engine."""
        if not (first.spec.pieces and second.spec.pieces) or first.joints or second.joints:
            return True
        apart = math.dist(self.poses[first.index].position, self.poses[second.index].position)
        return apart <= first.spec.radius + second.spec.radius + limit + SPHERE_GAP

    def bounds(self, body: Body) -> tuple[Vector, Vector]:
        """Return the lowest and the highest corner (m) of a body's bounding box."""
        low, high = self.client.getAABB(body.id)
        return low, high

    def top(self, body: Body) -> float:
        """Return the height (m) of the highest point of a body's bounding box."""
        return self.bounds(body)[1][2]

    def close(self) -> None:
        """Release the physics server."""
        self.client.close()


def _parking_place(index: int) -> Pose:
    return Pose((PARKING_PITCH * index, 0.0, PARKING_HEIGHT))
