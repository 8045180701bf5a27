"""The offline half: hulls, metrics, evaluation, calibration, plots. No ROS here."""
