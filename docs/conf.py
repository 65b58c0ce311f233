"""The documentation site: `make docs` builds it, runs its Python, and checks its links."""

import os
import sys
from pathlib import Path

from jupyter_cache import get_cache

from fusion_gym.version import __version__

os.environ["PATH"] = os.pathsep.join((os.path.dirname(sys.executable), os.environ["PATH"]))

project, author, release = "fusion-gym", "the authors of fusion-gym", __version__
project_copyright = author
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**", "results/**"]
extensions = [
    "myst_nb",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx-mathjax-offline",
    "docs.site_extension",
]

html_theme = "furo"
html_title = "fusion-gym"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_use_index = False
html_theme_options = {
    "source_repository": "https://github.com/fusion-gym/fusion-gym/",
    "source_branch": "main",
}

# The Python of a page runs in a kernel of its own, in an empty folder; unchanged pages are cached.
nb_custom_formats = {".md": ("docs.site_extension.read_page", {}, False)}
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parents[1] / "runs/docs/notebooks")
get_cache(nb_execution_cache_path).get_cache_limit()  # creates its tables, before two processes do
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # warnings name paths
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# A heading may begin below the first level, as in an environment's sections.
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_custom_sections = ["Equation"]
