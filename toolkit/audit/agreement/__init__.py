"""Faults that show only where vision is compared with the measured motion.

Read ``disagreement`` (tracks against the motion between two frames), ``conflict`` (differences that last for seconds),
``vision_scale`` and ``scale_change`` (the scale, constant or changing), then ``steady_difference`` (scale and direction
within the limits of sound recordings).
"""
