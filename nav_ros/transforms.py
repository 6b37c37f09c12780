"""Poses for tf2, which need ``tf2_ros``: a node without it does everything else."""

from geometry_msgs.msg import TransformStamped


class Transforms:
    """Broadcasts where a frame is in another.

    Parameters
    ----------
    node : rclpy.node.Node

    Raises
    ------
    ImportError
        tf2_ros is not installed.
    """

    def __init__(self, node):
        from tf2_ros import TransformBroadcaster
        self._broadcaster = TransformBroadcaster(node)

    def send(self, stamp_ns, parent, child, orientation_xyzw, position=(0.0, 0.0, 0.0)):
        """Broadcast a pose.

        Parameters
        ----------
        stamp_ns : int
        parent, child : str
            Frames: the pose is that of `child` in `parent`.
        orientation_xyzw : (4,)
        position : (3,), m
        """
        message = TransformStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        message.header.frame_id, message.child_frame_id = parent, child
        rotation, translation = message.transform.rotation, message.transform.translation
        rotation.x, rotation.y, rotation.z, rotation.w = map(float, orientation_xyzw)
        translation.x, translation.y, translation.z = map(float, position)
        self._broadcaster.sendTransform(message)
