"""Settings of the documentation site: ``sphinx-build -W -b html docs build/site``."""

import railfix

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
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "navbar_align": "left",
    "secondary_sidebar_items": ["page-toc"],
}

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
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
