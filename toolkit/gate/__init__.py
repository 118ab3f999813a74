"""The accuracy gate: has a change made accuracy, consistency, held-out reprojection or speed worse than a baseline?

Reading order: baseline (what is kept) -> measuring (how it is measured) -> statistics -> judging (paired, bounded)
-> checking (the whole). How it is used and how well it sees: docs/gate.md.
"""
