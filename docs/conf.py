"""How the site is built: `make docs`. Sphinx reads the Markdown of this folder as it stands."""

from __future__ import annotations

import importlib.util
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from latex2mathml.converter import convert

ROOT = Path(__file__).resolve().parents[1]
_PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
# Where the project is published; "" leaves out whatever needs an address.
_REPOSITORY: str = _PYPROJECT["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]

project = "lagros"
author = "lagros contributors"
project_copyright = author
version = release = _PYPROJECT["project"]["version"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
source_suffix = {".md": "markdown"}
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4
nitpicky = False

autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_numpy_docstring = False
# The fields of a dataclass are described once, by its docstring.
napoleon_use_ivar = True
napoleon_custom_sections = [("Class attributes that a subclass sets", "Attributes")]

html_theme = "furo"
html_title = f"lagros {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files: list[Any] = [("filter.js", {"defer": "defer"})]
if os.environ.get("LAGROS_VERSIONED"):
    # The first lies beside the folder of this version (docs/versions.py).
    html_js_files += ["../../versions.js", "versions.js"]
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options: dict[str, Any] = {"navigation_with_keys": True}
if _REPOSITORY:
    html_theme_options |= {
        "source_repository": _REPOSITORY,
        "source_branch": "main",
        "source_directory": "docs/",
    }


def _inline(translator: Any, node: Any) -> None:
    translator.body.append(convert(node.astext()))
    _skip(node)


def _block(translator: Any, node: Any) -> None:
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    _skip(node)


def _skip(node: Any) -> None:
    raise nodes.SkipNode


def _bars(app: Any, kind: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    # |x| is a size in our docstrings, never a substitution.
    lines[:] = [line.replace("|", "\\|") for line in lines]


def _elsewhere(app: Any, name: str, source: list[str]) -> None:
    # Pages beside the code are no pages of the site: links to the repository, or words.
    def target(found: re.Match[str]) -> str:
        words, path = found.groups()
        return f"[{words}]({_REPOSITORY}/blob/main/{path})" if _REPOSITORY else words

    link = r"\[([^\]]*)\]\((?:\.\./)+((?:benchmarks|CONTRIBUTING|README)[^)\s]*\.md[^)\s]*)\)"
    source[0] = re.sub(link, target, source[0])


class ResultsTable(Directive):
    """`{results-table}`: every published row, which a reader may filter and sort."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "results.py")
        assert spec is not None
        assert spec.loader is not None
        results = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(results)
        return [nodes.raw("", results.page(results.rows()), format="html")]


def setup(app: Any) -> dict[str, bool]:
    """Write formulas as MathML, which browsers show without a script or a font from elsewhere."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _bars)
    app.connect("source-read", _elsewhere)
    app.add_directive("results-table", ResultsTable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
