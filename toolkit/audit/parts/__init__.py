"""What several faults share; no file here is a fault.

Read ``intervals`` (the camera's motion, of ``models.camera_motion``, beside the motion samples), then what is found of
both: ``agreement``, ``deviations``, ``alignment`` (scale and place of the camera), ``placement``, ``turn``, ``units``.
``rotation_offset`` compares clocks by what turns, ``truth_clock`` also their pace, ``windows`` what a trajectory moves
by. ``self_calibration`` adjusts a ``bundle`` beside ``strides`` of motion, within ``calibration_limits``. Of single
tracks: ``one_step``, ``step_correlation``, ``exchanged_rows``. For all: ``robust`` (statistics), ``tracks`` and
``subsets`` (edits of a sequence).
"""
