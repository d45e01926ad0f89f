"""Pages for a browser, each a single file that needs no network and no other file.

In goes a :class:`Page` of sections and blocks with plain texts; out comes HTML from one template
(:func:`page_html`), with one style sheet and the scripts that its blocks need.
"""
