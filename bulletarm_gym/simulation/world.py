"""A physics world whose state is plain numbers.

Bullet's own state contains contact caches and motor targets, so two runs from equal positions differ. Here
every body is loaded once, in a fixed order, and a snapshot is taken before the first step. :meth:`begin`
restores the snapshot and sets poses and velocities, which alone determine the later states.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_jointed, load_plane, load_rigid, load_urdf, set_dynamics
from bulletarm_gym.simulation.shapes import ORIGIN, BodySpec
from bulletarm_gym.simulation.state import (
    NOMINAL,
    REST_SPEED,
    STILL,
    Body,
    Contact,
    Link,
    Physics,
    Properties,
    Twist,
    WorldState,
    surface_speed,
)

TIME_STEP = 1.0 / 240.0
"""Duration of a simulation step (s)."""
GRAVITY = -10.0
"""Acceleration (m/s^2) along z."""
SPHERE_GAP = 0.01
"""Gap (m) between bounding spheres above which bodies are apart. It exceeds Bullet's collision margins."""
SPIN = 1.0
"""Angular velocity (rad/s) about the vertical above which a slow body spins on the spot."""
SPOT_SPEED = 0.1
"""Speed (m/s) of the centre of mass below which a body stays on the spot."""
PARKING_HEIGHT = 10.0
"""Height (m) of parked bodies, which are 1 m apart along x, far from all contacts."""
NEAR = 1e-3
"""Gap (m) within which a body may support another body."""
MOVING, FIXED = 1, 2
"""Collision groups, so that Bullet computes no contacts between fixed bodies."""


class World:
    """Bodies under gravity, in PyBullet's window if ``gui``."""

    def __init__(self, physics: Physics, gui: bool = False) -> None:
        self.client = Client(gui)
        self.physics = physics
        self.bodies: list[Body] = []
        self.visible: list[Body] = []
        """All bodies, parked ones too, except the ground and robots."""
        self.solids: list[Body] = []
        """The visible bodies except marks."""
        self.poses: list[Pose] = []
        self.twists: list[Twist] = []
        self.active: list[bool] = []
        self.joints: list[tuple[float, ...]] = []
        self.joint_rates: list[tuple[float, ...]] = []
        self.unsettled: set[int] = set()
        self._by_id: dict[int, Body] = {}
        self._changed: dict[int, Properties] = {}
        self._ground: Body | None = None
        self._snapshot: int | None = None
        self.optics = NOMINAL
        # The default broad phase orders contacts by memory address, the simple one in the order of loading.
        self.client.resetSimulation(self.client.RESET_USE_SIMPLE_BROADPHASE)
        self.client.setGravity(0.0, 0.0, GRAVITY)
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=physics.solver_iterations,
            solverResidualThreshold=1e-5,  # the squared change of the impulses that ends the iterations
            deterministicOverlappingPairs=1,
        )

    def add(self, spec: BodySpec, pose: Pose | None = None) -> Body:
        """Load a body. Without a pose it is parked until :meth:`place`."""
        self._check_unsealed()
        load = load_jointed if spec.parts else load_rigid
        body = self._register(load(self.client, spec, self.physics.damping), spec, pose, len(spec.parts))
        self.visible.append(body)
        if not spec.is_mark:
            self.solids.append(body)
        return body

    def add_plane(self, spec: BodySpec) -> Body:
        """Load the infinite ground at z = 0 with the name, friction and visual shape of a specification."""
        self._check_unsealed()
        self._ground = self._register(load_plane(self.client, spec), spec, ORIGIN)
        return self._ground

    def add_urdf(self, spec: BodySpec, xml: str, pose: Pose) -> Body:
        """Load a body with joints, fixed to the world, from a URDF without fixed joints."""
        self._check_unsealed()
        body_id, links = load_urdf(self.client, spec.name, xml, pose)
        return self._register(body_id, spec, pose, len(links), links)

    def seal(self) -> None:
        """Take the snapshot for :meth:`begin`. No body can be loaded afterwards."""
        self._snapshot = self.client.saveState()

    def _check_unsealed(self) -> None:
        if self._snapshot is not None:
            raise RuntimeError("the world is sealed: bodies are loaded once, before the first reset")

    def _register(
        self, body_id: int, spec: BodySpec, pose: Pose | None, joints: int = 0, links: tuple[Link, ...] = ()
    ) -> Body:
        body = Body(len(self.bodies), body_id, spec, tuple(range(joints)), links)
        self.bodies.append(body)
        self._by_id[body_id] = body
        self.poses.append(pose or Pose((float(body.index), 0.0, PARKING_HEIGHT)))
        self.twists.append(STILL)
        self.active.append(pose is not None)
        self.joints.append((0.0,) * len(body.joints))
        self.joint_rates.append((0.0,) * len(body.joints))
        if pose is None:
            self.park(body)
        return body

    @property
    def ground(self) -> Body:
        """The infinite ground, loaded by :meth:`add_plane`."""
        assert self._ground is not None, "add_plane() loads it"
        return self._ground

    @property
    def loose_bodies(self) -> list[Body]:
        """Obstacles that move without a motor, or have moving parts."""
        return [body for body in self.obstacles if body.spec.mass > 0.0 or body.spec.parts]

    @property
    def obstacles(self) -> list[Body]:
        """The active solids."""
        return [body for body in self.solids if self.active[body.index]]

    def place(self, body: Body, pose: Pose, twist: Twist = STILL) -> None:
        """Set the pose of a body and activate it. It falls if nothing supports it."""
        self._disturb(body)
        if not self.active[body.index]:
            self._set_active(body, True)
        self.carry(body, pose, twist)
        self._disturb(body)

    def carry(self, body: Body, pose: Pose, twist: Twist = STILL) -> None:
        """Set the pose of a grasped body, which the arm supports."""
        self.poses[body.index] = pose
        self.twists[body.index] = twist
        self._send(body)

    def park(self, body: Body) -> None:
        """Remove a body from the scene. It keeps its mass, which affects the order of solved contacts."""
        self._disturb(body)
        self.unsettled.discard(body.index)
        self.poses[body.index] = Pose((float(body.index), 0.0, PARKING_HEIGHT))
        self.twists[body.index] = STILL
        self._set_active(body, False)
        self._send(body)

    def _disturb(self, body: Body) -> None:
        """Mark an active body, and the bodies that it may support, as unsettled."""
        others = self.loose_bodies if self.active[body.index] else []
        self.unsettled.update(
            other.index
            for other in others
            if other.index not in self.unsettled and (other is body or self.are_near(body, other, NEAR))
        )

    def set_joints(self, body: Body, positions: Sequence[float]) -> None:
        """Set the positions (m or rad) of a body's movable joints, with velocity 0."""
        if body.spec.parts:
            self._disturb(body)
        self.joints[body.index] = tuple(positions)
        self.joint_rates[body.index] = (0.0,) * len(body.joints)
        self._send_joints(body)
        if body.spec.parts:
            self._disturb(body)

    def show_joints(self, body: Body, positions: Sequence[float]) -> None:
        """Set joint positions for a query. :meth:`set_joints` or :meth:`begin` restores the state."""
        self.client.resetJointStatesMultiDof(body.id, body.joints, [(position,) for position in positions])

    def get_properties(self, body: Body) -> Properties:
        """Return the current properties of a body."""
        return self._changed.get(body.index) or Properties.of(body.spec)

    def set_properties(self, body: Body, properties: Properties) -> None:
        """Set the properties of a body until the next reset, or raise ValueError."""
        if (body.spec.mass > 0.0) != (properties.mass > 0.0):
            must = "a positive number" if body.spec.mass > 0.0 else "0 for a fixed body"
            raise ValueError(f"mass must be {must}, got {properties.mass!r}")
        if properties == self.get_properties(body):
            return
        set_dynamics(self.client, body.id, body.spec, properties)
        self.client.changeVisualShape(body.id, -1, rgbaColor=properties.colour)
        self._changed.pop(body.index, None)
        if properties != Properties.of(body.spec):
            self._changed[body.index] = properties
        self._disturb(body)

    def reset_properties(self, changed: Sequence[tuple[int, Properties]] = ()) -> None:
        """Set the properties of some bodies by index, and of all others to their specifications."""
        wanted = dict(changed)
        for index in sorted({*self._changed, *wanted}):
            body = self.bodies[index]
            self.set_properties(body, wanted.get(index) or Properties.of(body.spec))

    def _set_active(self, body: Body, active: bool) -> None:
        self.active[body.index] = active
        self._set_colliding(body, active and not body.spec.is_mark)
        if body.spec.mass > 0.0:
            client = self.client
            state = client.ACTIVATION_STATE_DISABLE_SLEEPING if active else client.ACTIVATION_STATE_SLEEP
            client.changeDynamics(body.id, -1, activationState=state)

    def _set_colliding(self, body: Body, colliding: bool) -> None:
        """Set the collision filter of a body. Fixed bodies collide with moving bodies only."""
        set_mask = self.client.setCollisionFilterGroupMask
        for link in (-1, *body.joints):
            moves = link >= 0 or body.spec.mass > 0.0
            group, mask = (MOVING, MOVING | FIXED) if moves else (FIXED, MOVING)
            set_mask(body.id, link, group * colliding, mask * colliding)

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
        positions = [(position,) for position in self.joints[body.index]]
        rates = [(rate,) for rate in self.joint_rates[body.index]]
        self.client.resetJointStatesMultiDof(body.id, body.joints, positions, rates)

    def begin(self) -> None:
        """Restore the snapshot with the current state. Every motion starts with this call."""
        self.client.restoreState(self._snapshot)
        # Pairs of bodies keep data of their last contact, which no snapshot contains. Setting the collision
        # filter removes the pairs.
        for body in self.bodies:
            if self.active[body.index] and not body.spec.is_mark:
                self._set_colliding(body, True)
        for body in self.bodies:
            if self.active[body.index] and body is not self._ground:
                self._send(body)

    def end(self) -> None:
        """Read the simulation into the state. Velocities below :data:`REST_SPEED` become 0."""
        for body in self.bodies:
            if body.joints:
                states = self.client.getJointStates(body.id, body.joints)
                self.joints[body.index] = tuple(state[0] for state in states)
                rates = (state[1] for state in states)
                self.joint_rates[body.index] = tuple(r if abs(r) >= REST_SPEED else 0.0 for r in rates)
            if self.active[body.index] and body.spec.mass > 0.0:
                self._read(body)

    def _read(self, body: Body) -> None:
        pose = Pose(*self.client.getBasePositionAndOrientation(body.id))
        principal = body.spec.mass_properties[0]
        self.poses[body.index] = pose if principal is ORIGIN else pose.compose(principal.inverse())
        linear, angular = self.client.getBaseVelocity(body.id)
        at_rest = surface_speed(linear, angular) < REST_SPEED
        self.twists[body.index] = STILL if at_rest else (linear, angular)

    def get_state(self) -> WorldState:
        """Return a copy of the state."""
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
        """Set a state of this world or of another world with the same bodies."""
        for body in self.bodies:
            if state.active[body.index] != self.active[body.index]:
                self._set_active(body, state.active[body.index])
        self.poses[:], self.twists[:] = state.poses, state.twists
        self.joints[:], self.joint_rates[:] = state.joints, state.joint_rates
        self.reset_properties(state.properties)
        self.unsettled = set(state.unsettled)
        for body in self.bodies:
            self._send(body)

    def step(self, count: int = 1) -> None:
        """Advance the simulation by a number of steps of :data:`TIME_STEP`."""
        for _ in range(count):
            self.client.stepSimulation()

    def wrap_step(self, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Callable[[], None]:
        """Replace the function that computes a simulation step, and return a function that undoes this."""
        before = self.client.stepSimulation
        vars(self.client)["stepSimulation"] = wrap(before)
        return lambda: vars(self.client).update(stepSimulation=before)

    @property
    def has_motion(self) -> bool:
        """Whether a body or a joint has a velocity in the state."""
        return any(twist != STILL for twist in self.twists) or any(any(rates) for rates in self.joint_rates)

    def speed(self, body: Body) -> float:
        """Return the current speed (m/s) of a body or of its fastest part in the simulation."""
        states = self.client.getJointStates(body.id, body.joints) if body.joints else ()
        own = surface_speed(*self.client.getBaseVelocity(body.id)) if body.spec.mass > 0.0 else 0.0
        return float(max(own, *(abs(state[1]) for state in states))) if states else own

    def stop_spins(self, bodies: Sequence[Body]) -> bool:
        """Stop the free bodies that rotate about the vertical on the spot; return True if there is one."""
        found = False
        for body in bodies:
            linear, angular = self.client.getBaseVelocity(body.id)
            if body.spec.mass > 0.0 and abs(angular[2]) > SPIN and math.hypot(*linear) < SPOT_SPEED:
                self.client.resetBaseVelocity(body.id, *STILL)
                found = True
        return found

    def part_poses(self, body: Body) -> list[Pose]:
        """Return the poses of the meshes of a body and of its moving parts."""
        pose = self.poses[body.index]
        parts = zip(body.spec.parts, self.joints[body.index], strict=True)
        return [pose, *(pose.compose(part.moved(position)) for part, position in parts)]

    def contacts(self, body: Body, other: Body | None = None, link: int = -2) -> list[Contact]:
        """Return the contacts of a body, or of one of its links, in the last simulation step."""
        other_id = -1 if other is None else other.id
        return self._contacts(self.client.getContactPoints(body.id, other_id, link))

    def closest_points(
        self, body: Body, other: Body, limit: float = 0.0, link: int = -2, other_link: int = -2
    ) -> list[Contact]:
        """Return the closest points of two bodies whose gap is at most ``limit`` (m), as they are now."""
        return self._contacts(self.client.getClosestPoints(body.id, other.id, limit, link, other_link))

    def _contacts(self, points: Sequence[Any]) -> list[Contact]:
        bodies = self._by_id  # without bodies that were added by the client
        return [Contact(p[3], bodies[p[2]], p[7], p[8], p[9]) for p in points if p[2] in bodies]

    def distance(self, first: Body, second: Body, limit: float) -> float:
        """Return the gap (m) between two bodies, negative if they overlap, infinite beyond ``limit``."""
        points = self.client.getClosestPoints(first.id, second.id, limit)
        return min((point[8] for point in points), default=math.inf)

    def are_near(self, first: Body, second: Body, limit: float) -> bool:
        """Return True if the gap between two bodies is at most ``limit`` (m)."""
        if first.spec.pieces and second.spec.pieces and not (first.joints or second.joints):
            apart = math.dist(self.poses[first.index].position, self.poses[second.index].position)
            if apart > first.spec.radius + second.spec.radius + limit + SPHERE_GAP:
                return False
        return self.distance(first, second, limit) <= limit

    def bounds(self, body: Body, link: int = -1) -> tuple[Vector, Vector]:
        """Return the lowest and the highest corner (m) of the bounding box of a body's base or of a link."""
        low, high = self.client.getAABB(body.id, link)
        return low, high

    def top(self, body: Body) -> float:
        """Return the height (m) of the highest point of the bounding boxes of a body and its moving parts."""
        return max(self.bounds(body, link)[1][2] for link in range(-1, len(body.spec.parts)))

    def cast_rays(self, starts: Sequence[Vector], ends: Sequence[Vector]) -> list[float]:
        """Return the fraction of each line (m, world) before its first hit of a body, 1 without a hit."""
        return [hit[2] for hit in self.client.rayTestBatch(starts, ends)]

    def check_open(self) -> None:
        """Raise ClosedEnvironmentError if the world is closed."""
        self.client.check_open()

    def close(self) -> None:
        """Release the physics server."""
        self.client.close()
