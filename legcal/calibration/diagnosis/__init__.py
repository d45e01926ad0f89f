"""Diagnosis of common mistakes in readings, models and images, by trying their correction.

`mistakes` lists the mistakes, each as a changed hypothesis of the session; `diagnosis` tries them
on the images and names the one that explains them best.
"""
