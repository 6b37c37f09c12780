"""Level and true north from sensors at rest: turntable methods and their joint estimator. No ROS.

===============  =================================================================================
``turntable``    exact readings of sensors on a turntable on the turning Earth; sensors with errors
``sequences``    which table angle when: palindrome, refinement east-west, continuous rotation
``harmonic``     weighted, robust fit of bias, cosine and sine of the table angle
``levelling``    the paper's five levelling methods; the joint level
``azimuth``      the paper's seven closed forms for the heading, with all their branches
``north``        the joint estimator: one search for the heading, nuisances marginalised by priors
``bounds``       Cramer-Rao bounds; the deviation to expect of a schedule under white and 1/f noise
``dwells``       raw samples at one table angle to a dwell, or the reason why it does not count
``station``      level and heading from dwells, one by one; which angle is wanted next
``rotation``     level and heading from a table that turns steadily, by running sums
``comparison``   the closed forms on what either has measured
``joint_check``  sign, unit and delay of the table's joint, by the z gyro
``collector``    streams of samples and angles to dwells, moves and steady turning
``session``      all of it: what a node or a command line calls; ``reasons`` for a refused heading
===============  =================================================================================

Conventions are those of :mod:`inertial`, and the table's are in :mod:`alignment.turntable`. An angle of a
ROS joint, counter-clockwise seen from above, is ``-tau``.
"""
