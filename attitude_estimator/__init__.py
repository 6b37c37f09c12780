"""Roll and pitch from one IMU and an altimeter: the estimators, the node and the offline tool.

=================  ==================================================================================
``params``         :class:`~attitude_estimator.params.AttitudeParams`, in SI, described and ranged
``estimator``      :class:`~attitude_estimator.estimator.AttitudeEstimator`: samples in, attitude out
``edge``           what node and offline tool share at the ROS edge
``node``, ``cli``  ``attitude_node`` and ``estimate_bag``
=================  ==================================================================================

The equations are in ``docs/attitude.md``. Nothing but ``edge``, ``node`` and ``cli`` knows ROS. What a program
needs is here: ``from attitude_estimator import AttitudeEstimator``.
"""

from attitude_estimator.estimator import AttitudeEstimator, Estimates, TimeJumpError
from attitude_estimator.params import AttitudeParams
from attitude_estimator.smoother import smooth

__all__ = ["AttitudeEstimator", "AttitudeParams", "Estimates", "TimeJumpError", "smooth"]
