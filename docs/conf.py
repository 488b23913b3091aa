"""The documentation site, built by `make docs`: Sphinx, MyST, the pydata theme and sphinx-gallery, all offline."""

import gc
import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS / "site"))
os.environ["MPLBACKEND"] = "Agg"
gc.set_threshold(100_000)  # a fifth of the time of reading and writing was the garbage collector's

import matplotlib.animation  # noqa: E402
import sphinx_gallery.notebook  # noqa: E402

import kalmark  # noqa: E402
import kalmark.compiled  # noqa: E402

# The buttons of an animation have the icons of the theme, none of a network
matplotlib.animation.JS_INCLUDE = re.sub(r"<link[^>]*>", "", matplotlib.animation.JS_INCLUDE)
kalmark.compiled.COMPILING = ""  # no page shows the note of the compiler

in_markdown = sphinx_gallery.notebook.rst2md


def without_links(text, *options):
    """Return the text of a notebook, which has the names of other pages, since it is no part of the site."""
    return in_markdown(re.sub(r":doc:`/(?:\w+/)*(\w+)`", r"*\1* of the site", text), *options)


sphinx_gallery.notebook.rst2md = without_links

project, author, release = "kalmark", "the authors of kalmark", kalmark.__version__
copyright = "the authors of kalmark, MIT licence"
extensions = [
    "myst_parser",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # MathJax's own files: no page needs a network
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "sphinx_design",
    "project_pages",
    "api_pages",
    "course_pages",
]
exclude_patterns = ["course", "tutorials", "site", "**/*.ipynb"]
root_doc = "index"
language = "en"
highlight_language = "none"  # of a block that names none: rows of a file, what a program prints
maximum_signature_line_length = 90
add_module_names = False
toc_object_entries = False

# Markdown as a code host shows it
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 4
myst_dmath_double_inline = True
mathjax_path = "mathjax/tex-chtml.js"
mathjax3_config = {"options": {"enableMenu": False}}

# A page of the course or a tutorial is a program: course/CHAPTER/plot_NAME.py, tutorials/plot_NAME.py
CHAPTERS = ["guide", "exercises", "slides", "toolbox"]
sphinx_gallery_conf = {
    "examples_dirs": [*(f"course/{chapter}" for chapter in CHAPTERS), "tutorials"],
    "gallery_dirs": [*(f"lessons/{chapter}" for chapter in CHAPTERS), "how"],
    "filename_pattern": r"plot_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "plot_gallery": "True",
    "matplotlib_animations": True,
    "image_srcset": ["2x"],
    "capture_repr": ("_repr_html_",),  # a page shows what it prints
    "copyfile_regex": r".*\.csv",
    "default_thumb_file": str(DOCS / "site" / "static" / "program.svg"),  # of a program without a picture
}

for pages, programs in zip(sphinx_gallery_conf["gallery_dirs"], sphinx_gallery_conf["examples_dirs"], strict=True):
    for page in (DOCS / pages).glob("plot_*"):  # of an earlier build
        if not (DOCS / programs / page.name.partition(".")[0]).with_suffix(".py").exists():
            page.unlink()

html_theme = "pydata_sphinx_theme"
html_title = "kalmark"
html_static_path = ["site/static"]
html_css_files = ["kalmark.css"]
html_show_sourcelink = False
html_copy_source = False
html_search_scorer = str(DOCS / "site" / "search.js")
html_sidebars = {"index": []}
html_theme_options = {
    "logo": {"text": "kalmark"},
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "show_toc_level": 2,
    "show_nav_level": 2,
    "navigation_with_keys": False,
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
    # A lesson has no contents beside it: its code has their width, and lines of 96 characters do not scroll
    "secondary_sidebar_items": {pages: ["page-toc"] for pages in ("*", "api/*", "project/*", "lessons/*")},
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True


def remove_old_pages(app, failure):
    """Remove pages of an earlier build that are none any more, as of a lesson with a new name."""
    if app.builder.format == "html" and failure is None:
        found = app.env.found_docs | {"genindex", "search", "py-modindex"}
        kept = {Path(app.builder.get_outfilename(page)) for page in found}
        for page in Path(app.outdir).rglob("*.html"):
            if page not in kept and not page.relative_to(app.outdir).parts[0].startswith("_"):
                page.unlink()


def setup(app):
    """Connect what follows a build."""
    app.connect("build-finished", remove_old_pages)
