"""Position, velocity and attitude from an IMU and whatever aids it: GNSS, altimeter, inclinometer, heading."""
