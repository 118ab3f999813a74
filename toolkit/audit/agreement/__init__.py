"""Where vision and the measured motion disagree, each sound by itself.

Read ``disagreement`` (tracks against the motion between two frames), ``conflict`` (for seconds), ``steady_difference``,
``vision_scale`` and ``scale_change`` (in length or direction, throughout or in part).
"""
