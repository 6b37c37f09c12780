"""A node that does nothing but pass an Imu on: what rclpy itself costs, for the benchmark to compare with."""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

INPUT_QOS = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=200)
OUTPUT_QOS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=200)


def main():
    """Relay imu/data_raw to imu/data; with ``raw`` as an argument the bytes, without making objects."""
    raw = "raw" in sys.argv[1:]
    rclpy.init()
    node = Node("imu_relay")
    publisher = node.create_publisher(Imu, "imu/data", OUTPUT_QOS)
    node.create_subscription(Imu, "imu/data_raw", publisher.publish, INPUT_QOS, raw=raw)
    node.get_logger().info("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
