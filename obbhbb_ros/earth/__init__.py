# SPDX-License-Identifier: Apache-2.0
"""
From pixels to places on Earth, with NumPy and oriented boxes only.

Frames: the camera's *optical frame* has x to the right, y down and z forward in the image
(REP-103); *earth* is ECEF, metres from the centre of the Earth (REP-105); *east-north-up* lies at a
place. Quaternions are x, y, z, w, as in the messages of ROS.

Points and vectors have shape (..., 3). In memory all x come first, then all y, then all z, which is
what makes the arithmetic fast.
"""
