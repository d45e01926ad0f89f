"""Recordings: videos, bags and folders of frames made into datasets.

In go a recording for each camera position, readings with their times, and a model; out comes a
dataset of the frames in which the machine stood still (section 3.1 begins with its images). Frames
are read one at a time, twice: to find out when the machine moved, and to write those that are used.
"""
