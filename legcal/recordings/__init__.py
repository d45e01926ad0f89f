"""Recordings: videos, bags and folders of frames, converted to datasets.

Inputs are a recording for each camera position, readings with times, and a model; the output is a
dataset of the frames in which the machine was at rest (section 3.1 begins with its images). Frames
are read one at a time, twice: to detect motion, and to write the used frames.
"""
