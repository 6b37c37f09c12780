"""Poses for tf2, without tf2_ros, which is not among the wheels: what is handed to its broadcaster."""

import sys
from types import SimpleNamespace

import pytest

pytest.importorskip("geometry_msgs", reason="ROS is not installed")

from nav_ros.transforms import Transforms  # noqa: E402


def test_a_pose_is_that_of_the_child_in_the_parent(monkeypatch):
    sent = []
    broadcaster = SimpleNamespace(sendTransform=sent.append)
    monkeypatch.setitem(sys.modules, "tf2_ros", SimpleNamespace(TransformBroadcaster=lambda node: broadcaster))
    Transforms(node=None).send(5_000_000_007, "map", "base_link", (0.1, 0.2, 0.3, 0.9), (1, 2, 3))
    (message,) = sent
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    rotation, translation = message.transform.rotation, message.transform.translation
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.1, 0.2, 0.3, 0.9)
    assert (translation.x, translation.y, translation.z) == (1.0, 2.0, 3.0)


def test_without_tf2_ros_there_is_none(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(ImportError):
        Transforms(node=None)
