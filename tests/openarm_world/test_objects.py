# SPDX-License-Identifier: Apache-2.0
"""Ids of objects over small made sequences: births, deaths, what is hidden, pushed, merged, carried."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_world import Objects, Sight
from openarm_world.carried import HeldBoxes
from openarm_world.config import WorldConfig
from tests.openarm_world.made import ABOVE, Box, clouds, image

A: Box = ((-0.10, 0.0, 0.03), (0.06, 0.06, 0.06))
B: Box = ((0.08, 0.05, 0.04), (0.05, 0.08, 0.08))
C: Box = ((0.02, -0.10, 0.025), (0.05, 0.05, 0.05))
#: What hides A: far over the table, and never detected.
ARM: Box = ((-0.10, 0.0, 0.35), (0.12, 0.3, 0.05))
SECOND = 1_000_000_000


class Run:
    """A tracker and its clock; boxes are numbered as they are detected, unless `labels` says otherwise."""

    def __init__(self) -> None:
        self.objects, self.t_ns = Objects(), 0
        self.sights: list[Sight] = []

    def see(
        self,
        *boxes: Box,
        over: tuple[Box, ...] = (),
        labels: tuple[int, ...] = (),
        T: np.ndarray = ABOVE,
        **more: object,
    ) -> list[str]:
        """Ids of the boxes that are seen, one detection each (several of one label: one detection)."""
        every = dict(enumerate((*boxes, *over), start=1))
        view, number = image(every, T)
        table = np.zeros(len(every) + 1, np.uint32)
        table[1 : len(boxes) + 1] = labels or range(1, len(boxes) + 1)
        self.t_ns += SECOND
        self.objects, sight = self.objects.update(view, clouds(view, table[number]), self.t_ns, **more)
        self.sights.append(sight)
        return [sight.ids.get(int(i), "") for i in table[1 : len(boxes) + 1]]


def held_box(T: np.ndarray, size: tuple[float, float, float]) -> HeldBoxes:
    return HeldBoxes(T, ((np.eye(4), size),))


def moved(box: Box, x: float, y: float = 0.0, z: float = 0.0) -> Box:
    return (box[0][0] + x, box[0][1] + y, box[0][2] + z), box[1]


def test_ids_stay_in_whatever_order_things_are_detected() -> None:
    run = Run()
    assert run.see(A, B) == ["1", "2"]
    assert run.see(B, A) == ["2", "1"]
    assert run.see(B, C, A) == ["2", "3", "1"]
    assert run.sights[-1].born == (3,)


def test_what_is_taken_away_is_gone_and_its_id_is_never_given_again() -> None:
    run = Run()
    run.see(A, B)
    assert run.see(B) == ["2"]
    assert run.sights[-1].gone == (1,)
    assert run.see(A, B) == ["3", "2"]


def test_what_is_hidden_keeps_its_id_however_long() -> None:
    run = Run()
    run.see(A, B)
    for _ in range(20):
        assert run.see(B, over=(ARM,)) == ["2"]
        assert run.sights[-1].gone == ()
    assert run.see(A, B) == ["1", "2"]


def test_what_is_hidden_of_an_object_is_remembered() -> None:
    run = Run()
    run.see(A, B)
    whole = len(run.objects.tracks[0].points)
    for _ in range(3):
        assert run.see(A, B, over=(moved(ARM, -0.021),)) == ["1", "2"]
    assert np.mean(run.sights[-1].owner == 1) < 0.7 * np.mean(run.sights[0].owner == 1)
    assert len(run.objects.tracks[0].points) > 0.9 * whole


def test_what_was_hidden_and_is_not_there_when_its_place_is_seen_is_gone() -> None:
    run = Run()
    run.see(A, B)
    run.see(B, over=(ARM,))
    assert run.see(B) == ["2"]
    assert run.sights[-1].gone == (1,)


def test_what_was_pushed_keeps_its_id() -> None:
    run = Run()
    run.see(A, B)
    assert run.see(moved(A, 0.02), B) == ["1", "2"]  # its old place and its new one overlap
    assert run.see(moved(A, 0.09), B) == ["1", "2"]  # they do not
    assert run.see(moved(A, 0.09, 0.18), B) == ["3", "2"]  # farther than the gate


def test_things_that_touch_and_are_detected_as_one_part_again_with_their_ids() -> None:
    run = Run()
    together = moved(B, -0.124, -0.05)  # 1 mm from A
    run.see(A, moved(together, 0.06))
    assert run.see(A, together) == ["1", "2"]
    for _ in range(3):
        run.see(A, together, labels=(1, 1))
        assert len(run.objects.tracks) == 2
    owner, cloud = run.sights[-1].owner, clouds(*image({1: A, 2: together}))
    assert np.mean(owner[cloud.labels == 1] == 1) > 0.95  # the detection is divided among both
    assert np.mean(owner[cloud.labels == 2] == 2) > 0.95
    assert run.see(A, moved(together, 0.06)) == ["1", "2"]


def test_what_moved_apart_was_two_things() -> None:
    run = Run()
    near = moved(B, -0.124, -0.05)
    assert run.see(A, near, labels=(1, 1)) == ["1", "1"]
    ids = run.see(A, moved(near, 0.15))
    assert sorted(ids) == ["1", "2"]


def test_a_thing_seen_in_two_parts_behind_an_arm_has_one_number_and_two_ids() -> None:
    run = Run()
    long: Box = ((0.0, 0.0, 0.03), (0.30, 0.06, 0.06))
    run.see(long)
    view, number = image({1: long, 2: ((0.03, 0.0, 0.35), (0.05, 0.4, 0.05))})
    parts = np.where(number == 1, np.where(np.arange(320) < 160, 1, 2), 0)
    run.objects, sight = run.objects.update(view, clouds(view, parts), run.t_ns + SECOND)
    assert sorted(sight.ids.values()) == ["1", "1.2"]
    assert len(run.objects.tracks) == 1


def test_what_a_hand_holds_moves_with_it_and_what_it_did_not_take_stays() -> None:
    run = Run()

    def hand(x: float, z: float) -> dict[str, object]:
        T = se3.make(None, (A[0][0] + x, A[0][1], A[0][2] + z))
        return {"carriers": {"held": held_box(T, (0.06, 0.06, 0.06))}}

    run.see(A, B, C)
    assert run.see(A, B, C, **hand(0.0, 0.0)) == ["1", "2", "3"]
    for x, z in ((0.0, 0.15), (0.1, 0.2), (0.2, 0.2)):
        assert run.see(moved(A, x, 0.0, z), B, C, **hand(x, z)) == ["1", "2", "3"]
    assert run.see(moved(A, 0.28), B, C, **hand(0.28, 0.0)) == ["1", "2", "3"]
    assert run.see(moved(A, 0.28), B, C, carriers={}) == ["1", "2", "3"]  # it has let go
    run.see(moved(A, 0.28), B, C, **{"carriers": {"held": held_box(se3.make(None, B[0]), B[1])}})
    gone = {"carriers": {"held": held_box(se3.make(None, (0.0, 0.0, 0.5)), B[1])}}
    assert run.see(moved(A, 0.28), B, C, **gone) == ["1", "2", "3"]  # slipped out of the hand: it stands


def test_what_a_hand_holds_as_several_boxes_is_one_object() -> None:
    run = Run()
    third = (A[1][0] / 3.0, *A[1][1:])
    parts = tuple((se3.make(None, (x, 0.0, 0.0)), third) for x in (-third[0], 0.0, third[0]))

    def hand(z: float) -> dict[str, HeldBoxes]:
        return {"hand": HeldBoxes(se3.make(None, moved(A, 0.0, 0.0, z)[0]), parts)}

    assert run.see(A, B, carriers=hand(0.0)) == ["1", "2"]
    assert run.objects.grips["hand"].ids == (1,)
    assert run.see(moved(A, 0.0, 0.0, 0.2), B, carriers=hand(0.2)) == ["1", "2"]


def test_what_a_hand_took_and_put_down_between_images_keeps_its_id() -> None:
    """The images come before the grasp, while the hand carries the thing out of view, and after it was put down."""
    run = Run()
    run.see(A, B)
    held = {"held": held_box(se3.make(None, (-0.1, 0.09, 0.25)), A[1])}
    hand: Box = ((-0.1, 0.09, 0.25), (0.1, 0.1, 0.1))
    assert run.see(B, over=(hand,), carriers=held) == ["2"]
    assert run.sights[-1].gone == ()
    assert run.see(B, over=(hand,), carriers=held) == ["2"]
    assert run.see(B, moved(A, 0.1, -0.15), carriers={}) == ["2", "1"]
    run.see(B, moved(A, 0.1, -0.15), C, carriers={"held": held_box(se3.make(None, (0.0, 0.2, 0.3)), A[1])})
    assert run.sights[-1].gone == ()  # all stand: it holds something else
    assert run.sights[-1].born == (3,)


def test_a_hand_whose_pose_is_not_known_for_an_image_goes_on_holding() -> None:
    run = Run()
    run.see(A, B, carriers={"held": held_box(se3.make(None, A[0]), A[1])})
    run.see(B, carriers=None, over=(moved(ARM, 0.0),))
    lifted = {"held": held_box(se3.make(None, moved(A, 0.2, 0.0, 0.1)[0]), A[1])}
    assert run.see(moved(A, 0.2, 0.0, 0.1), B, carriers=lifted) == ["1", "2"]


def test_a_camera_that_has_moved_sees_the_same_objects() -> None:
    run = Run()
    run.see(A, B, C)
    for tilt in (0.1, -0.2, 0.3):
        T = se3.make(se3.rot_y(tilt), (-0.8 * np.sin(tilt), 0.0, 0.0)) @ ABOVE
        assert run.see(A, B, C, T=T) == ["1", "2", "3"]


def test_out_of_the_image_is_not_gone_until_it_is_forgotten() -> None:
    run = Run()
    run.objects = Objects(WorldConfig(forget=3.0))
    run.see(A, B)
    away = se3.make(None, (2.0, 0.0, 0.0)) @ ABOVE
    for left in (2, 2, 2, 0):
        run.see(A, B, T=away)
        assert len(run.objects.tracks) == left
    assert run.see(A, B) == ["3", "4"]


def test_a_world_that_was_reset_forgets_objects_and_gives_new_ids() -> None:
    run = Run()
    run.see(A, B)
    run.see(A, B)
    run.t_ns = 0
    assert run.see(A, B) == ["3", "4"]


def test_an_image_without_detections_is_taken() -> None:
    run = Run()
    assert run.see() == []
    run.see(A)
    view, number = image({1: A})
    run.objects, sight = run.objects.update(view, clouds(view, 0 * number), 9 * SECOND)
    assert (sight.ids, len(run.objects.tracks)) == ({}, 1)  # it is seen where it was


@settings(deadline=None, max_examples=15)
@given(st.lists(st.tuples(st.integers(0, 2), st.floats(-0.08, 0.08), st.floats(-0.08, 0.08)), max_size=5))
def test_a_replay_gives_the_same_bits_and_ids_are_unique(steps) -> None:
    def play() -> Run:
        run, boxes = Run(), [A, B, C]
        run.see(*boxes)
        for k, x, y in steps:
            boxes[k] = moved(boxes[k], x, y)
            assert len(set(ids := [i for i in run.see(*boxes) if i])) == len(ids)
        return run

    one, other = play(), play()
    assert [(s.ids, s.born, s.gone, s.owner.tobytes()) for s in one.sights] == [
        (s.ids, s.born, s.gone, s.owner.tobytes()) for s in other.sights
    ]
    assert [t.points.tobytes() for t in one.objects.tracks] == [t.points.tobytes() for t in other.objects.tracks]
    numbers = [track.id for track in one.objects.tracks]
    assert len(set(numbers)) == len(numbers)


def test_an_update_leaves_the_value_that_it_was_given() -> None:
    run = Run()
    run.see(A, B)
    before = run.objects
    bits = [track.points.tobytes() for track in before.tracks]
    run.see(moved(A, 0.05), C)
    assert [track.points.tobytes() for track in before.tracks] == bits
    assert before.next_id == 3
