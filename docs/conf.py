"""Settings of the documentation site: ``sphinx-build -W -b html docs build/site``."""

import railfix
from railfix.core import Settings

project = "railfix"
author = "The railfix developers"
copyright = author  # noqa: A001
version = release = railfix.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
]
exclude_patterns = ["_templates"]
templates_path = ["_templates"]
suppress_warnings = ["misc.highlighting_failure"]  # examples with "..." for what is left out

html_theme = "pydata_sphinx_theme"
html_title = f"railfix {version}"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_sidebars = {"**": ["globaltoc.html"]}
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "navbar_center": [],  # the sidebar has all pages under their headings
    "secondary_sidebar_items": ["page-toc"],
}

myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True

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
