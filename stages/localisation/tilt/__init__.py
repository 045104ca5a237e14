"""The tilt check: is the inclinometer consistent with the camera's own rotations and the ground?"""
