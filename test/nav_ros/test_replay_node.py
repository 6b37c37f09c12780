"""The pace and the lock-step of replay_node, without any process; see test/integration/test_replay.py."""

import threading

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from nav_ros.replay_node import ReplayParams, Schedule, Window  # noqa: E402

MS = 1_000_000


def test_the_schedule_is_absolute_and_does_not_drift():
    schedule = Schedule(2.0)
    assert schedule.due_ns(1000 * MS, 5 * MS) == 5 * MS
    late = 77 * MS
    assert schedule.due_ns(1010 * MS, 10 * MS + late) == 10 * MS
    assert schedule.due_ns(1000 * MS + 10**15, 0) == 5 * MS + 10**15 // 2


def test_as_fast_as_possible_is_always_now():
    schedule = Schedule(0.0)
    assert [schedule.due_ns(k * MS, 10 - k) for k in range(3)] == [10, 9, 8]


def test_a_pause_shifts_what_is_to_come():
    schedule = Schedule(1.0)
    schedule.shift(50 * MS)
    schedule.due_ns(0, 0)
    schedule.shift(30 * MS)
    assert schedule.due_ns(5 * MS, 0) == 35 * MS
    schedule.restart()
    assert schedule.due_ns(0, 100 * MS) == 100 * MS


def test_the_window_is_full_until_an_answer_comes():
    window = Window(2)
    for stamp in (1, 2):
        assert window.wait_for_room(0.0)
        window.sent(stamp)
    assert not window.wait_for_room(0.0)
    window.answer(7)
    assert not window.wait_for_room(0.0)
    window.answer(1)
    assert window.wait_for_room(0.0) and not window.wait_for_room(0.0, 1)


def test_an_answer_covers_refused_messages_before_it():
    window = Window(3)
    for stamp in (1, 2, 3):
        window.sent(stamp)
    window.answer(2)
    assert window.wait_for_room(0.0, 2) and not window.wait_for_room(0.0, 1)
    window.give_up()
    assert window.unanswered == 1 and window.wait_for_room(0.0, 1)


def test_an_answer_wakes_the_publisher():
    window = Window(1)
    window.sent(1)
    timer = threading.Timer(0.01, window.answer, [1])
    timer.start()
    assert window.wait_for_room(10.0)
    timer.join()


@pytest.mark.parametrize("given", [{}, {"bag": "a", "scenario": "turn"}])
def test_one_source_is_needed(given):
    with pytest.raises(ValueError, match="give either"):
        ReplayParams(**given)
