"""Arms of users: each model is simulated as its file says, or refused with the reason."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import SubElement

import gymnasium
import numpy as np
import pytest
from rollouts import PICKING, finish

from bulletarm_gym.config import WORKSPACES, ParameterError
from bulletarm_gym.geometry import Pose, euler_pose, matrix
from bulletarm_gym.robots import KUKA, PANDA, ROBOTS, ParallelJaw
from bulletarm_gym.robots.editing import LIGHT, add_link, attach, box, on_slides, without
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_urdf
from bulletarm_gym.simulation.urdf import add_joint, end_of, find, frame_of, read_urdf, to_text

ORIGIN = Pose((0.0, 0.0, 0.0))
FINGERS = ("left_finger_joint", "right_finger_joint")
PART = box((0.05, 0.05, 0.05), (0.0, 0.0, 0.0), LIGHT)


def changed_kuka(change, **changes):
    """Return the KUKA with a change of its URDF."""

    def load():
        root = KUKA.load()
        change(root)
        return root

    return replace(KUKA, load=load, **changes)


def random_arm(rng):
    """Return the KUKA with random joints, of which only the last must be revolute, and the named ones."""
    root, named = KUKA.load(), []
    for name in KUKA.joints:
        is_last = name == KUKA.joints[-1]
        kind = "revolute" if is_last else str(rng.choice(["revolute", "continuous", "prismatic", "fixed"]))
        is_named = is_last or (kind in ("revolute", "continuous") and rng.random() < 0.8)
        low = -1.0 if is_named else float(rng.choice([-1.0, 0.2]))
        joint = find(root, "joint", name)
        links = tuple(end_of(joint, end) for end in ("parent", "child"))
        root.remove(joint)
        origin = euler_pose(*rng.uniform((-0.2, -3.0), (0.2, 3.0), (3, 2)).T.tolist())
        axis = rng.normal(size=3)
        add_joint(root, kind, name, links, origin, (axis / np.linalg.norm(axis)).tolist(), (low, 1.5))
        named += [name] * is_named
    return root, tuple(named)


@pytest.mark.parametrize("seed", range(6))
def test_forward_kinematics_equals_the_pose_of_the_link_in_bullet(seed):
    """Joints of all types. Joints that are not named are fixed at 0, or at their limit nearest to 0."""
    rng = np.random.default_rng(seed)
    root, names = random_arm(rng)
    kinds = {joint.get("name"): joint.get("type") for joint in root.findall("joint")}
    base, posture = euler_pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.4)), (0.0,) * len(names)
    model = replace(KUKA, load=lambda: root, joints=names, base=base, posture=posture, force=10.0)
    positions = rng.uniform(-0.9, 1.4, len(names))
    client, moved = Client(), dict(zip(names, positions.tolist(), strict=True))
    body, _ = load_urdf(client, "file", to_text(root), base)
    for joint in range(client.getNumJoints(body)):
        info = client.getJointInfo(body, joint)
        name = info[1].decode()
        if info[2] != client.JOINT_FIXED:
            fixed_at = 0.0 if kinds[name] == "continuous" else max(0.0, info[8])
            client.resetJointState(body, joint, moved.get(name, fixed_at))
        if name == names[-1]:
            last = joint
    state = client.getLinkState(body, last, computeForwardKinematics=True)
    simulated = Pose(state[4], state[5]).compose(KUKA.tool)
    ours = model.chain.forward(positions)
    np.testing.assert_allclose(ours.position, simulated.position, atol=1e-6)
    np.testing.assert_allclose(matrix(ours), matrix(simulated), atol=1e-6)


def test_workspace_around_or_behind_the_base_is_refused():
    """There the first joint of neighbouring positions differs by up to a turn, and motions get stuck."""
    for robot, base, is_refused in (
        ("kuka", euler_pose((0.45, 0.0, 1.3), (math.pi, 0.0, 0.0)), True),
        ("panda", Pose((1.0, 0.0, 0.0)), True),
        ("panda", Pose.planar(1.0, 0.0, 0.0, math.pi), False),
        ("ur5", Pose((1.0, 0.0, 0.0)), False),  # its first joint makes whole turns
    ):
        model = replace(ROBOTS[robot], base=base)
        assert model.jumps_inside(WORKSPACES["close_loop"]) == is_refused
        if is_refused:
            with pytest.raises(ParameterError, match=rf"workspace.*{robot}.*\({base.x:g}, 0\)"):
                gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", robot=model)


def put(part, path, **attributes):
    """Return a change that sets attributes of a part of a link or joint."""

    def change(root):
        (element,) = [one for one in root if one.get("name") == part]
        (element.findall(path)[0] if path else element).attrib.update(attributes)

    return change


def drop(name, tag):
    """Return a change that removes parts of a link or joint."""

    def change(root):
        (element,) = [one for one in root if one.get("name") == name]
        for part in element.findall(tag):
            element.remove(part)

    return change


def mimic(name, source):
    """Return a change that couples a joint to another."""
    return lambda root: SubElement(find(root, "joint", name), "mimic", joint=source, multiplier="0.5")


def rod(root):
    """Add a rod that keeps a link level, as palletizing arms have it."""
    add_link(root, "rod", 0.1, [PART])
    add_joint(root, "revolute", "rod", ("lbr_iiwa_link_2", "rod"), ORIGIN, (0.0, 1.0, 0.0))
    mimic("rod", KUKA.joints[1])(root)


def wheel(root):
    """Add a link on a joint that is neither the arm's nor the gripper's and has no axis."""
    add_link(root, "wheel", 0.1, [PART])
    add_joint(root, "continuous", "wheel", ("lbr_iiwa_link_2", "wheel"), ORIGIN, (0.0, 0.0, 0.0))


def test_urdf_that_cannot_be_simulated_is_refused():
    for change, words in (
        (lambda root: SubElement(root, "link", name="lbr_iiwa_link_3"), ("distinct", "lbr_iiwa_link_3")),
        (partial(add_link, name="loose", mass=1.0, primitives=[PART]), ("one root link", "loose")),
        (drop("lbr_iiwa_link_3", "inertial"), ("mass", "lbr_iiwa_link_3")),
        (put("lbr_iiwa_link_3", "inertial/mass", value="5kg"), ("<mass>", "5kg")),
        (put(KUKA.joints[2], "axis", xyz="0 0 0"), ("axis", KUKA.joints[2])),
        (put(KUKA.joints[3], "origin", xyz="0 0 ${height}"), ("<origin>", "${height}")),
        (put(KUKA.joints[2], "origin", xyz="0 0 nan"), ("xyz of <origin>", "3 finite numbers", "0 0 nan")),
        (drop(KUKA.joints[1], "limit"), ("<limit>", KUKA.joints[1])),
        (put(KUKA.joints[1], "limit", lower="2", upper="-2"), ("<limit>", KUKA.joints[1])),
        (drop(KUKA.joints[3], "child"), ("<child>", KUKA.joints[3])),
        (mimic(KUKA.joints[2], KUKA.joints[1]), ("independently", KUKA.joints[2])),
        (rod, ("independently", "rod")),
        (wheel, ("axis", "wheel")),
        (put(KUKA.joints[2], "", type="prismatic"), ("revolute", KUKA.joints[2])),
        (put(FINGERS[0], "limit", lower="0.02"), ("0.02", FINGERS[0])),
        (put(FINGERS[0], "limit", upper="0.04"), ("stroke", "0.04")),
        (put(FINGERS[0], "axis", xyz="-1 0 0"), ("opposite", FINGERS[0])),
        (put(FINGERS[0], "", type="revolute"), ("prismatic", FINGERS[0], "on_slides")),
        (put(FINGERS[0], "parent", link="lbr_iiwa_link_3"), ("chain", FINGERS[0])),
        (drop("left_finger", "collision"), ("<collision>", "left_finger")),
        (mimic(*FINGERS), ("equally", FINGERS[0])),
    ):
        with pytest.raises(ValueError) as error:
            _ = changed_kuka(change).chain
        assert all(word in str(error.value) for word in words)


def test_invalid_field_of_a_model_is_named():
    for field, value, words in (
        ("joints", KUKA.joints[::-1], ("chain", "lbr_iiwa_joint_7")),
        ("joints", (*KUKA.joints[:-1], "nothing"), ("nothing",)),
        ("tool", KUKA.tool.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)), ("tool", "90 degrees")),
        ("load", lambda: ElementTree.ElementTree(KUKA.load()), ("load()", "<robot>")),
        ("posture", (math.nan,) * 7, ("posture", "nan")),
        ("posture", (0.0, 0.6, 0.0, -2.5, 0.0, 0.7, 0.0), ("posture", "-2.5", "lbr_iiwa_joint_4")),
    ):
        with pytest.raises(ValueError) as error:
            _ = replace(KUKA, **{field: value}).chain
        assert all(word in str(error.value) for word in words)


def test_models_may_load_the_same_element():
    root = KUKA.load()
    texts = [replace(KUKA, load=lambda: root).xml for _ in range(2)]
    assert texts[0] == texts[1] == KUKA.xml
    arm = without(KUKA.load(), "left_finger", "right_finger")
    jaw = ParallelJaw(stroke=0.08, palm=(0.1, 0.05, 0.06), finger=(0.01, 0.02, 0.08))
    made = [to_text(jaw.fitted(lambda: arm, "lbr_iiwa_link_7", ORIGIN)) for _ in range(2)]
    assert made[0] == made[1]
    with pytest.raises(ValueError, match=r"^arm\(\) must be the element <robot>"):
        jaw.fitted(dict, "lbr_iiwa_link_7", ORIGIN)


def test_meshes_of_a_folder_are_found(tmp_path, monkeypatch):
    for folder in ("urdf", "meshes"):
        (tmp_path / "my_arm" / folder).mkdir(parents=True)
    file, obj = tmp_path / "my_arm" / "urdf" / "arm.urdf", tmp_path / "my_arm" / "meshes" / "base.obj"
    obj.write_text("v 0 0 0\nf 1 1 1\n")
    monkeypatch.chdir(tmp_path)
    for mesh in ("package://my_arm/meshes/base.obj", "package://meshes/base.obj", "../meshes/base.obj"):
        visual = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
        file.write_text(f'<robot name="arm"><link name="base">{visual}</link></robot>')
        for source in (file, str(file.relative_to(tmp_path))):
            (found,) = read_urdf(source).iter("mesh")
            assert Path(found.get("filename")).samefile(obj)
    obj.unlink()
    with pytest.raises(ValueError, match=r"the mesh '.*base.obj'"):
        read_urdf(file)


def test_cycle_of_joints_is_refused(tmp_path):
    root = KUKA.load()
    add_joint(root, "fixed", "back", ("lbr_iiwa_link_5", "lbr_iiwa_link_3"), ORIGIN, (0.0, 0.0, 1.0))
    (file := tmp_path / "arm.urdf").write_text(to_text(root))
    with pytest.raises(ValueError, match=r"cycle: .*lbr_iiwa_link_5"):
        read_urdf(file)


def reversed_finger(root):
    """Let one finger open along the negative direction of its axis."""
    put(FINGERS[0], "axis", xyz="-2 0 0")(root)
    put(FINGERS[0], "limit", lower="-0.0425", upper="0")(root)


@pytest.mark.parametrize("change", [reversed_finger, put(KUKA.joints[0], "", type="continuous")])
def test_other_valid_joints_act_alike(change):
    env = gymnasium.make(PICKING, robot=changed_kuka(change))
    env.reset(seed=0)
    assert finish(env)[0]


SLIDES = """<robot name="vx"><link name="palm"/><link name="bar"/><link name="left"/><link name="right"/>
<joint name="bar" type="fixed"><parent link="palm"/><child link="bar"/>
<origin xyz="0.1 0 0" rpy="0 0 0.5"/></joint>
<joint name="l" type="prismatic"><parent link="bar"/><child link="left"/><axis xyz="0 2 0"/></joint>
<joint name="r" type="prismatic"><parent link="bar"/><child link="right"/><axis xyz="0 1 0"/>
<mimic joint="l" multiplier="-1"/></joint></robot>"""


def test_on_slides_keeps_fixed_joints_and_moves_prismatic_fingers():
    root = on_slides(ElementTree.fromstring(SLIDES), "palm", ("l", "r"), closed=0.021, opened=0.057)
    offset = 0.021 * np.array((-math.sin(0.5), math.cos(0.5), 0.0))
    for name, sign in (("l", 1.0), ("r", -1.0)):
        joint = find(root, "joint", name)
        assert frame_of(joint).position == pytest.approx(((0.1, 0.0, 0.0) + sign * offset).tolist())
        axis = [float(part) for part in joint.findall("axis")[0].get("xyz", "").split()]
        assert axis == pytest.approx((0.0, sign, 0.0))
        assert float(joint.findall("limit")[0].get("upper", "")) == pytest.approx(0.036)


def test_on_slides_names_the_invalid_argument():
    arguments = {"carrier": "palm", "fingers": ("l", "r"), "closed": 0.021, "opened": 0.057}
    for changes, words in (
        ({"fingers": ("l", "thumb")}, "no joint.*thumb"),
        ({"carrier": "hand"}, "no link.*hand"),
        ({"carrier": "left"}, "attached.*'left'|'left'.*attached"),
        ({"closed": 0.057, "opened": 0.021}, r"opened.*0\.021"),
    ):
        with pytest.raises(ValueError, match=words):
            on_slides(ElementTree.fromstring(SLIDES), **(arguments | changes))


JAW = ParallelJaw(stroke=0.08, palm=(0.1, 0.05, 0.05), finger=(0.01, 0.02, 0.08), joints=("a", "b"))
FLANGE = Pose((0.0, 0.0, 0.107))


def bare_panda():
    return without(PANDA.load(), "panda_hand")


def test_jaw_replaces_the_gripper_of_an_arm():
    root = bare_panda()
    assert [link.get("name") for link in root.findall("link")][-1] == "panda_link8"
    assert len(root.findall("joint")) == len(root.findall("link")) - 1
    load = partial(JAW.fitted, bare_panda, "panda_link7", FLANGE)
    assert len(replace(PANDA, load=load, tool=JAW.tool(FLANGE), gripper=JAW).urdf.findall("joint")) == 9
    for call, words in (
        (lambda: without(PANDA.load(), "wrist"), "no link 'wrist'"),
        (lambda: JAW.fitted(PANDA.load, "panda_link7", FLANGE), r"panda_link7.*panda_finger"),
        (lambda: JAW.fitted(bare_panda, "hand", FLANGE), "no link 'hand'"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_attach_joins_the_models_of_an_arm_and_a_gripper():
    hand = PANDA.load()
    arm_links = {f"panda_link{number}" for number in range(9)}
    for element in [*hand.findall("link"), *hand.findall("joint")]:
        if {element.get("name"), *(end.get("link") for end in element.findall("parent"))} & arm_links:
            hand.remove(element)
    mount = euler_pose((0.0, 0.0, 0.0), (0.0, 0.0, -math.pi / 4.0))
    joined = attach(bare_panda(), "panda_link8", hand, mount)
    model = replace(PANDA, load=lambda: joined)
    origins = [frame_of(find(one.urdf, "joint", PANDA.gripper.joints[0])) for one in (PANDA, model)]
    assert origins[1].position == pytest.approx(origins[0].position, abs=1e-4)
    with pytest.raises(ValueError, match="<robot>"):
        attach(KUKA.load(), "lbr_iiwa_link_7", "gripper.urdf", ORIGIN)
    twice = replace(PANDA, load=lambda: attach(PANDA.load(), "panda_link8", bare_panda(), ORIGIN))
    with pytest.raises(ValueError, match=r"distinct.*panda_link0"):
        _ = twice.urdf


def test_names_of_joints_may_have_quotes():
    name = """the "arm's" joint"""
    joints = (*KUKA.joints[:2], name, *KUKA.joints[3:])
    model = changed_kuka(put(KUKA.joints[2], "", name=name), joints=joints)
    assert model.joints == joints and len(model.chain.frames[2]) == 7
