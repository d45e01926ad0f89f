"""Pages: what people open in a browser, each one file that needs no other and no network.

A page is a :class:`Page` of sections and blocks (``document``), which a job's module makes of its
result; ``html`` renders any of them with one template, one style sheet and one script.
"""
