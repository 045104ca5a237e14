"""Which topics of a log are the stereo pair, its calibrations, the inclinometer and the pose."""
