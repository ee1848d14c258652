"""Settings of the documentation site. scripts/docs stages the pages and runs Sphinx with this file."""

from docutils.nodes import SkipNode
from docutils.utils.math import latex2mathml

project = "Rowburst"
author = "the Rowburst developers"
extensions = ["myst_parser", "autoapi.extension", "sphinx.ext.napoleon", "sphinx_copybutton"]
napoleon_google_docstring = False
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
root_doc = "index"

# Markdown, as GitHub shows it: a heading is a place to link to, $…$ is mathematics.
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_ambiguous"]

# Python: read from the sources, so nothing has to be built or imported.
autoapi_dirs = ["../docs-python/rowburst"]
autoapi_generate_api_docs = False
autoapi_add_toctree_entry = False
autoapi_python_class_content = "class"
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 70

html_theme = "furo"
html_title = "Rowburst"
html_static_path = ["_site/static"]
html_css_files = ["site.css"]
# Formulas as MathML, which browsers draw without a script from elsewhere.
html_math_renderer = "mathml"
html_copy_source = False
# Excerpts are fetched, which a browser refuses to pages from the disk: titles and headings are found without them.
html_show_search_summary = False
html_show_sphinx = False
html_show_copyright = False
html_domain_indices = False
copybutton_exclude = ".linenos, .gp, .go"
copybutton_prompt_text = "$ "
pygments_style = "default"
pygments_dark_style = "monokai"


def inline_math(translator, node):
    translator.body.append(latex2mathml.tex2mathml(node.astext()))
    raise SkipNode


def display_math(translator, node):
    translator.body.append(f'<div class="math">{latex2mathml.tex2mathml(node.astext(), as_block=True)}</div>')
    raise SkipNode


def setup(app):
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
