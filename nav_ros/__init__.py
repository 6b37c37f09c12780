"""The ROS edge that every node shares: messages, frames, bags, time, parameters, diagnostics, replay.

Importing this package imports no ROS; its modules say what they need. Frames are converted here and
nowhere else, see :mod:`nav_ros.frames`.
"""
