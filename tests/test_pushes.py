"""The sides to which robots are pushed, and the falls after them."""

import numpy as np

from fmpjax.pushes import Push, by_side, pushes_of, sides_text


def test_pushes_are_seen_from_the_robot_and_a_fall_belongs_to_the_last_one():
    qpos, added = np.zeros((100, 3, 8)), np.zeros((100, 3, 6))
    qpos[..., 3] = 1.0
    qpos[:, 1, 3:7] = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # faces y
    added[10, 0, :2], added[60, 0, :2] = [0.3, 0.4], [-0.6, 0.0]
    added[20, 1, :2] = [0.5, 0.0]
    added[30, 1, 5] = 1.0  # turned, not pushed
    added[90, 1, :2] = [0.5, 0.0]  # after the end
    added[99, 2, :2] = [0.0, 0.1]
    length, fell = np.array([70, 80, 100]), np.array([True, True, False])
    pushes = pushes_of(qpos, length, fell, added)
    said = [(push.episode, push.step, push.side, round(push.speed, 6), push.fell) for push in pushes]
    assert said == [
        (0, 10, "left", 0.5, False),
        (0, 60, "back", 0.6, True),
        (1, 20, "right", 0.5, True),
        (2, 99, "left", 0.1, False),
    ]
    sides = by_side(pushes)
    assert sides == [("ahead", 0, 0), ("left", 2, 0), ("back", 1, 1), ("right", 1, 1)]
    assert sides_text(sides) == "fell after pushes left 0 % of 2, back 100 % of 1, right 100 % of 1"


def test_no_push_is_no_side():
    assert by_side([]) == [(side, 0, 0) for side in ("ahead", "left", "back", "right")]
    assert by_side([Push(0, 1, "ahead", 0.5, True)])[0] == ("ahead", 1, 1)
