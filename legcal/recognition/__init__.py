"""Which leg is which, and where the camera stands, when nobody says so (section 3.1).

Reading order: line segments of a picture (:mod:`segments`), pairs of them that may be a cylinder
(:mod:`bars`), what the model says of each leg (:mod:`targets`), camera poses that a bar and a leg
suggest (:mod:`starts`), how well a pose agrees with pictures (:mod:`agreement`), the pose on which
all pictures of a view agree (:mod:`place`), and all views of a dataset (:mod:`recognise`).
"""
