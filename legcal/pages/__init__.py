"""Pages: what people open in a browser, each one file that needs no network and no other file.

In goes a :class:`Page` of sections and blocks, texts as they are; out comes HTML by the one
template (:func:`page_html`), with one style sheet and script, and plotly inside where it has plots.
"""
