"""The look of the gallery: the package's palette, thumbnails of whole panels of the run that keeps its invariants, and
a sentence under each title."""

from __future__ import annotations

import ast
import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
from PIL import Image, ImageOps
from sphinx_gallery.scrapers import matplotlib_scraper

from invariode._base.style import COLOURS, LOOK, PLAIN, PROJECTED

#: The examples draw the run without projection first.
CYCLE = [PLAIN, PROJECTED, *(one for one in COLOURS if one not in (PLAIN, PROJECTED))]

#: Width by height of figures with panels side by side, at least: their thumbnails show one of the panels.
_WIDE = 1.7

#: The part of a figure that a thumbnail shows, beside its picture in the gallery.
_PANEL = "_panel.png"

#: Resolution of that part, in dots per inch, and its margin in inches.
_DPI, _MARGIN = 100, 0.06


def palette(gallery_conf: dict[str, Any], name: str) -> None:
    """Set matplotlib to the package's look, before each example."""
    mpl.rcParams.update({**LOOK, "axes.prop_cycle": mpl.cycler(color=CYCLE)})


def panel_of(figure: Any) -> Any:
    """Return the panel of a figure that a thumbnail shows: that of the run with its invariants imposed; of figures with
    panels side by side the first; None if it is the whole figure."""
    panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    if len(panels) < 2:
        return None
    titled = {re.split(r"\W+", ax.get_title().lower())[0]: ax for ax in panels}
    titled |= {re.split(r"\W+", ax.get_title().lower())[-1]: ax for ax in panels}
    if "plain" in titled and "projected" in titled:
        return titled["projected"]
    width, height = figure.get_size_inches()
    return panels[0] if width >= _WIDE * height else None


def scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the pictures of an example, and beside the first one the panel that its thumbnail shows."""
    import matplotlib.pyplot as plt

    for figure in [plt.figure(number) for number in plt.get_fignums()[:1]]:
        panel = panel_of(figure)
        if panel is not None:
            figure.canvas.draw()
            box = panel.get_tightbbox().transformed(figure.dpi_scale_trans.inverted()).padded(_MARGIN)
            folder = Path(gallery_conf["src_dir"]) / "gallery" / "images"
            folder.mkdir(parents=True, exist_ok=True)
            name = f"{Path(block_vars['src_file']).stem}{_PANEL}"
            figure.savefig(folder / name, bbox_inches=box, dpi=_DPI, facecolor="white")
    found: str = matplotlib_scraper(block, block_vars, gallery_conf)
    return found


def _thumbnails(folder: Path, size: tuple[int, int]) -> None:
    """Replace the thumbnails of figures whose panels would be too small by those of one panel."""
    for path in folder.glob(f"*{_PANEL}"):
        with Image.open(path) as panel:
            small = ImageOps.pad(panel.convert("RGB"), size, color="white")
        small.save(folder / "thumb" / f"sphx_glr_{path.name.removesuffix(_PANEL)}_thumb.png")


def sentence(example: Path) -> str:
    """Return the first sentence of an example's text."""
    text = ast.get_docstring(ast.parse(example.read_text(encoding="utf-8"))) or ""
    paragraph = " ".join(text.split("\n\n")[1].split())
    return re.split(r"(?<=[.?])\s", paragraph)[0].replace("`", "")


def _with_sentences(index: str, examples: Path) -> Iterator[str]:
    """Yield the lines of the gallery's index with the first sentence of each example under its title."""
    current = None
    for line in index.splitlines():
        if found := re.search(r":doc:`/gallery/(\w+)`", line):
            current = examples / f"{found[1]}.py"
        if current is not None and "sphx-glr-thumbnail-title" in line:
            yield line.replace("</div>", f"</div>\n      <p>{html.escape(sentence(current))}</p>", 1)
            current = None
        else:
            yield re.sub(r' tooltip="[^"]*"', "", line)


def after_the_gallery(app: Any) -> None:
    """Finish thumbnails and index, which the gallery has written."""
    folder = Path(app.srcdir) / "gallery"
    _thumbnails(folder / "images", app.config.sphinx_gallery_conf["thumbnail_size"])
    index = folder / "index.rst"
    text = "\n".join(_with_sentences(index.read_text(encoding="utf-8"), Path(app.srcdir).parent / "examples")) + "\n"
    if text != index.read_text(encoding="utf-8"):
        index.write_text(text, encoding="utf-8")


def setup(app: Any) -> dict[str, Any]:
    app.connect("builder-inited", after_the_gallery, priority=900)
    return {"parallel_read_safe": True}
