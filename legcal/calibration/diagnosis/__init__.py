"""What people do wrong with readings, models and images, found by trying it.

`mistakes` lists what people do wrong, each as a change of what is taken for true; `diagnosis` tries
them on the images of a session and names what they agree with.
"""
