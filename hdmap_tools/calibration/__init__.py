"""Calibration of the sensors: chessboard intrinsics, camera-lidar extrinsics, and a look at both."""
