"""Settings of the documentation site: ``sphinx-build -W -b html docs build/site``."""

import os
import warnings
from pathlib import Path

import railfix
from railfix.core import Settings

project = "railfix"
author = "The railfix developers"
copyright = author  # noqa: A001
version = release = railfix.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_templates", "gallery"]
templates_path = ["_templates"]
suppress_warnings = ["misc.highlighting_failure"]  # examples with "..." for what is left out

# Address of the list of published versions (docs/maintain/tasks.md); without it the site has no version switcher.
VERSIONS = os.environ.get("RAILFIX_VERSIONS")

html_theme = "pydata_sphinx_theme"
html_title = f"railfix {version}"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
html_sidebars = {"**": ["globaltoc.html"]}
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "navbar_center": [],  # the sidebar has all pages under their headings
    "navbar_end": [*(["version-switcher"] if VERSIONS else []), "theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    **({"switcher": {"json_url": VERSIONS, "version_match": version}, "check_switcher": False} if VERSIONS else {}),
}

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_examples",
    "filename_pattern": "/",
    "abort_on_example_error": True,
    "ignore_repr_types": r"matplotlib\.axes",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,
}
warnings.filterwarnings("ignore", "FigureCanvasAgg is non-interactive", UserWarning)  # figure.show() in the examples

autosummary_generate = True
autosummary_imported_members = True
autosummary_ignore_module_all = False
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
numpydoc_attributes_as_param_list = True


def short_signature(app, what, name, value, options, signature, annotation):  # noqa: ARG001
    """Return the signature of a settings model without its defaults, which docs/settings.md lists."""
    if isinstance(value, type) and issubclass(value, Settings):
        return "(**settings)", annotation
    return None


def setup(app):
    """Connect the functions of this file."""
    app.connect("autodoc-process-signature", short_signature)
