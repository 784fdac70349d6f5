"""Pages fit a telephone: no page of the site scrolls sideways at 390 pixels, and nothing of it is cut off there.

    python docs/widths.py build/docs

Chromium lays the pages out, one after the other, in a frame of this width. `make docs` does the same after a build, and
skips it, with a message, where there is no Chromium."""

from __future__ import annotations

import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

#: Width of a common telephone, in CSS pixels.
WIDTH = 390

#: Folders whose HTML is no page of the site.
_NO_PAGES = {"_static", "_downloads", "_images"}

#: A page is too wide if it scrolls, or if an element reaches beyond it without an ancestor that scrolls.
_LOOK = """<!doctype html><body><script>
const pages = PAGES, wide = [];
const inside = (element, root, style) => {
  for (let at = element; at && at !== root; at = at.parentElement)
    if (/auto|scroll/.test(style(at).overflowX) || /fixed|absolute/.test(style(at).position)) return true;
  return false;
};
const look = async (page) => {
  const frame = document.createElement("iframe");
  frame.style.cssText = "width:WIDTHpx;height:800px;border:0";
  frame.src = page;
  document.body.append(frame);
  await new Promise((done) => { frame.onload = done; });
  const root = frame.contentDocument.documentElement;
  const style = (element) => frame.contentWindow.getComputedStyle(element);
  const out = [...root.querySelectorAll("body *")].find((element) => {
    const box = element.getBoundingClientRect();
    return box.width > 0 && box.right > root.clientWidth + 1 && !inside(element, root, style);
  });
  if (root.scrollWidth > root.clientWidth || out) wide.push([page, out ? out.outerHTML.slice(0, 80) : ""]);
  frame.remove();
};
window.onload = async () => {
  for (const page of pages) await look(page);
  document.body.textContent = "looked at " + pages.length + ": " + JSON.stringify(wide);
};
</script></body>"""


def browser() -> str | None:
    """Return the path of a Chromium, if one is installed."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def too_wide(folder: Path) -> list[tuple[str, str]]:
    """Return the pages of a folder that are wider than `WIDTH`, each with the beginning of an element that is."""
    pages = sorted(path.relative_to(folder) for path in folder.rglob("*.html"))
    names = [path.as_posix() for path in pages if path.parts[0] not in _NO_PAGES]
    look = _LOOK.replace("PAGES", json.dumps(names)).replace("WIDTH", str(WIDTH)).encode()

    class Site(http.server.SimpleHTTPRequestHandler):
        """The pages, and the one that looks at them."""

        def do_GET(self) -> None:
            if self.path == "/":
                self.send_response(200)
                self.send_header("Content-Type", "text/html")
                self.end_headers()
                self.wfile.write(look)
            else:
                super().do_GET()

        def log_message(self, *_: Any) -> None:
            pass

    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Site, directory=str(folder))) as site,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
    ):
        threading.Thread(target=site.serve_forever, daemon=True).start()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3600000", "--dump-dom"]
        command = [str(browser()), *options, f"--user-data-dir={profile}", f"http://127.0.0.1:{site.server_port}/"]
        run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
        site.shutdown()
    found = re.search(r"<body>looked at (\d+): (.*)</body>", run.stdout, re.DOTALL)
    if found is None or int(found[1]) != len(names):
        raise RuntimeError(f"Chromium looked at no pages: {run.stdout[-200:]}{run.stderr[-500:]}")
    return [(page, element) for page, element in json.loads(html.unescape(found[2]))]


def after_the_build(app: Any, failure: Exception | None) -> None:
    if failure is None and app.builder.name == "html":
        if browser() is None:
            print("widths of pages were not looked at: there is no Chromium here; on Debian, apt-get install chromium")
        elif wide := too_wide(Path(app.outdir)):
            raise ValueError(f"pages wider than {WIDTH} pixels: {wide}")


def setup(app: Any) -> dict[str, Any]:
    app.connect("build-finished", after_the_build)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    sys.exit("\n".join(map(str, too_wide(Path(sys.argv[1])))) or None)
