"""True north, level and sensor biases of a vehicle that stands: INS alignment at rest. No ROS.

===============  =================================================================================
``params``       what is known of sensors, place and vehicle
``coarse``       first attitude: two vectors (gravity, Earth rate), or gravity seen in inertial axes
``filters``      every filter over a recording from any first attitude: ``run_filter``
``predictive``   the incremental predictive algorithm by itself: gain, increment, cost
``samples``      samples, one by one or many, to the steps that filters take
``stillness``    whether the vehicle stands, and the sensors are as good as told
``fine``         a filter from the coarse attitude on, run again over what it remembers
``aligner``      all of it, one sample at a time: what a node or a command line calls
``results``      what it gives
``bound``        Cramer-Rao bound of any scheme, and the floor that sensors set
===============  =================================================================================

Conventions are those of :mod:`inertial`.
"""
