"""Gait metrics against cases worked out by hand."""

import numpy as np
import pytest

from fmpjax import metrics
from fmpjax.errors import UserError

SAGITTAL = np.array([4, 0, 1, 5, 2, 3])  # not in order, and joint 6 is none of them


def ramps(ranges, steps=50):
    """Joint positions ``[steps, 6]`` rising evenly so that 95th - 5th percentile is ``ranges`` in each 50 steps.

    Over 50 evenly spaced values from 0 to a the percentiles fall on 0.05 a and 0.95 a: the range is 0.9 a.
    """
    return (np.arange(steps) % 50 / 49.0)[:, None] * np.asarray(ranges) / 0.9


def test_late_speed_is_signed_and_along_the_heading():
    time = np.arange(1, 501) / 50.0
    position = np.zeros((500, 3, 3))
    position[:, 0, 0] = 0.7 * time  # forward along x
    position[:, 1, 0] = 0.7 * time  # the same, the demonstration heading the other way
    position[:, 2, 1] = 0.4 * time  # along y, with sideways drift that does not count
    position[:, 2, 0] = 0.3 * time
    speed = metrics.late_speed(position, np.full(3, 500), np.array([0.0, np.pi, np.pi / 2]))
    np.testing.assert_allclose(speed, [0.7, -0.7, 0.4], atol=1e-12)


def test_late_speed_reads_only_the_late_window():
    # Stands until 5 s, which is row 249, then moves 1 cm a step; a jump of 9 m at the reset after row 349.
    step = np.zeros(500)
    step[250:350] = 0.01
    x = np.cumsum(step)
    x[350:] = 9.0
    position = np.zeros((500, 1, 3))
    position[:, 0, 0] = x
    np.testing.assert_allclose(metrics.late_speed(position, np.array([350]), np.zeros(1)), [0.5])
    # Ten more seconds on record change nothing.
    longer = np.concatenate([position[:350], np.full((650, 1, 3), 3.5)])
    longer[350:500] = longer[349]
    np.testing.assert_allclose(metrics.late_speed(longer, np.array([1000]), np.zeros(1)), [1.0 / 5.0])


def test_late_speed_excludes_episodes_that_end_early():
    # Lengths 249, 250: before the window, and one sample in it (5.00 s). 251: two samples, 0.02 m in 0.02 s.
    position = np.zeros((500, 3, 3))
    position[:, :, 0] = 0.02 * np.arange(500)[:, None]
    speed = metrics.late_speed(position, np.array([249, 250, 251]), np.zeros(3))
    np.testing.assert_allclose(speed, [np.nan, np.nan, 1.0])
    assert metrics.summarize(speed) == metrics.Summary(pytest.approx(1.0), 1)


def test_late_speed_of_a_short_record_is_excluded():
    assert np.isnan(metrics.late_speed(np.zeros((100, 2, 3)), np.array([100, 1]), np.zeros(2))).all()


def test_late_path_follows_the_robots_own_heading():
    """Circles: the chord of an arc of angle a is 2 r sin(a / 2), and the heading in its middle is the chord's."""
    steps = np.arange(500)
    # Left at 1 rad/s with radius 0.5 m, right at 2 rad/s with 1 m and walking backward, straight along -x at 0.3 m/s.
    rate, radius = np.array([1.0, -2.0]), np.array([0.5, 1.0])
    yaw = rate * steps[:, None] / 50
    circle = radius * np.sign(rate) * np.array([np.sin(yaw), -np.cos(yaw)])
    circle[:, :, 1] *= -1  # half a turn away: the way of travel is opposite to the heading
    position = np.zeros((500, 3, 3))
    position[:, :2, 0], position[:, :2, 1] = circle
    position[:, 2, 0] = -0.3 * steps / 50
    yaw = np.concatenate([yaw, np.full((500, 1), np.pi)], axis=1)
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi  # as a quaternion gives it
    speed, turn = metrics.late_path(position, yaw, np.full(3, 500))
    chord = 2 * radius * np.sin(np.abs(rate) / 100) * 50
    np.testing.assert_allclose(speed, [chord[0], -chord[1], 0.3], rtol=1e-9)
    np.testing.assert_allclose(turn, [1.0, -2.0, 0.0], atol=1e-9)


def test_late_path_reads_what_late_speed_reads():
    rng = np.random.default_rng(0)
    position, length = rng.normal(size=(600, 5, 3)).cumsum(0), np.array([200, 250, 251, 400, 600])
    speed, turn = metrics.late_path(position, np.full((600, 5), 0.7), length)
    np.testing.assert_allclose(speed, metrics.late_speed(position, length, np.full(5, 0.7)), rtol=1e-9)
    np.testing.assert_array_equal(np.isnan(turn), [True, True, False, False, False])


def test_forward_displacement_ends_with_the_episode():
    position = np.zeros((4, 2, 3))
    position[:, :, 0] = np.array([1.0, 2.0, 3.0, 100.0])[:, None]
    position[:, :, 1] = np.array([0.0, -1.0, -2.0, 100.0])[:, None]
    length, heading = np.array([3, 1]), np.array([np.pi / 4, 0.0])
    # (2, -2) is at right angles to 45 degrees; an episode of one step has not moved since its first record.
    np.testing.assert_allclose(metrics.forward_displacement(position, length, heading), [0.0, 0.0], atol=1e-12)
    start = np.array([[0.0, -2.0, 0.7], [0.5, 0.0, 0.7]])
    # (3, 0) on 45 degrees is 3/sqrt(2); (0.5, 0) on x is 0.5.
    np.testing.assert_allclose(
        metrics.forward_displacement(position, length, heading, start), [3 / np.sqrt(2), 0.5], atol=1e-12
    )


def test_window_ranges_are_those_of_the_sagittal_joints_in_complete_windows():
    wanted = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    position = np.full((120, 3, 7), 5.0)
    position[:, :, SAGITTAL] = ramps(wanted, 120)[:, None]
    position[:, :, 6] = np.random.default_rng(0).normal(size=(120, 3))
    position[100:] = np.nan  # the started third window is not read
    ranges = metrics.window_ranges(position, np.array([120, 99, 49]), SAGITTAL)
    assert ranges.shape == (2, 3, 6)
    np.testing.assert_allclose(ranges[:, 0], [wanted, wanted], atol=1e-12)
    np.testing.assert_allclose(ranges[:, 1], [wanted, np.full(6, np.nan)], atol=1e-12)
    assert np.isnan(ranges[:, 2]).all()


def test_window_range_ignores_two_outliers():
    # 50 values: the 5th and 95th percentiles lie between ranks 2 and 3 from either end.
    q = np.zeros((50, 1, 1))
    q[[7, 8]], q[[20, 21]] = 3.0, -3.0
    assert metrics.window_ranges(q, np.array([50]), np.array([0])).item() == 0.0
    # Of 0..49 the 95th percentile is 0.95 * 49 = 46.55 and the 5th 2.45.
    q[:, 0, 0] = np.random.default_rng(0).permutation(50)
    assert metrics.window_ranges(q, np.array([50]), np.array([0])).item() == pytest.approx(44.1)


def test_expert_ranges_average_the_windows_and_drop_the_tail():
    clip = np.zeros((130, 7))
    clip[:50, SAGITTAL] = ramps(np.full(6, 0.2))
    clip[50:100, SAGITTAL] = ramps(np.full(6, 0.4))
    clip[100:] = 9.0
    np.testing.assert_allclose(metrics.expert_ranges(clip, SAGITTAL), np.full(6, 0.3), atol=1e-12)


def test_expert_shorter_than_a_window_is_refused():
    with pytest.raises(UserError, match="demonstration of 49 frames at 50 Hz: expected at least 1 s"):
        metrics.expert_ranges(np.zeros((49, 7)), SAGITTAL)


# Three windows of one episode; the expert moves every joint by 0.5 rad.
EXPERT = np.full(6, 0.5)
RANGES = np.stack([np.full((1, 6), 5.0), np.full((1, 6), 0.25), np.full((1, 6), 1.0)])


def test_excursion_leaves_out_the_first_second():
    # Ratios 0.5 and 2.0 remain.
    np.testing.assert_allclose(metrics.excursion(RANGES, EXPERT), [1.25])
    assert np.isnan(metrics.excursion(RANGES[:1], EXPERT)).all()


def test_excursion_averages_ratios_joint_by_joint():
    expert = np.array([0.1, 0.2, 0.4, 0.1, 0.2, 0.4])
    ranges = np.stack([np.zeros((1, 6)), np.full((1, 6), 0.2)])
    # 2, 1, 0.5 on either side; with the third joint still in the expert, 2 and 1.
    np.testing.assert_allclose(metrics.excursion(ranges, expert), [3.5 / 3])
    np.testing.assert_allclose(metrics.excursion(ranges, np.where(expert == 0.4, 0.0, expert)), [1.5])


def test_amplitude_mae_includes_the_first_second_and_is_in_degrees():
    # |5 - .5|, |.25 - .5|, |1 - .5| rad.
    np.testing.assert_allclose(metrics.amplitude_mae(RANGES, EXPERT), [np.rad2deg((4.5 + 0.25 + 0.5) / 3)])


def test_imbalance_compares_left_with_right():
    # |3 - 1| / 2 = 1, |1 - 1| / 1 = 0, 0/0 counts as 0.
    ranges = np.array([3.0, 1.0, 0.0, 1.0, 1.0, 0.0])[None, None]
    np.testing.assert_allclose(metrics.left_right_imbalance(ranges), [1.0 / 3.0])
    # A one-sided gait; and sides that take turns from window to window, which is none.
    np.testing.assert_allclose(metrics.left_right_imbalance(np.array([1.0, 1, 1, 0, 0, 0])[None, None]), [2.0])
    turns = np.array([[1.0, 1, 1, 2, 2, 2], [2.0, 2, 2, 1, 1, 1]])[:, None]
    np.testing.assert_allclose(metrics.left_right_imbalance(turns), [0.0])


def test_contact_foot_speed_is_planar_and_counts_only_contact():
    position = np.zeros((4, 1, 2, 3))
    position[:, 0, 0, 0] = [0.0, 0.003, 0.103, 0.203]  # slides 3 mm along x in contact, then swings
    position[:, 0, 0, 1] = [0.0, 0.004, 0.104, 0.204]  # and 4 mm along y: 5 mm in 0.02 s is 0.25 m/s
    position[:, 0, 1, 2] = [0.0, 1.0, 2.0, 3.0]  # rises straight up: no planar speed
    contact = np.ones((4, 1, 2), bool)
    contact[2:, 0, 0] = False
    # One pair of the first foot at 0.25 m/s, three of the second at 0.
    np.testing.assert_allclose(metrics.contact_foot_speed(position, contact, np.array([4])), [0.25 / 4])
    # Of an episode of two steps only the first pair counts; the reset that follows does not.
    np.testing.assert_allclose(metrics.contact_foot_speed(position, contact, np.array([2])), [0.25 / 2])
    # One step has no speed; nor has a foot in the air.
    assert np.isnan(metrics.contact_foot_speed(position, contact, np.array([1]))).all()
    assert np.isnan(metrics.contact_foot_speed(position, np.zeros_like(contact), np.array([4]))).all()


def test_action_rate_and_jerk_are_mean_absolute_differences_within_the_episode():
    """Targets that rise by 0.02 rad a step of 0.02 s; velocities k², whose second difference is 2, over 0.02² s²."""
    step = np.arange(6.0)
    targets, velocity = np.zeros((6, 1, 2)), np.zeros((6, 1, 2))
    targets[:, 0, 0] = 0.02 * step  # 1 rad/s, the other joint none
    velocity[:, 0, 0] = -(step**2)  # 5,000 rad/s³, the other joint none
    targets[5] = velocity[5] = np.nan  # after the end
    length = np.array([5])
    np.testing.assert_allclose(metrics.action_rate(targets, length), [0.5])
    np.testing.assert_allclose(metrics.joint_jerk(velocity, length), [2500.0])
    # Another rate, and episodes that are too short.
    np.testing.assert_allclose(metrics.action_rate(targets, length, rate=100.0), [1.0])
    assert np.isnan(metrics.action_rate(targets, np.array([1]))) and np.isnan(metrics.joint_jerk(velocity, [2]))


def test_power_is_of_the_servos_torques_either_way():
    """Torques 10 · 0.3 - 2 · 1 = 1 N m and, past its limit, -5 N m, at 1 and 0.5 rad/s: 1 + 2.5 W, and then nothing."""
    position, velocity = np.zeros((3, 1, 2)), np.zeros((3, 1, 2))
    velocity[0, 0] = [1.0, 0.5]
    velocity[2] = np.nan  # after the end
    targets = np.tile([0.3, -7.0], (3, 1, 1))
    servo = {"stiffness": np.array([10.0, 10.0]), "damping": np.array([2.0, 2.0]), "effort": np.array([5.0, 5.0])}
    found = metrics.power(targets, position, velocity, np.array([2]), **servo)
    np.testing.assert_allclose(found, [3.5 / 2])


@pytest.mark.filterwarnings("error")
def test_episodes_without_a_window_are_excluded_and_counted():
    # Lengths 10, 60 and 150: none, one and three complete windows; what follows an episode is not a number.
    rng = np.random.default_rng(0)
    length = np.array([10, 60, 150])
    q = rng.normal(size=(150, 3, 7))
    q[np.arange(150)[:, None] >= length] = np.nan
    ranges = metrics.window_ranges(q, length, SAGITTAL)
    assert metrics.summarize(metrics.excursion(ranges, EXPERT)).n == 1
    assert metrics.summarize(metrics.amplitude_mae(ranges, EXPERT)).n == 2
    assert metrics.summarize(metrics.left_right_imbalance(ranges)).n == 2
    for metric in (metrics.excursion(ranges, EXPERT), metrics.amplitude_mae(ranges, EXPERT)):
        assert np.isfinite(metrics.summarize(metric).mean)
    # No window fits at all.
    ranges = metrics.window_ranges(q[:40], np.minimum(length, 40), SAGITTAL)
    for metric in (
        metrics.excursion(ranges, EXPERT),
        metrics.amplitude_mae(ranges, EXPERT),
        metrics.left_right_imbalance(ranges),
    ):
        summary = metrics.summarize(metric)
        assert np.isnan(summary.mean) and summary.n == 0


@pytest.mark.filterwarnings("error")
def test_an_episode_that_ends_in_a_broken_state_does_not_spoil_the_mean():
    position = np.zeros((300, 2, 3))
    position[:, :, 0] = 0.01 * np.arange(300)[:, None]
    position[299, 0] = np.inf
    length, heading = np.array([300, 300]), np.zeros(2)
    assert metrics.summarize(metrics.late_speed(position, length, heading)) == metrics.Summary(pytest.approx(0.5), 1)
    displacement = metrics.summarize(metrics.forward_displacement(position, length, heading))
    assert displacement == metrics.Summary(pytest.approx(2.99), 1)


def test_float32_input_is_computed_in_float64():
    position = np.zeros((500, 1, 3), np.float32)
    assert metrics.late_speed(position, np.array([500]), np.zeros(1)).dtype == np.float64
    assert metrics.window_ranges(np.zeros((50, 1, 7), np.float32), np.array([50]), SAGITTAL).dtype == np.float64
