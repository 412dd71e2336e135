"""How many bodies a scene loads where sizes are drawn, and that what is remembered of them stays true."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import advance, transcript

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.blocks import SHAPES
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.predicates import touching
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.scene.scene import MAX_BODIES, ObjectSlot, subsample_variants
from bulletarm_gym.simulation import BodySpec

Make = Callable[..., ManipulationEnv]
PACKING = "BulletArm/OpenLoopBinPacking-v0"
RANGE = {"object_scale_range": [0.7, 0.9]}


def slot(count: int) -> ObjectSlot:
    return ObjectSlot(f"slot {count}", tuple(BodySpec(f"{number}", (), 1.0) for number in range(count)))


def variants(env: ManipulationEnv) -> dict[str, list[BodySpec]]:
    return {
        item.slot.name: [item.slot.variants[place] for place in item.choices] for item in env.scene.objects
    }


def test_without_a_range_all_variants_are_loaded(make: Make) -> None:
    env = make(PACKING)
    assert len(env.scene.world.bodies) == 3 + 8 * len(SHAPES)  # the ground, the arm and the bin, the blocks
    assert all(len(item.choices) == len(item.slot.variants) for item in env.scene.objects)


@pytest.mark.parametrize(
    "name", ["BinPacking", "BottleArrangement", "BoxPalletizing", "ImproviseHouseBuilding3"]
)
def test_a_range_does_not_multiply_the_bodies(make: Make, name: str) -> None:
    env = make(f"BulletArm/OpenLoop{name}-v0", **RANGE)
    assert sum(len(item.choices) for item in env.scene.objects) <= MAX_BODIES
    assert len(env.scene.world.bodies) <= MAX_BODIES + 2


def test_a_range_keeps_all_sizes_and_shapes(make: Make) -> None:
    env = make(PACKING, **RANGE)
    blocks = {name: specs for name, specs in variants(env).items() if name != "bin"}
    kinds = {name: [spec.name.split()[-2:] for spec in specs] for name, specs in blocks.items()}
    for name, pairs in kinds.items():
        assert {shape for shape, _ in pairs} == {str(shape) for shape in range(len(SHAPES))}, name
        assert len({scale for _, scale in pairs}) >= 7, name
    together = {tuple(pair) for pairs in kinds.values() for pair in pairs}
    assert len(together) == len(SHAPES) * len(env.config.scales)


def test_a_narrow_range_keeps_its_grid(make: Make) -> None:
    env = make("BulletArm/CloseLoopBlockPicking-v0", **RANGE)
    (specs,) = variants(env).values()
    assert [spec.name for spec in specs] == [f"cube {scale:g}" for scale in env.config.scales]


def test_states_are_exact_among_many_sizes(make: Make) -> None:
    env, other = (make(PACKING, instance, **RANGE) for instance in range(2))
    state = advance(env, 3, 3)
    expected = transcript(env, 6)
    transcript(other, 3, seed=5)
    other.set_state(state)
    assert transcript(other, 6) == expected


@pytest.mark.parametrize("most", [1, 8, 29, 120])
def test_variants_are_spread(most: int) -> None:
    slots = [slot(count) for count in (1, 4, 77, 77, 38)]
    chosen = subsample_variants(slots, most)
    for places, one in zip(chosen, slots, strict=True):
        assert places == sorted(set(places)) and 1 <= len(places) <= len(one.variants)
        assert all(0 <= place < len(one.variants) for place in places)
    lengths = [len(places) for places in chosen]
    assert sum(lengths) <= max(most, len(slots))
    assert lengths == [min(len(one.variants), max(lengths)) for one in slots]
    if max(lengths) < 38:
        assert not set(chosen[2]) & set(chosen[3])  # the second goes on where the first ended


def test_everything_is_kept_where_there_is_room() -> None:
    assert subsample_variants([slot(3), slot(2)], 5) == [[0, 1, 2], [0, 1]]
    assert subsample_variants([], 5) == []


def test_what_is_remembered_follows_the_pose(make: Make) -> None:
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    first, second = list(env.scene)[:2]
    before = footprint(first)
    assert footprint(first) is before  # not computed anew
    env.expert_action()
    assert not touching(env.scene, first, second)
    x, y, z = second.pose.position
    first.place(Pose((x, y, z + second.spec.extents[2])))
    assert touching(env.scene, first, second)
    assert first.lowest == pytest.approx(second.bounds[1, 2], abs=1e-6)
    assert footprint(first).centre == pytest.approx((x, y))
    state = env.get_state()
    first.place(Pose((x + 0.1, y, z)))
    assert not touching(env.scene, first, second)
    env.set_state(state)
    assert touching(env.scene, first, second)


def test_spheres_leave_nothing_out_that_is_near(make: Make) -> None:
    env = make("BulletArm/OpenLoopImproviseHouseBuilding3-v0")
    world = env.scene.world
    for seed in range(3):
        env.reset(seed=seed)
        bodies = [item.body for item in env.scene]
        for first, second in itertools.combinations(bodies, 2):
            for limit in (0.002, 0.05, 0.1):
                near = world.distance(first, second, limit) <= limit
                assert world.are_near(first, second, limit) == near


def test_heightmaps_follow_what_moves(make: Make) -> None:
    env = make("BulletArm/OpenLoopHouseBuilding2-v0")
    env.reset(seed=0)
    scene, view = env.scene, Window(env.config.centre, env.config.workspace_size, 64)
    first, second = list(scene)[:2]
    renderer = HeightRenderer.of(scene)
    alone = renderer.heights_of([first.body], view)
    assert alone.max() > 0.0
    second.place(Pose.planar(*env.config.centre, 0.1))
    np.testing.assert_array_equal(renderer.heights_of([first.body], view), alone)
    first.park()
    assert renderer.heights_of([first.body], view).max() == 0.0
    assert renderer.heights(view).max() == pytest.approx(0.1 + second.spec.extents[2] / 2.0, abs=1e-3)
