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
``station``      all of it, one dwell at a time: what a node or a command line calls
===============  =================================================================================

Conventions are those of :mod:`inertial`, and the table's are in :mod:`alignment.turntable`. An angle of a
ROS joint, counter-clockwise seen from above, is ``-tau``.
"""
