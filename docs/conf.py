"""How Sphinx builds the site: ``make docs``. Nothing is fetched, neither to build it nor to view it."""

from export_model.exporter import __version__

project = "export-model"
copyright = "the authors of export-model, Apache-2.0"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_click"]
exclude_patterns: list[str] = []

# The pages are read on the forge as well, so links go to .md files and to headings by their text.
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
maximum_signature_line_length = 100
python_use_unqualified_type_names = True

html_theme = "furo"
html_logo = html_favicon = "pictures/logo.svg"
html_title = f"export-model {__version__}"
html_static_path = ["style"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
add_module_names = False
# "text" for output that is no code; a block that Pygments cannot read should be seen.
highlight_language = "text"
