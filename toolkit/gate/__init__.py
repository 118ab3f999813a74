"""The accuracy gate: tests whether accuracy, consistency, held-out reprojection or speed differ from a baseline's.

Reading order: baseline (its values and its file) -> measuring -> verdict, significance (the tests of a
metric) -> checking (the whole, case by case). Besides: interleaved (speed against another version of the code,
each in a process of timing_child). Files of another system, without a run: toolkit.evaluation.against_baseline. Use,
and power of the tests: docs/gate.md.
"""
