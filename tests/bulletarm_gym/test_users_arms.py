"""Arms of users: each model is simulated as its file says, or refused with the reason."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.config import ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, conjugate, euler_pose, multiply
from bulletarm_gym.robots import (
    KUKA,
    PANDA,
    ROBOTS,
    Gripper,
    ParallelJaw,
    RobotModel,
    attach,
    on_slides,
    without,
)
from bulletarm_gym.robots.editing import merge_fixed
from bulletarm_gym.robots.primitives import LIGHT, add_link, box
from bulletarm_gym.robots.structure import prepare
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_urdf
from bulletarm_gym.simulation.urdf import add_joint, find_joint

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
ORIGIN = Pose((0.0, 0.0, 0.0))
FINGERS = ("left_finger_joint", "right_finger_joint")
PART = box((0.05, 0.05, 0.05), (0.0, 0.0, 0.0), LIGHT)


def angle(one: Pose, other: Pose) -> float:
    x, y, z, w = multiply(one.orientation, conjugate(other.orientation))
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def changed_kuka(change: Callable[[Element], None], **changes: object) -> RobotModel:
    """The KUKA with a change of its URDF."""

    def load() -> Element:
        root = KUKA.load()
        change(root)
        return root

    return replace(KUKA, load=load, **changes)  # type: ignore[arg-type]


# Kinematics


def random_arm(rng: np.random.Generator) -> tuple[Element, tuple[str, ...]]:
    """A chain of random joints, of which some are fixed, prismatic or not named, and two fingers.

    The last joint is revolute and named, so that the fingers open along the x axis of its link.
    """
    root, named, parent = Element("robot", name="random"), [], "base"
    add_link(root, parent, 1.0, [PART])
    for number in range(10):
        is_last = number == 9
        kind = str(rng.choice(["revolute", "continuous", "prismatic", "fixed", "revolute"]))
        kind = "revolute" if is_last else kind
        child, name = f"link{number}", f"joint{number}"
        if rng.random() < 0.3 and kind == "fixed":
            SubElement(root, "link", name=child)
        else:
            add_link(root, child, 0.5, [PART])
        origin = euler_pose(
            tuple(rng.uniform(-0.2, 0.2, 3).tolist()), tuple(rng.uniform(-3.0, 3.0, 3).tolist())
        )
        axis = rng.normal(size=3) * rng.uniform(0.2, 3.0)
        joint = add_joint(root, kind, name, (parent, child), origin, tuple(axis.tolist()))
        lower = float(rng.choice([-1.0, 0.2]))
        SubElement(joint, "limit", lower=str(lower), upper="1.5", effort="10", velocity="1")
        if is_last or (kind in ("revolute", "continuous") and rng.random() < 0.8):
            named.append(name)
        parent = child
    for name, side in zip(FINGERS, (1.0, -1.0), strict=True):
        add_link(root, name.removesuffix("_joint"), 0.05, [PART])
        finger = add_joint(
            root, "prismatic", name, (parent, name.removesuffix("_joint")), ORIGIN, (side, 0.0, 0.0)
        )
        SubElement(finger, "limit", lower="0", upper="0.05", effort="10", velocity="1")
    return root, tuple(named)


@pytest.mark.parametrize("seed", range(20))
def test_forward_kinematics_equals_the_pose_of_the_link_in_bullet(seed: int) -> None:
    """Joints of all types with axes of any length and direction; those that are not named stay in place."""
    rng = np.random.default_rng(seed)
    root, names = random_arm(rng)
    for name in names:
        find_joint(root, name).findall("limit")[0].set("lower", "-1.0")
    tool = Pose((0.03, -0.02, 0.1))
    base = euler_pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.4))
    # A copy of the file, as Bullet reads it: held joints at 0 or at their nearest limit.
    unit = ElementTree.fromstring(ElementTree.tostring(root))
    for axis in unit.iter("axis"):
        values = np.array([float(part) for part in axis.get("xyz", "").split()])
        axis.set("xyz", " ".join(map(str, (values / np.linalg.norm(values)).tolist())))
    model = RobotModel("random", lambda: root, names, tool, _gripper(), base, (0.0,) * len(names), 10.0)
    client = Client()
    ElementTree.indent(unit)
    body, _ = load_urdf(client, "file", ElementTree.tostring(unit, encoding="unicode"), base)
    positions = dict(zip(names, rng.uniform(-0.9, 1.4, len(names)).tolist(), strict=True))
    for joint in range(client.getNumJoints(body)):
        info = client.getJointInfo(body, joint)
        kind, name = info[2], info[1].decode()
        held = max(0.0, info[8]) if find_joint(unit, name).get("type") != "continuous" else 0.0
        if kind != client.JOINT_FIXED:
            client.resetJointState(body, joint, positions.get(name, held))
    ours = model.chain.forward(np.array([positions[name] for name in names]))
    # The tool is in the link of the last named joint, with what is fixed to it.
    state = client.getLinkState(body, _index(client, body, names[-1]), computeForwardKinematics=True)
    simulated = Pose(state[4], state[5]).compose(tool)
    assert math.dist(ours.position, simulated.position) < 1e-6
    assert angle(ours, simulated) < 1e-6
    client.close()


def _index(client: Client, body: int, name: str) -> int:
    names = [client.getJointInfo(body, joint)[1].decode() for joint in range(client.getNumJoints(body))]
    return names.index(name)


def _gripper() -> Gripper:
    return Gripper(stroke=0.1, finger=(0.01, 0.02, 0.05), joints=FINGERS)


def lifted(root: Element, kind: str = "prismatic", lower: str = "0.2") -> None:
    """Put an arm on a torso, as mobile manipulators have it."""
    first = find_joint(root, "lbr_iiwa_joint_1")
    parent = first.findall("parent")[0]
    base = parent.get("link", "")
    add_link(root, "torso", 5.0, [PART])
    torso = add_joint(root, kind, "torso_joint", (base, "torso"), ORIGIN, (0.0, 0.0, 2.0))
    SubElement(torso, "limit", lower=lower, upper="0.4", effort="1000", velocity="1")
    parent.set("link", "torso")


def test_a_joint_below_the_arm_that_is_not_named_is_fixed() -> None:
    model = changed_kuka(lifted, base=Pose((-0.14, 0.0, 0.0)))
    assert model.chain.translations[0] == pytest.approx(
        (-0.14, 0.0, KUKA.chain.translations[0][2] - 0.1 + 0.2)
    )
    env = gymnasium.make(PICKING, robot=model).unwrapped
    assert isinstance(env, ManipulationEnv)
    env.reset(seed=0)
    world, robot = env.scene.world, env.scene.robot
    link = _index(world.client, robot.body.id, model.joints[-1])
    for x in (0.4, 0.5):
        robot.move_to(Pose.planar(x, 0.1, 0.2, 0.3))
        state = world.client.getLinkState(robot.body.id, link, computeForwardKinematics=True)
        simulated = Pose(state[4], state[5]).compose(model.tool)
        assert math.dist(simulated.position, robot.pose.position) < 1e-4
    assert world.client.getNumJoints(robot.body.id) == 9


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "continuous", "floating", "planar"])
def test_other_joints_than_the_arms_are_fixed(kind: str) -> None:
    def add_arm(root: Element) -> None:
        add_link(root, "other", 3.0, [PART])
        joint = add_joint(root, kind, "other_joint", ("lbr_iiwa_link_0", "other"), ORIGIN, (0.0, 1.0, 0.0))
        SubElement(joint, "limit", lower="-1", upper="1", effort="10", velocity="1")

    root = changed_kuka(add_arm).urdf
    assert {joint.get("name") for joint in root.findall("joint")} == {*KUKA.joints, *KUKA.gripper.joints}


def test_the_plinth_carries_the_root_link() -> None:
    def reorder(root: Element) -> None:
        link = root.findall("link")[0]
        root.remove(link)
        root.append(link)

    root = changed_kuka(reorder).urdf
    tops = [
        link.get("name") for link in root.findall("link") if link.find("visual/geometry/cylinder") is not None
    ]
    assert tops == ["lbr_iiwa_link_0"]


@pytest.mark.parametrize(
    ("joints", "reason"),
    [
        (KUKA.joints[::-1], "must be a chain from the base to the gripper, got 'lbr_iiwa_joint_7'"),
        (
            (*KUKA.joints[:3], *KUKA.joints[4:2:-1], *KUKA.joints[5:]),
            "must be a chain .* got 'lbr_iiwa_joint_5'",
        ),
        (
            (*KUKA.joints[:-1], "left_finger_joint"),
            "joints must be revolute .* prismatic joint 'left_finger_joint'",
        ),
        ((*KUKA.joints, "nothing"), "no joint 'nothing'"),
    ],
)
def test_joints_that_are_not_a_chain_are_refused(joints: tuple[str, ...], reason: str) -> None:
    with pytest.raises(ValueError, match=f"robot 'kuka': .*{reason}"):
        _ = replace(KUKA, joints=joints).urdf


def test_a_prismatic_joint_of_the_arm_is_refused() -> None:
    with pytest.raises(
        ValueError, match="joints must be revolute or continuous, got the prismatic joint 'torso_joint'"
    ):
        _ = changed_kuka(lifted, joints=("torso_joint", *KUKA.joints)).urdf


def _double_name(root: Element) -> None:
    SubElement(root, "link", name="lbr_iiwa_link_3")


def _second_parent(root: Element) -> None:
    add_joint(root, "fixed", "loop", ("lbr_iiwa_link_1", "lbr_iiwa_link_4"), ORIGIN, (1.0, 0.0, 0.0))


def _massless(root: Element) -> None:
    link = root.findall("link[@name='lbr_iiwa_link_3']")[0]
    link.remove(link.findall("inertial")[0])


def _no_axis(root: Element) -> None:
    find_joint(root, KUKA.joints[2]).findall("axis")[0].set("xyz", "0 0 0")


def _no_limit(root: Element) -> None:
    joint = find_joint(root, KUKA.joints[1])
    joint.remove(joint.findall("limit")[0])


def _swapped_limits(root: Element) -> None:
    find_joint(root, KUKA.joints[1]).findall("limit")[0].attrib.update(lower="2", upper="-2")


def _no_child(root: Element) -> None:
    joint = find_joint(root, KUKA.joints[3])
    joint.remove(joint.findall("child")[0])


def _cone(root: Element) -> None:
    geometry = root.findall("link[@name='lbr_iiwa_link_3']/collision/geometry")[0]
    geometry.clear()
    SubElement(geometry, "cone", radius="0.1", length="0.1")


def _unit(root: Element) -> None:
    root.findall("link[@name='lbr_iiwa_link_3']/inertial/mass")[0].set("value", "5kg")


def _coupled(root: Element) -> None:
    SubElement(find_joint(root, KUKA.joints[2]), "mimic", joint=KUKA.joints[1], multiplier="-1")


def _coupled_linkage(root: Element) -> None:
    """A rod that keeps a link level, as palletizing arms have it."""
    add_link(root, "rod", 0.1, [PART])
    rod = add_joint(root, "revolute", "rod", ("lbr_iiwa_link_2", "rod"), ORIGIN, (0.0, 1.0, 0.0))
    SubElement(rod, "mimic", joint=KUKA.joints[1], multiplier="-1")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_double_name, "names of links must be distinct, got 'lbr_iiwa_link_3' twice"),
        (
            partial(add_link, name="loose", mass=1.0, primitives=[PART]),
            "one root link, got 'lbr_iiwa_link_0', 'loose'",
        ),
        (_second_parent, "one parent, got several for 'lbr_iiwa_link_4'"),
        (_massless, "mass of link 'lbr_iiwa_link_3' must be a positive number, got no <inertial>"),
        (_no_axis, "axis of joint 'lbr_iiwa_joint_3' must have a length"),
        (_no_limit, "joints must have a <limit> with lower < upper, got no <limit> for 'lbr_iiwa_joint_2'"),
        (_swapped_limits, "joints must have a <limit> with lower < upper, got 2 and -2 for"),
        (_no_child, "joint 'lbr_iiwa_joint_4' must have a <child>"),
        (_cone, "<geometry> must hold one of box, .*, got cone in link 'lbr_iiwa_link_3'"),
        (_unit, "value of <mass> must be a number, got '5kg'"),
        (
            _coupled,
            "joints must move independently, got 'lbr_iiwa_joint_3', which follows 'lbr_iiwa_joint_2'",
        ),
        (_coupled_linkage, "joints must move independently, got 'rod', which follows 'lbr_iiwa_joint_2'"),
    ],
)
def test_a_broken_structure_is_refused(change: Callable[[Element], None], reason: str) -> None:
    with pytest.raises(ValueError, match=f"robot 'kuka': .*{reason}"):
        _ = changed_kuka(change).urdf


def test_mass_below_a_frame_without_inertial_is_kept() -> None:
    root = ElementTree.fromstring(
        """<robot name="hand"><link name="arm"><inertial><mass value="2"/></inertial></link>
        <link name="frame"/>
        <link name="hand"><inertial><origin xyz="0 0 0.1"/><mass value="0.3"/></inertial></link>
        <joint name="a" type="revolute"><parent link="base"/><child link="frame"/></joint>
        <joint name="b" type="fixed"><parent link="frame"/><child link="hand"/><origin xyz="0 0 0.2"/></joint>
        </robot>"""
    )
    merge_fixed(root)
    frame = root.findall("link[@name='frame']")[0]
    assert frame.findall("inertial/mass")[0].get("value") == "0.3"
    assert frame.findall("inertial/origin")[0].get("xyz") == "0.0 0.0 0.30000000000000004"


# Fingers


def _reversed(root: Element) -> None:
    """Let a finger open to negative positions."""
    finger = find_joint(root, FINGERS[0])
    finger.findall("axis")[0].set("xyz", "-2 0 0")
    finger.findall("limit")[0].set("lower", "-0.0425")
    finger.findall("limit")[0].set("upper", "0")


def test_a_finger_with_a_negative_axis_opens_as_the_other() -> None:
    model = changed_kuka(_reversed)
    env = gymnasium.make(PICKING, robot=model).unwrapped
    assert isinstance(env, ManipulationEnv)
    env.reset(seed=0)
    is_over = False
    while not is_over:
        *_, terminated, truncated, info = env.step(env.expert_action())
        is_over = terminated or truncated
    assert info["is_success"]


def _limited(root: Element) -> None:
    find_joint(root, FINGERS[0]).findall("limit")[0].set("lower", "0.02")


def _same_side(root: Element) -> None:
    find_joint(root, FINGERS[0]).findall("axis")[0].set("xyz", "-1 0 0")


def _rotating(root: Element) -> None:
    find_joint(root, FINGERS[0]).set("type", "revolute")


def _elsewhere(root: Element) -> None:
    find_joint(root, FINGERS[0]).findall("parent")[0].set("link", "lbr_iiwa_link_3")


def _without_shape(root: Element) -> None:
    link = root.findall("link[@name='left_finger']")[0]
    for shape in link.findall("collision"):
        link.remove(shape)


def _without_limit(root: Element) -> None:
    joint = find_joint(root, FINGERS[0])
    joint.remove(joint.findall("limit")[0])


def _unequal(root: Element) -> None:
    SubElement(find_joint(root, FINGERS[0]), "mimic", joint=FINGERS[1], multiplier="0.5")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            _limited,
            "must reach 0, where the fingers meet, got 'left_finger_joint' with the lower limit 0.02 m",
        ),
        (_same_side, "must open in opposite directions"),
        (_rotating, r"must be prismatic, got the revolute joint 'left_finger_joint'. Use on_slides\(\)"),
        (_elsewhere, "must be attached to the link 'lbr_iiwa_link_7' of the last joint"),
        (_without_shape, "fingers must have a collision shape, got none for link 'left_finger'"),
        (_without_limit, "must have a <limit> with lower < upper, got no <limit> for 'left_finger_joint'"),
        (_unequal, "must move equally, got 'left_finger_joint', which follows .* with the multiplier 0.5"),
    ],
)
def test_fingers_that_do_not_fit_the_gripper_are_refused(
    change: Callable[[Element], None], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        _ = changed_kuka(change).urdf


SLIDES = """<robot name="vx"><link name="palm"/><link name="bar"/><link name="left"/><link name="right"/>
<joint name="bar" type="fixed"><parent link="palm"/><child link="bar"/>
<origin xyz="0.1 0 0" rpy="0 0 0.5"/></joint>
<joint name="l" type="prismatic"><parent link="bar"/><child link="left"/><axis xyz="0 2 0"/></joint>
<joint name="r" type="prismatic"><parent link="bar"/><child link="right"/><axis xyz="0 1 0"/>
<mimic joint="l" multiplier="-1"/></joint></robot>"""


def test_on_slides_keeps_fixed_joints_and_moves_prismatic_fingers() -> None:
    root = on_slides(ElementTree.fromstring(SLIDES), "palm", ("l", "r"), closed=0.021, opened=0.057)
    for name, sign in (("l", 1.0), ("r", -1.0)):
        joint = find_joint(root, name)
        offset = np.array((-math.sin(0.5), math.cos(0.5), 0.0))
        expected = np.array((0.1, 0.0, 0.0)) + sign * 0.021 * offset
        xyz = [float(part) for part in joint.findall("origin")[0].get("xyz", "").split()]
        assert xyz == pytest.approx(expected.tolist())
        axis = [float(part) for part in joint.findall("axis")[0].get("xyz", "").split()]
        assert axis == pytest.approx((0.0, sign, 0.0))
        assert float(joint.findall("limit")[0].get("upper", "")) == pytest.approx(0.036)


def test_on_slides_refuses_fingers_that_do_not_open() -> None:
    with pytest.raises(
        ValueError, match=r"opened must move the finger 'l' outwards from closed=0\.057, got 0\.021"
    ):
        on_slides(ElementTree.fromstring(SLIDES), "palm", ("l", "r"), closed=0.057, opened=0.021)


# A flange that carries a gripper already

JAW = ParallelJaw(
    stroke=0.08, palm=(0.1, 0.05, 0.05), finger=(0.01, 0.02, 0.08), joints=("panda_finger_joint1", "b_joint")
)


def _fitted(arm: Callable[[], Element]) -> RobotModel:
    flange = Pose((0.0, 0.0, 0.107))
    load = partial(JAW.fitted, arm, "panda_link7", flange)
    return replace(PANDA, load=load, tool=JAW.tool(flange), gripper=JAW)


def test_without_leaves_out_a_link_and_all_attached_to_it() -> None:
    root = without(PANDA.load(), "panda_hand")
    assert [link.get("name") for link in root.findall("link")][-1] == "panda_link8"
    assert len(root.findall("joint")) == len(root.findall("link")) - 1
    assert len(_fitted(lambda: without(PANDA.load(), "panda_hand")).urdf.findall("joint")) == 9
    with pytest.raises(ValueError, match="no link 'wrist'"):
        without(PANDA.load(), "wrist")


def test_a_jaw_on_a_flange_that_carries_a_gripper_is_refused() -> None:
    """Else the hand of the Panda would reach through the jaw."""
    must = r"link must carry no gripper, got 'panda_link7' with the joint 'panda_finger.*'panda_hand'"
    with pytest.raises(ValueError, match=must):
        _ = _fitted(PANDA.load).urdf


def test_a_jaw_on_an_arm_with_the_same_joint_names_is_refused() -> None:
    jaw = replace(JAW, joints=("panda_joint3", "b_joint"))
    bare = partial(without, PANDA.load(), "panda_hand")
    load = partial(jaw.fitted, bare, "panda_link7", Pose((0.0, 0.0, 0.107)))
    with pytest.raises(ValueError, match="'panda_joint3'"):
        _ = replace(PANDA, load=load, gripper=jaw).urdf


def hand() -> Element:
    """The hand of the Panda as a model of its own."""
    root = PANDA.load()
    links = ("panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_grasptarget")
    for element in [*root.findall("link"), *root.findall("joint")]:
        ends = [element.get("name"), *(end.get("link") for end in element.findall("parent"))]
        if not set(ends) & set(links):
            root.remove(element)
    return root


def test_attach_joins_the_models_of_an_arm_and_a_gripper() -> None:
    mount = euler_pose((0.0, 0.0, 0.0), (0.0, 0.0, -math.pi / 4.0))
    whole, joined = PANDA.load(), attach(without(PANDA.load(), "panda_hand"), "panda_link8", hand(), mount)
    for kind in ("link", "joint"):
        assert len(joined.findall(kind)) == len(whole.findall(kind))
    model = replace(PANDA, load=lambda: joined)
    pose = PANDA.chain.forward(np.array(PANDA.posture))
    assert math.dist(model.chain.forward(np.array(PANDA.posture)).position, pose.position) < 1e-9
    places = []
    for root in (PANDA.urdf, model.urdf):
        origin = find_joint(root, PANDA.gripper.joints[0]).findall("origin")[0]
        places.append([float(part) for part in f"{origin.get('xyz')} {origin.get('rpy')}".split()])
    assert places[1] == pytest.approx(places[0], abs=1e-4)


def test_attach_refuses_models_with_the_same_names() -> None:
    with pytest.raises(ValueError, match="names of links must be distinct, got 'panda_hand'"):
        attach(PANDA.load(), "panda_link8", hand(), ORIGIN)


def test_prepare_leaves_unit_axes_as_they_are() -> None:
    root = KUKA.load()
    before = ElementTree.tostring(root)
    prepare(root, KUKA.joints, KUKA.gripper.joints)
    assert ElementTree.tostring(root) == before


# Values of the model


@pytest.mark.parametrize(
    ("field", "value", "must"),
    [
        ("force", (50.0,) * 6 + (0.0,), "a positive number"),
        ("force", math.nan, "a positive number"),
        ("force", None, "a positive number"),
        ("posture", (math.nan,) * 7, "numbers"),
        ("posture", "home", "numbers"),
        ("joints", (), "a tuple with the name of each joint"),
        ("joints", "lbr_iiwa_joint_1", "a tuple with the name of each joint"),
        ("base", (0.0, 0.0, 0.0), "a Pose"),
        ("load", "kuka.urdf", "a function that returns the URDF"),
        ("gripper", None, "a Gripper"),
    ],
)
def test_robot_model_names_the_wrong_value(field: str, value: object, must: str) -> None:
    with pytest.raises(ValueError, match=f"robot 'kuka': {field} must be {must}"):
        replace(KUKA, **{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("field", "value", "must"),
    [
        *(
            (name, value, "a positive number")
            for name in ("stroke", "speed")
            for value in (0.0, math.nan, "1")
        ),
        *((name, value, "a positive number") for name in ("force", "friction") for value in (-1.0, True)),
        ("finger", (0.01, 0.02), "three lengths"),
        ("palm", (0.1, -0.1, 0.1), "three lengths"),
        ("shoulder", 0.01, "a thickness and a height"),
        ("joints", ("left_finger_joint",), "a tuple of 2 names"),
    ],
)
def test_gripper_names_the_wrong_value(field: str, value: object, must: str) -> None:
    with pytest.raises(ValueError, match=f"gripper.{field} must be {must}"):
        replace(KUKA.gripper, **{field: value})  # type: ignore[arg-type]


def test_sequences_of_any_type_are_kept_as_tuples() -> None:
    model = replace(KUKA, joints=list(KUKA.joints), posture=np.array(KUKA.posture), force=[100] * 7)  # type: ignore[arg-type]
    assert (model.joints, model.posture, model.force) == (KUKA.joints, KUKA.posture, (100.0,) * 7)


@pytest.mark.parametrize(
    "load", [lambda: None, lambda: "kuka.urdf", lambda: ElementTree.ElementTree(KUKA.load())]
)
def test_load_must_return_the_root_element(load: Callable[[], Element]) -> None:
    with pytest.raises(ValueError, match=r"load\(\) must be the element <robot> of a URDF"):
        _ = replace(KUKA, load=load).urdf


def test_attach_and_on_slides_name_the_wrong_value() -> None:
    with pytest.raises(ValueError, match="other must be the element <robot> of a URDF, got str"):
        attach(KUKA.load(), "lbr_iiwa_link_7", "gripper.urdf", ORIGIN)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fingers must be a tuple of 2 names"):
        on_slides(KUKA.load(), "lbr_iiwa_link_7", ("left_finger_joint",), 0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="closed must be a finite number, got nan"):
        on_slides(KUKA.load(), "lbr_iiwa_link_7", FINGERS, math.nan)


@pytest.mark.parametrize("text", ["0 0", "0 0 ${height}"])
def test_an_origin_without_three_numbers_is_refused(text: str) -> None:
    def change(root: Element) -> None:
        find_joint(root, KUKA.joints[3]).findall("origin")[0].set("xyz", text)

    with pytest.raises(ValueError, match="xyz of <origin> must be 3 numbers, got '0 0"):
        _ = changed_kuka(change).chain


def test_names_with_quotes_are_found() -> None:
    def rename(root: Element) -> None:
        find_joint(root, KUKA.joints[2]).set("name", """the "arm's" joint""")

    joints = (*KUKA.joints[:2], """the "arm's" joint""", *KUKA.joints[3:])
    assert len(changed_kuka(rename, joints=joints).chain.axes) == 7


def test_a_tool_frame_across_the_opening_direction_is_refused() -> None:
    tool = KUKA.tool.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0))
    with pytest.raises(
        ValueError, match=r"tool must have its x axis along the opening direction .* 90 degrees"
    ):
        _ = replace(KUKA, tool=tool).urdf


@pytest.mark.parametrize("azimuth", [2.9, -2.5, 2.0])
def test_a_posture_that_does_not_face_the_workspace_serves_as_well(azimuth: float) -> None:
    """The posture is rotated to the front, so that the base can have any yaw."""
    pose = Pose.planar(0.5, 0.1, 0.2, 0.4)
    behind = replace(KUKA, posture=(azimuth, *KUKA.posture[1:]))
    for model in (KUKA, behind):
        joints, error = model.inverse(pose)
        assert error < 1e-4
        assert math.dist(model.chain.forward(joints).position, pose.position) < 1e-4


@pytest.mark.parametrize("base", [(0.05, 0.0, 1.2), (0.75, 0.2, 1.2)])
def test_an_arm_hangs_from_the_ceiling(base: tuple[float, float, float]) -> None:
    model = replace(
        KUKA, base=euler_pose(base, (math.pi, 0.0, 0.0)), posture=(0.0, 0.3, 0.0, -1.2, 0.0, -1.5, 0.0)
    )
    solved = [model.inverse(Pose.planar(x, y, 0.15))[1] < 1e-4 for x in (0.35, 0.55) for y in (-0.1, 0.1)]
    assert all(solved)


@pytest.mark.parametrize("robot, x, yaw", [("kuka", 0.45, 0.0), ("ur5", 0.45, 0.0), ("panda", 1.0, 0.0)])
def test_a_workspace_around_or_behind_the_base_is_refused(robot: str, x: float, yaw: float) -> None:
    """There the first joint of neighbouring positions differs by up to a turn, and motions get stuck."""
    model = ROBOTS[robot]
    base = euler_pose((x, 0.0, 1.3), (math.pi, 0.0, yaw)) if x < 0.6 else Pose.planar(x, 0.0, 0.0, yaw)
    with pytest.raises(ParameterError, match=rf"workspace.*{robot}.*base is at \({x:g}, 0\)"):
        gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", robot=replace(model, base=base))


@pytest.mark.parametrize("robot, x, yaw", [("kuka", 0.3, 0.0), ("panda", 1.0, math.pi), ("ur5", 1.0, 0.0)])
def test_a_workspace_next_to_the_base_is_accepted(robot: str, x: float, yaw: float) -> None:
    """Also behind an arm whose first joint makes whole turns."""
    model = replace(ROBOTS[robot], base=Pose.planar(x, 0.0, 0.0, yaw))
    assert not model.jumps_inside([[0.3, 0.6], [-0.15, 0.15]])
