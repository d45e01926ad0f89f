"""The noise of outlines and leg axes from repeated images (section 4.2, Table 1).

`comparison` is the job: the same images go through legcal's detector and through `canny`;
`repeatability` has the statistics of repeats, `document` what is returned and printed.
"""
