"""The documentation as a site: `make docs`, into out/docs. Pages are Markdown (MyST); the API comes from docstrings."""

from importlib.metadata import version as find_version

project = "drakerock"
author = "the drakerock developers"
copyright = "the drakerock developers, BSD-3-Clause"
version = release = find_version("drakerock")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["results/data"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
# Links within pages name headings as GitHub does.
myst_heading_anchors = 4

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_use_ivar = True
napoleon_custom_sections = [
    (f"{kind} port{s}", "params_style") for kind in ("Input", "Output") for s in ("", "s")
]

html_theme = "furo"
html_title = "drakerock"
html_show_sourcelink = False
html_copy_source = False
