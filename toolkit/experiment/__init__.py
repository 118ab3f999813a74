"""The same comparison over many seeds of a simulated recording, in parallel processes on this machine.

Reading order: trial -> processes -> over_seeds.
"""
