"""What `uavrl bench` measures: rates by the clock, each beside a floor measured in the same run.

A floor is a time that the work cannot go below, given as the rate it allows: no program of that kind is faster.
"""
