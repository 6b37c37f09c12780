"""Shared ground of inertial navigation: frames, rotations, Earth, sensors, trajectories, scores.

Conventions of the whole project (nothing in this package knows ROS):

=====================  ==========================================================================
units                  SI and radians; degrees only in names that end in ``_deg``
body frame ``b``       FRD: x forward, y right, z down
navigation frame ``n`` NED: north, east, down; gravity is ``[0, 0, +g]``
``dcm_nb``             takes body to navigation, ``v_n = dcm_nb @ v_b``; adjacent letters cancel
``down_b``             the down direction seen in body axes, third row of ``dcm_nb``
``gyro_b``             angular rate of the body, rad/s
``accel_b``            specific force, m/s^2; level and at rest it is ``[0, 0, -g]``
``roll, pitch``        ``roll = atan2(down_b[1], down_b[2])``, ``pitch = -asin(down_b[0])``:
                       right wing down and nose up are positive
``q_nb_wxyz``          unit quaternion of ``dcm_nb``, scalar first
``altitude``           metres, up positive; ``vd`` is the velocity down, m/s
``stamp_ns``           integer nanoseconds; differences are taken before scaling to seconds
IMU sample             the mean over the interval that ends at its stamp
=====================  ==========================================================================

ROS speaks FLU and ENU (REP-103, REP-145); :mod:`nav_ros` converts once, at the edge.
"""
