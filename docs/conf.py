"""The documentation: `make docs`. Every cell and every example is executed, and warnings are errors."""

import os
import re
import sys
from importlib.metadata import metadata
from pathlib import Path

import invariode

sys.path.insert(0, str(Path(__file__).parent))  # for our own extensions

project = "invariode"
author = copyright = "The invariode developers"
about = metadata("invariode")
version = release = about["Version"]
#: The repository: as the package names it, or else the one whose workflow builds these pages.
urls = dict(line.split(", ", 1) for line in about.get_all("Project-URL", []))
at_work = [os.environ[name] for name in ("GITHUB_SERVER_URL", "GITHUB_REPOSITORY") if name in os.environ]
repository = urls.get("Repository", "/".join(at_work))

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "gallery_look",
    "portable",
    "stacking",
    "mathml",
    "formulas",
    "tables",
    "widths",
]
html_math_renderer = "mathml"
exclude_patterns = ["**.ipynb", "howto/sbml-conformance.md", "gallery/*.py", "gallery/*.zip", "gallery/*.json"]
exclude_patterns += ["_templates"]
templates_path = ["_templates"]
default_role = "py:obj"
nitpicky = True
nitpick_ignore_regex = [
    ("py:class", r"(?!invariode\.).*"),  # types of parameters are words: 'array_like of shape (n,)', 'optional'
    ("py:obj", r"[a-z]\w*(, [a-z]\w*)*"),  # parameters and fields, which stand in the same docstring
    ("py:obj", r"scipy\..*"),  # a build needs no network
]

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "substitution"]
myst_heading_anchors = 3
myst_substitutions = {"release": release}
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_output_stderr = "warn"
nb_merge_streams = True

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say it in words
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

copybutton_prompt_text = r">>> |\.\.\. |\$ |In \[\d*\]: "
copybutton_prompt_is_regexp = True

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r".*\.py",
    "abort_on_example_error": True,
    "reference_url": {"invariode": None},
    "doc_module": ("invariode",),
    "backreferences_dir": "generated/examples",
    "capture_repr": (),
    "download_all_examples": False,
    "min_reported_time": 1000,
    "remove_config_comments": True,
    "show_signature": False,
    "image_scrapers": ("gallery_look.scraper",),
    "reset_modules": ("matplotlib", "gallery_look.palette"),
    "thumbnail_size": (400, 300),
    "within_subsection_order": "FileNameSortKey",
}

html_theme = "pydata_sphinx_theme"
html_title = "invariode"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_favicon = "_static/favicon.svg"
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "invariode"},
    "navbar_align": "left",
    "navigation_with_keys": False,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "navbar_end": ["version", "theme-switcher", "navbar-icon-links"],
    "icon_links": [
        {"name": name, "url": url, "icon": icon}
        for name, url, icon in (
            ("Repository", repository, "fa-brands fa-github"),
            ("Issues", f"{repository}/issues", "fa-solid fa-circle-exclamation"),
        )
        if repository
    ],
}
html_sidebars = {"index": [], "tutorial": [], "benchmarks": [], "benchmarks/*": [], "gallery/*": []}  # room for tables


RESULTS = (
    "Solution",
    "DenseSolution",
    "Stats",
    "Steps",
    "Drift",
    "EnsembleSolution",
    "EnsembleEvents",
    "EnsembleStats",
    "CheckReport",
    "ImposeResult",
    "CompiledFunction",
)


def every_public_name_is_here(app):
    """The reference lists what the package exports, no more and no less."""
    page = (Path(__file__).parent / "reference.md").read_text()
    listed = set(re.findall(r"^   (\w+)$", page, re.MULTILINE))
    if listed != set(invariode.__all__):
        raise ValueError(f"docs/reference.md and invariode.__all__ differ in {listed ^ set(invariode.__all__)}")


def no_signature_of_results(app, what, name, obj, options, signature, returns):
    """What calls return is not made by hand: its fields are documented as such."""
    return ("", None) if what == "class" and name.removeprefix("invariode.") in RESULTS else None


def setup(app):
    app.connect("autodoc-process-signature", no_signature_of_results)
    app.connect("builder-inited", every_public_name_is_here)
